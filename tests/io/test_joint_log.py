"""Interpolation of the joint log by timestamp, and its reading."""

import time
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from recording_files import COLUMNS, joint_rows, robot_dict, write_csv

from rmis_calib.errors import RecordingError, RobotError
from rmis_calib.io.atomic import write_yaml
from rmis_calib.io.configs import load_yaml
from rmis_calib.io.joints import JointLog, load_joints
from rmis_calib.io.robot import load_robot
from rmis_calib.io.tables import read_frame_times

ARMS = ("laparoscope", "instrument")


def log(stamps: list[float], max_gap_s: float | None = None) -> JointLog:
    t = np.array(stamps)
    values = np.stack([2 * t + 1, -t], axis=1)
    return JointLog(t, ("a.x_rad", "a.y_mm"), values, *([] if max_gap_s is None else [max_gap_s]))


def test_linear_between_samples() -> None:
    values, valid = log([0.0, 0.01, 0.03, 0.04]).at(np.array([0.005, 0.02, 0.04, 0.0]))
    assert valid.all()
    np.testing.assert_allclose(values, [[1.01, -0.005], [1.04, -0.02], [1.08, -0.04], [1.0, 0.0]], atol=1e-12)


def test_never_outside_the_log() -> None:
    values, valid = log([1.0, 1.01, 1.02]).at(np.array([0.99, 1.0, 1.02, 1.03, np.nan, np.inf]))
    assert valid.tolist() == [False, True, True, False, False, False]
    assert np.isnan(values[~valid]).all() and np.isfinite(values[valid]).all()


def test_never_across_a_gap() -> None:
    stamps = [*np.arange(0, 0.1, 0.01), *np.arange(0.5, 0.6, 0.01)]
    values, valid = log(stamps).at(np.array([0.085, 0.09, 0.2, 0.49, 0.5, 0.505]))
    assert valid.tolist() == [True, True, False, False, True, True]
    assert log(stamps, max_gap_s=1.0).at(np.array([0.2]))[1].all()
    np.testing.assert_allclose(values[4], [2.0, -0.5])


def test_default_gap() -> None:
    assert log(list(np.arange(10) / 1000)).max_gap_s == pytest.approx(0.05)  # 5 samples would be 5 ms
    assert log(list(np.arange(10) / 25)).max_gap_s == pytest.approx(0.2)  # 5 samples
    assert log(list(np.arange(10.0))).max_gap_s == pytest.approx(0.5)  # 5 samples would be 5 s


def test_slow_log_is_a_list_of_poses() -> None:
    values, valid = log([0.0, 1.0, 2.0]).at(np.array([0.0, 1.00005, 1.5, 2.00009, 2.001]))
    assert valid.tolist() == [True, True, False, True, False]
    # A hit is the sample itself, not an interpolation towards its neighbour.
    np.testing.assert_array_equal(values[valid], [[1.0, 0.0], [3.0, -1.0], [5.0, -2.0]])


def test_log_of_one_sample() -> None:
    values, valid = log([2.0]).at(np.array([1.9, 2.0, 2.1]))
    assert valid.tolist() == [False, True, False]
    np.testing.assert_array_equal(values[1], [5.0, -2.0])


def test_smooth_motion_and_its_velocity_between_samples() -> None:
    """A sine of 1 Hz sampled at 25 Hz, unevenly: a straight line would be off by 2e-2 of its amplitude."""
    stamps = np.arange(0.0, 2.0, 0.04) + np.random.default_rng(0).uniform(-0.01, 0.01, 50)
    angle = 2.0 * np.pi * stamps
    smooth = JointLog(stamps, ("a.x_rad", "a.y_mm"), np.stack([np.sin(angle), np.cos(angle)], axis=1))
    times = np.linspace(0.1, 1.9, 501)
    values, velocity = smooth.interpolate(times)
    np.testing.assert_allclose(values[:, 0], np.sin(2.0 * np.pi * times), atol=1e-3)
    np.testing.assert_allclose(velocity[:, 1], -2.0 * np.pi * np.sin(2.0 * np.pi * times), atol=0.1)
    later, _ = smooth.interpolate(times + 1e-6)
    np.testing.assert_allclose((later - values) / 1e-6, velocity, atol=1e-3)  # of the interpolant itself


