"""The description of a robot: names of columns, units, and the arms that it has."""

import pytest

from rmis_calib.errors import RobotError
from rmis_calib.io import load_robot
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
