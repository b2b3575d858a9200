"""Robots whose bases nobody states: both transforms are found, from kinematics and from a file; a laparoscope that
stands still leaves the pose of the instrument's base."""

from dataclasses import replace

import numpy as np
import pytest
import torch
import yaml
from measured_from_truth import SMALL, observations_from_truth

import data_synth
import rmis_calib as rc
from rmis_calib.config import parse_config
from rmis_calib.errors import RobotError
from rmis_calib.geometry.rigid import rigid_inverse
from rmis_calib.geometry.rotations import rotation_angle
from rmis_calib.io.robot import load_robot, robot_to_dict
from rmis_calib.pipeline.answer.estimation import estimate_with_kinematics
from rmis_calib.pipeline.arms.found_offsets import poses_at
from rmis_calib.pipeline.arms.kinematic_unknowns import KinematicUnknowns
from rmis_calib.pipeline.arms.poses import motion_poses
from rmis_calib.pipeline.motions.observations import setup_observations
from rmis_calib.results import CalibrationResult

CONFIG = parse_config({"solver": {"unknowns": {"joint_offsets": "never", "clock": False}}})


@pytest.fixture(scope="module")
def recorded(tmp_path_factory):
    """A recording of both arms (small pictures: only truth is used), its robot without base_T_arm_base."""
    path = tmp_path_factory.mktemp("unstated") / "recording"
    config = {
        "motions": 120,
        "seed": 4,
        "camera": {"width_px": 160, "height_px": 120, "right": SMALL, "left": None},
        "noise": {"kinematics_mm": 0.1, "kinematics_deg": 0.03},
    }
    data_synth.write_recording(path, data_synth.load_synth_config(config))
    stated = rc.load_recording(path)
    robot = yaml.safe_load((path / "robot.yaml").read_text())
    del robot["setup_sigma_mm"], robot["setup_sigma_deg"]
    bases = {name: np.array(arm.pop("base_T_arm_base")) for name, arm in robot["arms"].items()}
    (path / "robot.yaml").write_text(yaml.safe_dump(robot))
    return path, stated, np.linalg.inv(bases["laparoscope"]) @ bases["instrument"]


def observed(path, recording, poses):
    seen = observations_from_truth(path, recording, poses).to_arrays()
    return rc.ShaftObservations.from_arrays(seen | setup_observations(poses))


def test_both_transforms_are_found_from_a_file(recorded, tmp_path):
    path, stated, setup = recorded
    recording = rc.load_recording(path)
    poses = motion_poses(recording)
    observed(path, recording, poses).save(tmp_path / "observations.npz")
    seen = rc.ShaftObservations.load(tmp_path / "observations.npz")
    assert seen.laparoscope_base_T_instrument_base is None and seen.laparoscope_base_T_arm is not None
    result = rc.solve(seen, CONFIG, throw=False)
    truth = torch.tensor(yaml.safe_load((path / "ground_truth.yaml").read_text())["camera_right_T_arm"])
    found = result.setup.laparoscope_base_T_instrument_base
    assert (found.dst, found.src) == ("laparoscope_base", "instrument_base")
    for T, expected, variance in (
        (result.camera_right_T_arm.matrix, truth.double(), np.diag(result.covariance)),
        (found.matrix, torch.as_tensor(setup), np.diag(result.setup.covariance)[6:]),
    ):
        turn = float(rotation_angle(T[:3, :3] @ expected[:3, :3].mT))
        assert turn < 4.0 * np.sqrt(variance[:3].sum())
        assert float((T[:3, 3] - expected[:3, 3]).norm()) < 4.0 * np.sqrt(variance[3:].sum())
    np.testing.assert_allclose(result.setup.covariance[:6, :6], result.covariance)
    assert any("base_T_arm_base" in sentence for sentence in result.observability.sentences)
    result.write(tmp_path / "result.json")
    again = CalibrationResult.read(tmp_path / "result.json")
    np.testing.assert_allclose(again.kinematic_offsets.setup.matrix, found.matrix)
    # A prediction from the file is that of the robot whose bases are right, to within what was found.
    predicted, right = poses_at(recording, again.kinematic_offsets), motion_poses(stated)
    gap = torch.linalg.vector_norm((predicted.arm_T_rcm - right.arm_T_rcm)[:, :3, 3], dim=-1)
    assert float(gap.max()) < 8.0 * result.setup.translation_sigma_mm


def test_joint_offsets_are_estimated_beside_the_set_up(recorded):
    """The derivative of the laparoscope's joints belongs to the set-up that is found, not to the identity."""
    path, _, setup = recorded
    recording = rc.load_recording(path)
    poses = motion_poses(recording)
    unknowns = KinematicUnknowns(recording, poses.frames, "cpu")
    config = parse_config({"solver": {"unknowns": {"joint_offsets": "always", "clock": False}}})
    solution, _ = estimate_with_kinematics(observed(path, recording, poses), config, unknowns)
    found = solution.setup.laparoscope_base_T_instrument_base.reshape(4, 4)
    sigma = solution.setup.covariance.reshape(12, 12).diagonal()[9:].sum().sqrt()
    assert bool(solution.converged)
    assert float((found[:3, 3] - torch.as_tensor(setup)[:3, 3]).norm()) < 4.0 * float(sigma)


