"""How motions are named: by the joints that set them apart, or by frames; expected sentences by hand."""

import numpy as np

from rmis_calib.pipeline.answer.motion_names import MotionNames

COLUMNS = ("laparoscope.yaw_rad", "instrument.insertion_mm")


def grid() -> np.ndarray:
    """35 motions: yaw of -0.3 to 0.3 rad in 7 steps, insertion of 150, 170, 190, 210 and 230 mm at each."""
    yaw, insertion = np.meshgrid(np.linspace(-0.3, 0.3, 7), 150.0 + 20.0 * np.arange(5), indexing="ij")
    return np.stack((yaw.ravel(), insertion.ravel()), axis=-1)


def test_one_joint_sets_them_apart() -> None:
    names, every = MotionNames(np.arange(35), COLUMNS, grid()), np.ones(35, dtype=bool)
    deep = grid()[:, 1] > 200.0
    assert names.some(deep, every) == "14 motions with instrument.insertion beyond 200 mm"
    left = grid()[:, 0] < -0.15
    assert names.some(left, every) == "10 motions with laparoscope.yaw below -8.59 deg"  # -0.15 rad


def test_two_joints_set_them_apart() -> None:
    readings = grid()
    corner = (readings[:, 0] > 0.15) & (readings[:, 1] < 180.0)
    said = MotionNames(None, COLUMNS, readings).some(corner, np.ones(35, dtype=bool))
    assert said.startswith("4 motions with ")
    assert "laparoscope.yaw beyond 8.59 deg" in said and "instrument.insertion below 180 mm" in said


def test_a_few_strays_do_not_hide_the_joint() -> None:
    readings = grid()
    deep = readings[:, 1] > 200.0
    deep[0] = True
    assert "insertion beyond 200 mm" in MotionNames(None, COLUMNS, readings).some(deep, np.ones(35, dtype=bool))


def test_what_no_joint_sets_apart_is_named_by_frame() -> None:
    every, some = np.ones(35, dtype=bool), np.arange(35) % 2 == 0
    names = MotionNames(100 + 3 * np.arange(35), COLUMNS, grid())
    assert names.some(some, every) == "18 motions of frames 100, 106, 112, 118, ..."
    assert names.one(4) == "frame 112"


def test_only_motions_that_were_used_are_told_apart() -> None:
    readings, among = grid(), np.ones(35, dtype=bool)
    among[readings[:, 1] > 220.0] = False
    deep = (readings[:, 1] > 180.0) & among
    assert (
        MotionNames(None, COLUMNS, readings).some(deep, among) == "14 motions with instrument.insertion beyond 180 mm"
    )


def test_without_joints_and_frames_motions_have_their_numbers() -> None:
    meant = np.zeros(12, dtype=bool)
    meant[3:7] = True
    assert MotionNames().some(meant, np.ones(12, dtype=bool)) == "4 motions 3 to 6"
    assert MotionNames().one(4) == "motion 4"


def test_all_motions_are_not_described_by_joints() -> None:
    every = np.ones(35, dtype=bool)
    assert MotionNames(None, COLUMNS, grid()).some(every, every) == "35 motions 0 to 34"
