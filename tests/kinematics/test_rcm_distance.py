"""Where the laparoscope's arm pivots, told from its table alone, and arms whose bases nobody filled in."""

import math
from dataclasses import replace

import numpy as np
import pytest

import data_synth
from rmis_calib.errors import RobotError
from rmis_calib.io import load_recording, load_robot
from rmis_calib.kinematics import RobotKinematics
from rmis_calib.pipeline import run_calibration
from rmis_calib.pipeline.arms.poses import motion_poses


def moved(robot, x_mm: float):
    """The robot with its instrument's base moved along x of the common base."""
    base = np.eye(4)
    base[0, 3] = x_mm
    arm = robot.arms["instrument"]
    return replace(robot, arms={**robot.arms, "instrument": replace(arm, base_T_arm_base=base @ arm.base_T_arm_base)})


@pytest.mark.parametrize("name", ["dvrk-classic", "dvrk-classic-si-tool", "dvrk-si"])
def test_presets_do_not_say_where_the_bases_are(name: str) -> None:
    robot = load_robot(name)
    assert all(arm.base_T_arm_base is None for arm in robot.arms.values())
    assert RobotKinematics(robot, "laparoscope", "instrument").rcm_distance_mm() is None
    # Offsets of 1.5708 for pi/2, as in the dVRK's own files, leave the axes some micrometres beside the point.
    robot = replace(robot, arms={name: replace(arm, base_T_arm_base=np.eye(4)) for name, arm in robot.arms.items()})
    assert RobotKinematics(robot, "laparoscope", "instrument").rcm_distance_mm() == pytest.approx(0.0, abs=0.01)
    apart = RobotKinematics(moved(robot, 150.0), "laparoscope", "instrument").rcm_distance_mm()
    assert apart == pytest.approx(150.0, abs=0.01)


def test_distance_of_two_filled_in_bases() -> None:
    # rcm-3x3: the laparoscope at the origin, the instrument at (90, -40, 140).
    distance = RobotKinematics(load_robot("rcm-3x3"), "laparoscope", "instrument").rcm_distance_mm()
    assert distance == pytest.approx(math.sqrt(90**2 + 40**2 + 140**2), abs=1e-6)


def test_an_arm_that_pivots_about_no_point_is_not_judged() -> None:
    robot = load_robot("rcm-3x3")
    arm = robot.arms["laparoscope"]
    elbow = replace(arm.joints[1], a_mm=200.0)
    arms = {
        **robot.arms,
        "laparoscope": replace(arm, joints=(arm.joints[0], elbow, replace(arm.joints[2], a_mm=150.0))),
    }
    assert RobotKinematics(replace(robot, arms=arms), "laparoscope", "instrument").rcm_distance_mm() is None


def test_a_still_camera_has_no_second_arm() -> None:
    assert RobotKinematics(load_robot("dvrk-classic"), None, "instrument").rcm_distance_mm() is None


def test_a_recording_with_both_bases_at_one_place_is_refused(tmp_path) -> None:
    config = replace(data_synth.load_synth_config("clean"), motions=8)
    recording = load_recording(data_synth.write_recording(tmp_path / "recording", config))
    motion_poses(recording)
    arms = recording.robot.arms
    at_one = replace(arms["instrument"], base_T_arm_base=arms["laparoscope"].base_T_arm_base)
    wrong = replace(recording, robot=replace(recording.robot, arms={**arms, "instrument": at_one}))
    with pytest.raises(RobotError) as caught:
        run_calibration(wrong)
    text = str(caught.value)
    assert "fill base_T_arm_base of arms.laparoscope and arms.instrument" in text and "copy a preset" in text
    assert "within 0.1 mm of one point" in text