def test_a_still_laparoscope_leaves_the_instruments_base(recorded):
    path, stated, _ = recorded
    arrays = observed(path, rc.load_recording(path), motion_poses(rc.load_recording(path))).to_arrays()
    right = motion_poses(stated)
    camera_T_rcm = torch.tensor(yaml.safe_load((path / "ground_truth.yaml").read_text())["camera_right_T_arm"]).double()
    camera_T_rcm = camera_T_rcm @ right.arm_T_rcm
    # The same pictures, as if the laparoscope had stood where it first was while the instrument did all of it.
    still = np.tile(arrays["laparoscope_base_T_arm"][0], (len(right.frames), 1, 1))
    arm_T_camera = rigid_inverse(camera_T_rcm[0]) @ camera_T_rcm
    first = torch.as_tensor(arrays["arm_T_rcm"][0])
    seen = rc.ShaftObservations.from_arrays(
        arrays | {"laparoscope_base_T_arm": still, "arm_T_rcm": (first @ arm_T_camera).numpy()}
    )
    result = rc.solve(seen, CONFIG, throw=False)
    assert result.camera_right_T_arm.name == "camera_right_T_instrument_base"
    assert result.setup is None and result.kinematic_offsets.arm_is_instrument_base
    assert any("camera_right_T_instrument_base" in sentence for sentence in result.observability.sentences)
    expected = camera_T_rcm[0] @ rigid_inverse(torch.as_tensor(still[0]) @ first)
    gap = (result.camera_right_T_arm.t - expected[:3, 3]).norm()
    assert float(gap) < 4.0 * result.translation_sigma_mm


def drawn_robot(stated):
    """The robot with its instrument's base 50 mm and 5 deg from where it is, and that said."""
    off = np.eye(4)
    off[:3, :3] = [[np.cos(0.0873), -np.sin(0.0873), 0], [np.sin(0.0873), np.cos(0.0873), 0], [0, 0, 1]]
    off[:3, 3] = [30.0, -40.0, 0.0]
    arms = dict(stated.robot.arms)
    arms["instrument"] = replace(arms["instrument"], base_T_arm_base=arms["instrument"].base_T_arm_base @ off)
    return replace(stated.robot, arms=arms, setup_sigma_mm=50.0, setup_sigma_rad=0.0873)


def test_a_roughly_known_set_up_is_a_prior(recorded, tmp_path):
    path, stated, setup = recorded
    rough = tmp_path / "robot.yaml"
    rough.write_text(yaml.safe_dump(robot_to_dict(drawn_robot(stated))))
    robot = load_robot(rough)
    assert robot.setup_sigma_mm == 50.0 and robot.setup_sigma_rad == pytest.approx(0.0873, abs=1e-8)
    assert robot.rcm_sigma_mm == 0.0
    recording = replace(stated, robot=robot)
    result = rc.solve(observed(path, recording, motion_poses(recording)), CONFIG, throw=False)
    truth = np.array(yaml.safe_load((path / "ground_truth.yaml").read_text())["camera_right_T_arm"])
    gap_mm = np.linalg.norm(result.camera_right_T_arm.t.numpy() - truth[:3, 3])
    assert gap_mm < 4.0 * result.translation_sigma_mm < 20.0
    found = result.setup.laparoscope_base_T_instrument_base.matrix.numpy()
    assert np.linalg.norm(found[:3, 3] - setup[:3, 3]) < 4.0 * result.setup.translation_sigma_mm
    assert 40.0 < result.setup.from_stated_mm < 60.0 and 4.0 < result.setup.from_stated_deg < 6.0
    # The same without saying so: the data contradict the stated base, and that is told.
    believed = replace(stated, robot=replace(robot, setup_sigma_mm=None, setup_sigma_rad=None))
    result = rc.solve(observed(path, believed, motion_poses(believed)), CONFIG, throw=False)
    assert any("contradict the stated base" in sentence for sentence in result.observability.sentences)


def test_a_still_laparoscope_with_a_roughly_known_set_up_leaves_the_instruments_base(recorded):
    path, stated, _ = recorded
    recording = replace(stated, robot=drawn_robot(stated))
    arrays = observed(path, recording, motion_poses(recording)).to_arrays()
    still = np.tile(arrays["laparoscope_base_T_arm"][0], (len(arrays["arm_T_rcm"]), 1, 1))
    seen = rc.ShaftObservations.from_arrays(arrays | {"laparoscope_base_T_arm": still})
    result = rc.solve(seen, CONFIG, throw=False)
    assert result.camera_right_T_arm.name == "camera_right_T_instrument_base" and result.setup is None


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"setup_sigma_mm": 50.0}, "found only setup_sigma_mm"),
        ({"rcm_sigma_mm": -1.0}, "rcm_sigma_mm"),
        ({"setup_sigma_mm": 0.0, "setup_sigma_deg": 5.0}, "setup_sigma_mm"),
        (
            {"setup_sigma_mm": 50.0, "setup_sigma_deg": 5.0, "bases": False},
            "expected base_T_arm_base of instrument, laparoscope",
        ),
    ],
)
def test_priors_of_a_set_up_that_make_no_sense(recorded, tmp_path, change, message):
    _, stated, _ = recorded
    robot = replace(stated.robot, setup_sigma_mm=None, setup_sigma_rad=None)
    robot = robot if change.pop("bases", True) else robot.without_bases()
    (tmp_path / "robot.yaml").write_text(yaml.safe_dump(robot_to_dict(robot) | change))
    with pytest.raises(RobotError, match=message):
        load_robot(tmp_path / "robot.yaml")
