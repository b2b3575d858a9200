"""The description of a robot: names of columns, units, and the arms that it has."""

import pytest
import yaml

from rmis_calib.errors import RobotError
from rmis_calib.io import load_robot
from rmis_calib.io.robot import robot_to_dict
from rmis_calib.robot import Joint, joint_column, split_joint_column


def test_a_column_says_arm_joint_and_unit() -> None:
    yaw = Joint("outer_yaw", "revolute", 0.0, 0.0, 0.0, 0.0, 0.0)
    insertion = Joint("insertion", "prismatic", 0.0, 0.0, 0.0, 0.0, 0.0)
    assert joint_column("psm", yaw) == "psm.outer_yaw_rad"
    assert joint_column("psm", insertion) == "psm.insertion_mm"
    assert split_joint_column("psm.outer_yaw_rad") == ("psm.outer_yaw", "rad")
    assert split_joint_column("psm.insertion_mm") == ("psm.insertion", "mm")
    with pytest.raises(ValueError, match=r"ends in _rad or _mm, found psm\.yaw_deg"):
        split_joint_column("psm.yaw_deg")


def test_joints_of_several_arms_in_the_order_of_their_tables() -> None:
    robot = load_robot("rcm-3x3")
    joints = robot.joints("instrument", "laparoscope")
    assert tuple(joints) == robot.columns("instrument") + robot.columns("laparoscope")
    assert joints["laparoscope.insertion_mm"] is robot.arms["laparoscope"].joints[2]
    with pytest.raises(RobotError, match="expected an arm of laparoscope, instrument, found 'psm'"):
        robot.joints("laparoscope", "psm")


def test_only_the_instrument_has_a_shaft() -> None:
    arms = load_robot("dvrk-classic").arms
    assert arms["instrument"].is_instrument and not arms["laparoscope"].is_instrument


def test_robot_states_how_well_the_offsets_of_its_joints_are_known(tmp_path) -> None:
    robot = load_robot("rcm-3x3")
    content = robot_to_dict(robot)
    for joint, sigma in zip(content["arms"]["instrument"]["joints"], (0.0, 0.003, 0.5), strict=False):
        joint["offset_sigma"] = sigma
    (tmp_path / "robot.yaml").write_text(yaml.safe_dump(content))
    told = load_robot(tmp_path / "robot.yaml")
    assert [joint.offset_sigma for joint in told.arms["instrument"].joints[:3]] == [0.0, 0.003, 0.5]
    assert all(joint.offset_sigma is None for joint in told.arms["laparoscope"].joints)
    assert robot_to_dict(told)["arms"]["instrument"]["joints"] == content["arms"]["instrument"]["joints"]
    for wrong, found in (
        (-0.1, "expected 0 or more, found -0.1"),
        (3.0, "expected offset_sigma at most 0.2 rad, found 3"),
    ):
        content["arms"]["instrument"]["joints"][0]["offset_sigma"] = wrong
        (tmp_path / "robot.yaml").write_text(yaml.safe_dump(content))
        with pytest.raises(RobotError, match=found):
            load_robot(tmp_path / "robot.yaml")
