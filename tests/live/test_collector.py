"""Still poses are taken once each, from when the arms rest, in the robot's order and units."""

import numpy as np
import pytest

from rmis_calib.errors import RecordingError
from rmis_calib.io.robot import load_robot
from rmis_calib.live.collector import StillPoses

NAMES = ["outer_insertion", "outer_yaw", "outer_pitch", "outer_roll", "outer_wrist_pitch", "outer_wrist_yaw"]
"""As dVRK up to 2.2 calls them, in another order than the table's."""
PICTURE = np.zeros((4, 6, 3), np.uint8)


def played(positions, until_s: float, sides=("right",), picture_delay_s: float = 0.0):
    """Poses collected from joints at 100 Hz (`positions(t)`, in the order of NAMES) and pictures at 10 Hz."""
    poses, taken = StillPoses(load_robot("dvrk-classic"), ["instrument"], sides), []
    for tick in range(round(until_s * 100)):
        t = tick / 100
        found = [poses.add_joints("instrument", t, NAMES, positions(t))]
        if tick % 10 == 5:
            # A picture comes after its exposure: joints that are newer have come already.
            stamps = {side: t - 0.02 + picture_delay_s * (side == "left") for side in sides}
            found += [poses.add_picture(side, stamp, PICTURE) for side, stamp in stamps.items()]
        taken += [pose for pose in found if pose is not None]
    return taken


def stepping(t: float) -> list[float]:
    """Rests for 1 s, moves for 1 s: yaw by 0.1 rad, insertion by 20 mm."""
    part = min(max(t - 1.0, 0.0), 1.0)
    return [0.1 + 0.02 * part, 0.3 + 0.1 * part, -0.2, 0.0, 0.0, 0.0]


def test_each_rest_gives_one_pose_in_the_robots_order_and_units() -> None:
    first, second = played(stepping, 4.0)
    assert 0.5 <= first.time_s < 1.0 and 2.5 <= second.time_s < 3.0
    assert first.joints["instrument.insertion_mm"] == pytest.approx(100.0)  # 0.1 m, not 0.1 mm
    assert first.joints["instrument.yaw_rad"] == pytest.approx(0.3)
    assert first.joints["instrument.pitch_rad"] == pytest.approx(-0.2)
    assert second.joints["instrument.insertion_mm"] == pytest.approx(120.0)
    assert second.joints["instrument.yaw_rad"] == pytest.approx(0.4)
    assert set(first.pictures) == {"right"}


def test_arms_that_never_rest_give_none() -> None:
    assert played(lambda t: [0.1, 0.3 * np.sin(3.0 * t), 0.0, 0.0, 0.0, 0.0], 3.0) == []


def test_a_motion_there_and_back_before_the_picture_is_seen() -> None:
    def bump(t: float) -> list[float]:
        return [0.1, 0.05 * (0.28 < t % 0.4 < 0.38), 0.0, 0.0, 0.0, 0.0]

    assert played(bump, 3.0) == []


def test_pictures_of_a_pair_belong_together() -> None:
    assert len(played(stepping, 1.0, ("right", "left"))) == 1
    assert played(stepping, 1.0, ("right", "left"), picture_delay_s=-0.03) == []


def test_another_robot_is_named() -> None:
    poses = StillPoses(load_robot("dvrk-classic"), ["instrument"], ["right"])
    with pytest.raises(RecordingError, match=r"joint states of instrument.*6 joints"):
        poses.add_joints("instrument", 0.0, ["a", "b"], [0.0, 0.0])
