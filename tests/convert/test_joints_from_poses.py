"""Joints from logged poses, and the robot told by them, against real logs and a table multiplied out by hand."""

from pathlib import Path

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from rmis_calib.convert.bags import read_logs
from rmis_calib.convert.joints import choose_robot, readings_of
from rmis_calib.convert.material import ArmLog
from rmis_calib.convert.settings import ConvertSettings
from rmis_calib.errors import RecordingError
from rmis_calib.io.robot import load_robot
from rmis_calib.robot import Arm

CLASSIC = load_robot("dvrk-classic")
TIP_R = np.array([[0.0, -1.0, 0.0], [0.0, 0.0, 1.0], [-1.0, 0.0, 0.0]])


def silent(_: str) -> None:
    return


def by_hand(arm: Arm, readings: np.ndarray) -> np.ndarray:
    """(N, 4, 4) mm: Rx(alpha) Tx(a) Rz(theta) Tz(d) of every row."""
    T = np.broadcast_to(np.eye(4), (len(readings), 4, 4))
    for joint, q in zip(arm.joints, readings.T, strict=True):
        q = q + joint.offset
        theta = joint.theta_rad + (q if joint.type == "revolute" else 0 * q)
        step = np.broadcast_to(np.eye(4), T.shape).copy()
        turn_x = Rotation.from_euler("x", joint.alpha_rad).as_matrix()
        step[:, :3, :3] = turn_x @ Rotation.from_euler("z", theta[:, None]).as_matrix()
        d = joint.d_mm + (q if joint.type == "prismatic" else 0 * q)
        step[:, :3, 3] = np.array([joint.a_mm, 0, 0]) + d[:, None] * turn_x[:, 2]
        T = T @ step
    return T


def log_of(name: str, tips: np.ndarray, is_local: bool = True) -> ArmLog:
    quats = Rotation.from_matrix(tips[:, :3, :3]).as_quat()
    poses = np.concatenate([tips[:, :3, 3] / 1000, quats], axis=1)
    return ArmLog(name, pose_ns=[10_000_000 * i for i in range(len(tips))], poses=list(poses), is_local=is_local)


def smooth(arm: Arm, count: int = 300) -> np.ndarray:
    """Readings that wander through nine tenths of every joint's range."""
    t = np.linspace(0, 1, count)[:, None]
    low, high = (np.array([getattr(j, k) for j in arm.joints]) for k in ("min", "max"))
    low[2] = max(low[2], 40.0)  # in the cannula the shaft has no direction from the RCM
    rate = 1.0 + np.arange(len(low))
    return 0.5 * (low + high) + 0.45 * (high - low) * np.sin(2 * np.pi * rate * t + rate)


@pytest.mark.parametrize("robot", ["dvrk-classic", "dvrk-si", "dvrk-classic-si-tool"])
def test_joints_of_an_instrument_from_its_poses(robot: str) -> None:
    arm = load_robot(robot).arms["instrument"]
    readings = smooth(arm)
    tips = by_hand(arm, readings)
    tips[:, :3, :3] = tips[:, :3, :3] @ TIP_R
    found = readings_of(log_of("PSM1", tips), "instrument", arm, silent)
    np.testing.assert_allclose(found.values, readings, atol=2e-5)  # pi/2 against 1.5708


def test_joints_of_the_endoscopes_arm_from_its_poses() -> None:
    arm = CLASSIC.arms["laparoscope"]
    readings = smooth(arm)
    tips = by_hand(arm, readings) @ arm.end_T_tool
    found = readings_of(log_of("ECM", tips), "laparoscope", arm, silent)
    np.testing.assert_allclose(found.values, readings, atol=2e-5)


def test_real_poses_give_the_logged_joints(shared_data: Path) -> None:
    rows = np.loadtxt(shared_data / "dvrk" / "classic_tool_fixed.csv", delimiter=",", skiprows=1)
    tips = np.broadcast_to(np.eye(4), (len(rows), 4, 4)).copy()
    tips[:, :3, :3], tips[:, :3, 3] = Rotation.from_rotvec(rows[:, 10:13]).as_matrix(), 1000 * rows[:, 7:10]
    found = readings_of(log_of("PSM1", tips), "instrument", CLASSIC.arms["instrument"], silent)
    error = np.abs(found.values - rows[:, 1:7] * [1, 1, 1000, 1, 1, 1])
    # Joints and poses of 97 % of the rows are of one tick (tests/kinematics); the rest moved some encoder counts.
    assert np.quantile(error, 0.95, axis=0).max() < 1e-4
    assert error.max() < 0.1