@given(st.lists(st.floats(-1.0, 3.0), min_size=1, max_size=20), st.integers(0, 100))
def test_agrees_with_numpy_interp(times: list[float], seed: int) -> None:
    stamps = np.cumsum(np.random.default_rng(seed).uniform(0.005, 0.04, 60))
    values, valid = log(list(stamps), max_gap_s=1.0).at(np.array(times))
    inside = (np.array(times) >= stamps[0] - 1e-4) & (np.array(times) <= stamps[-1] + 1e-4)
    np.testing.assert_array_equal(valid, inside)
    expected = np.interp(np.array(times), stamps, 2 * stamps + 1)
    np.testing.assert_allclose(values[valid, 0], expected[valid], atol=1e-9)


def test_select_keeps_the_order_asked_for() -> None:
    chosen = log([0.0, 0.1]).select(("a.y_mm", "a.x_rad"))
    np.testing.assert_allclose(chosen.values, [[0.0, 1.0], [-0.1, 1.2]])
    with pytest.raises(RecordingError, match=r"expected columns of a\.x_rad, a\.y_mm, found a\.z_mm"):
        log([0.0]).select(("a.z_mm",))


@pytest.mark.parametrize(
    ("stamps", "values", "message"),
    [
        ([0.0, 0.0], np.zeros((2, 2)), "timestamps that increase"),
        ([0.0, np.nan], np.zeros((2, 2)), "finite numbers"),
        ([0.0, 1.0], np.zeros((3, 2)), r"shape \(T, J\)"),
        ([], np.zeros((0, 2)), r"shape \(T, J\)"),
    ],
)
def test_impossible_logs(stamps: list[float], values: np.ndarray, message: str) -> None:
    with pytest.raises(RecordingError, match=message):
        JointLog(np.array(stamps), ("a.x_rad", "a.y_mm"), values)


def test_column_order_in_the_file_does_not_matter(tmp_path: Path) -> None:
    write_yaml(tmp_path / "robot.yaml", robot_dict())
    robot = load_robot(tmp_path / "robot.yaml")
    rows, order = joint_rows(), [4, 0, 5, 2, 1, 3]
    write_csv(tmp_path / "joints.csv", tuple(COLUMNS[i] for i in order), rows[:, order])
    joints = load_joints(tmp_path / "joints.csv", robot, ARMS)
    assert joints.columns == COLUMNS[1:]
    np.testing.assert_allclose(joints.values, rows[:, 1:], rtol=1e-8)


def test_a_million_rows_in_seconds(tmp_path: Path) -> None:
    path, n = tmp_path / "frame_times.csv", 1_000_000
    path.write_text("frame,timestamp_s\n" + "\n".join(f"{i},{i * 0.001:.3f}" for i in range(n)))
    start = time.perf_counter()
    assert len(read_frame_times(path)) == n
    # Measured 0.5 s on one core; a line-by-line parse takes ten times as long.
    assert time.perf_counter() - start < 5.0


def test_robot_presets_load() -> None:
    for name in ("dvrk-classic", "dvrk-si", "rcm-3x3"):
        robot = load_robot(name)
        assert robot.arms["instrument"].is_instrument and not robot.arms["laparoscope"].is_instrument
    columns = load_robot("dvrk-classic").columns("instrument")
    assert (
        columns[:3] == ("instrument.yaw_rad", "instrument.pitch_rad", "instrument.insertion_mm") and len(columns) == 6
    )
    with pytest.raises(RobotError, match="expected an arm of laparoscope, instrument, found 'psm1'"):
        load_robot("dvrk-classic").columns("psm1")


def test_robot_values_reach_the_tables(tmp_path: Path) -> None:
    raw = robot_dict()
    raw["arms"]["laparoscope"].pop("end_T_tool")
    write_yaml(tmp_path / "robot.yaml", raw)
    robot = load_robot(tmp_path / "robot.yaml")
    assert load_yaml(tmp_path / "robot.yaml") == raw
    arm = robot.arms["instrument"]
    assert (arm.rcm_frame, arm.shaft_frame) == (0, 3)
    assert arm.head_point is not None and arm.head_point.xyz_mm == (0.0, 0.0, 416.2)
    np.testing.assert_array_equal(arm.base_T_arm_base[:3, 3], [100.0, 0.0, 0.0])
    np.testing.assert_array_equal(robot.arms["laparoscope"].end_T_tool, np.eye(4))
    insertion = arm.joints[2]
    assert (insertion.unit, insertion.d_mm, insertion.min, insertion.max) == ("mm", -400.0, 0.0, 240.0)
    assert robot.arms["laparoscope"].joints[0].min is None