def test_poses_in_another_frame_are_refused() -> None:
    arm = CLASSIC.arms["instrument"]
    tips = by_hand(arm, smooth(arm))
    with pytest.raises(RecordingError, match="without the RCM poses do not tell the shaft"):
        readings_of(log_of("PSM1", tips, is_local=False), "instrument", arm, silent)


def test_poses_of_another_kind_of_arm_are_refused() -> None:
    arm = load_robot("raven-ii").arms["gold"]
    with pytest.raises(RecordingError, match="expected a dVRK PSM with a wristed tool, or an ECM"):
        readings_of(log_of("gold", np.tile(np.eye(4), (3, 1, 1))), "gold", arm, silent)


@pytest.mark.parametrize(
    ("truth", "expected"),
    [("dvrk-classic", "dvrk-classic"), ("dvrk-si", "dvrk-si"), ("dvrk-classic-si-tool", "dvrk-classic-si-tool")],
)
def test_the_robot_is_told_by_its_poses(truth: str, expected: str) -> None:
    arm = load_robot(truth).arms["instrument"]
    readings = smooth(arm)  # of an Si arm, beyond a Classic's limits
    world_T_base = np.eye(4)
    world_T_base[:3, :3], world_T_base[:3, 3] = Rotation.from_rotvec([0.3, -0.5, 0.9]).as_matrix(), [100.0, -50.0, 20.0]
    log = log_of("PSM1", world_T_base @ by_hand(arm, readings), is_local=False)
    log.joint_ns = [ns + 1 for ns in log.pose_ns]
    log.joints = list(readings * [1, 1, 1e-3, 1, 1, 1])
    notes: list[str] = []
    assert choose_robot([log], notes.append) == expected
    assert "reproduce the poses of PSM1" in notes[0]
    log.joints = list(np.random.default_rng(0).permutation(np.array(log.joints)))
    with pytest.raises(RecordingError, match="no clear fit of the logged poses"):
        choose_robot([log], silent)


def test_the_robot_of_a_real_bag(shared_data: Path) -> None:
    bag = shared_data / "dvrk" / "pitch_exp_traj_01_test_cropped.bag"
    logs, infos = read_logs(bag, ConvertSettings(), silent)
    assert list(logs.arms) == ["PSM2"] and not infos
    log = logs.arms["PSM2"]
    assert (len(log.joints), len(log.poses), log.pose_frame, log.is_local) == (3420, 3420, "ECM", False)
    notes: list[str] = []
    assert choose_robot([log], notes.append) == "dvrk-classic"
    # 15 micrometres in the middle: joints and poses of a moving arm are from different ticks.
    assert "to 0.015 mm; dvrk-si differs in limits only" in notes[0]
    found = readings_of(log, "instrument", CLASSIC.arms["instrument"], silent)
    assert found.values[0, 2] == pytest.approx(148.90224, abs=1e-4)  # metres in the bag


def test_joints_by_name_and_by_place() -> None:
    arm = CLASSIC.arms["instrument"]
    names = [joint.name for joint in arm.joints]
    values = np.arange(6.0) / 10
    shuffled = [3, 1, 0, 2, 5, 4]
    log = ArmLog("PSM1", [0], [values[shuffled]], tuple(f"outer_{names[i]}" for i in shuffled))
    assert readings_of(log, "instrument", arm, silent).values[0].tolist() == [0.0, 0.1, 200.0, 0.3, 0.4, 0.5]
    notes: list[str] = []
    log = ArmLog("PSM1", [0], [values], tuple("abcdef"))
    assert readings_of(log, "instrument", arm, notes.append).values[0, 2] == 200.0
    assert any("taken in the robot's order" in note for note in notes)
    with pytest.raises(RecordingError, match="expected 6 joints"):
        readings_of(ArmLog("PSM1", [0], [values[:4]]), "instrument", arm, silent)


def test_repeated_stamps_are_left_out() -> None:
    arm = CLASSIC.arms["laparoscope"]
    log = ArmLog("ECM", [5, 5, 4, 7], [np.full(4, float(i)) for i in range(4)])
    notes: list[str] = []
    found = readings_of(log, "laparoscope", arm, notes.append)
    assert found.ns.tolist() == [5, 7] and found.values[:, 0].tolist() == [0.0, 3.0]
    assert any("2 samples with a repeated stamp" in note for note in notes)
