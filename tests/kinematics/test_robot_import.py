"""Robots of other programs' files against forward kinematics that this test writes out itself."""

import json
import math
import re
from pathlib import Path

import numpy as np
import pytest
import torch
from scipy.spatial.transform import Rotation

from rmis_calib.cli import main
from rmis_calib.cli.equipment import robot_text
from rmis_calib.errors import RobotError
from rmis_calib.io.configs import config_names
from rmis_calib.io.dvrk_robot import end_T_scope, import_dvrk, read_json5
from rmis_calib.io.robot import load_robot
from rmis_calib.kinematics import RobotKinematics, check_robot
from rmis_calib.kinematics.robot_check import random_readings
from rmis_calib.kinematics.urdf import robot_from_urdf

MICROMETRE = 1e-3  # mm


def turn(axis: str, angle: np.ndarray) -> np.ndarray:
    T = np.broadcast_to(np.eye(4), (len(angle), 4, 4)).copy()
    T[:, :3, :3] = Rotation.from_euler(axis, angle[:, None]).as_matrix()
    return T


def shift(axis: int, length: np.ndarray) -> np.ndarray:
    T = np.broadcast_to(np.eye(4), (len(length), 4, 4)).copy()
    T[:, axis, 3] = length
    return T


def dh_by_hand(rows: list[dict], readings: np.ndarray) -> np.ndarray:
    """(N, 4, 4) in metres: Rx(alpha) Tx(A) Rz(theta) Tz(D), straight from the dVRK's file, readings in rad and m."""
    T = np.broadcast_to(np.eye(4), (len(readings), 4, 4))
    for row, q in zip(rows, readings.T, strict=True):
        q = q + row["offset"]
        alpha = row["alpha"] if abs(abs(row["alpha"]) - 1.5708) > 1e-9 else math.copysign(math.pi / 2, row["alpha"])
        theta = row["theta"] + (q if row["type"] == "revolute" else 0 * q)
        d = row["D"] + (q if row["type"] == "prismatic" else 0 * q)
        ones = np.ones(len(readings))
        T = T @ turn("x", alpha * ones) @ shift(0, row["A"] * ones) @ turn("z", theta) @ shift(2, d)
    return T


def rows_of(path: Path) -> list[dict]:
    table = json.loads(re.sub(r"//.*|/\*.*?\*/", "", path.read_text()))["DH"]
    return table.get("joints") or table["links"]


@pytest.mark.parametrize("arm_file", ["PSM.json", "PSM_Si.json"])
def test_every_arm_and_tool_of_the_dvrk(shared_data: Path, arm_file: str) -> None:
    folder = shared_data / "dvrk" / "config"
    tools = sorted(path for path in (folder / "tool").glob("*.json") if path.name != "index.json")
    assert len(tools) > 50
    ecm = folder / "kinematic" / ("ECM.json" if arm_file == "PSM.json" else "ECM_Si.json")
    for tool in tools:
        robot = import_dvrk(folder / "kinematic" / arm_file, tool, ecm)
        kinematics = RobotKinematics(robot, "laparoscope", "instrument")
        readings = random_readings(robot.arms["instrument"], 20)
        pose = kinematics.instrument(torch.from_numpy(readings))
        metres = np.where([joint.type == "prismatic" for joint in robot.arms["instrument"].joints], 1e-3, 1.0)
        expected = dh_by_hand(rows_of(folder / "kinematic" / arm_file) + rows_of(tool), readings * metres)
        np.testing.assert_allclose(
            pose.rcm_p_head.numpy(), 1000 * expected[:, :3, 3], atol=MICROMETRE, err_msg=tool.name
        )
        shaft = dh_by_hand((rows_of(folder / "kinematic" / arm_file) + rows_of(tool))[:4], (readings * metres)[:, :4])
        np.testing.assert_allclose(pose.rcm_v_axis.numpy(), shaft[:, :3, 2], atol=1e-9, err_msg=tool.name)
    report = check_robot(robot)[1]
    assert max(report.rcm_moves_mm or 0.0, report.shaft_misses_mm or 0.0) < MICROMETRE
    endoscope = random_readings(robot.arms["laparoscope"], 20)
    expected = dh_by_hand(rows_of(ecm), endoscope * [1, 1, 1e-3, 1])
    found = kinematics.base_T_arm(torch.from_numpy(endoscope)).numpy()
    np.testing.assert_allclose(found[:, :3, 3], 1000 * expected[:, :3, 3], atol=MICROMETRE)
    straight = np.array([[0, 1, 0], [-1, 0, 0], [0, 0, 1]])
    np.testing.assert_allclose(found[:, :3, :3], expected[:, :3, :3] @ straight, atol=1e-9)


@pytest.mark.parametrize(
    ("log", "arm_file", "tool", "others"),
    [
        ("classic_tool_fixed.csv", "PSM.json", "LARGE_NEEDLE_DRIVER_400006.json", 138),
        ("Si_tool_fixed.csv", "PSM.json", "LARGE_NEEDLE_DRIVER_420006.json", 145),
    ],
)
def test_recorded_poses(shared_data: Path, log: str, arm_file: str, tool: str, others: int) -> None:
    folder = shared_data / "dvrk" / "config"
    robot = import_dvrk(folder / "kinematic" / arm_file, folder / "tool" / tool)
    rows = np.loadtxt(shared_data / "dvrk" / log, delimiter=",", skiprows=1)
    joints = torch.from_numpy(rows[:, 1:7] * [1, 1, 1000, 1, 1, 1])
    error = RobotKinematics(robot, None, "instrument").instrument(joints).rcm_p_head.numpy() - 1000 * rows[:, 7:10]
    # The rest were logged with joints and pose of different ticks (test_dvrk_logs.py).
    assert (np.linalg.norm(error, axis=-1) >= MICROMETRE).sum() == others


def test_the_imported_classic_is_the_shipped_one(shared_data: Path) -> None:
    folder = shared_data / "dvrk" / "config"
    found = import_dvrk(
        folder / "kinematic" / "PSM.json",
        folder / "tool" / "LARGE_NEEDLE_DRIVER_400006.json",
        folder / "kinematic" / "ECM.json",
    )
    shipped = load_robot("dvrk-classic")
    for name, arm in shipped.arms.items():
        assert found.arms[name].joints == arm.joints
        np.testing.assert_array_equal(found.arms[name].end_T_tool, arm.end_T_tool)
        assert (found.arms[name].rcm_frame, found.arms[name].shaft_frame) == (arm.rcm_frame, arm.shaft_frame)


def test_endoscopes_of_30_degrees() -> None:
    # The view (z) of a scope that looks down leans towards -y of the straight scope by 30 deg (R = Rx(30 deg)).
    down = np.linalg.inv(end_T_scope("straight")) @ end_T_scope("down")
    np.testing.assert_allclose(down[:3, 2], [0.0, -0.5, math.sqrt(0.75)], atol=1e-12)
    np.testing.assert_allclose((end_T_scope("up") @ np.linalg.inv(end_T_scope("straight")))[:3, 3], 0.0)


def row(name: str, kind: str, offset: float, alpha: float = 0.0, d: float = 0.0, **limits: float) -> dict:
    return {"name": name, "alpha": alpha, "A": 0.0, "theta": 0.0, "D": d, "type": kind, "offset": offset} | limits


def chain(*rows: dict) -> dict:
    return {"DH": {"convention": "modified", "joints": list(rows)}}


ARM = chain(
    row("yaw", "revolute", 1.5708, 1.5708, qmin=-1.5, qmax=1.5),
    row("pitch", "revolute", -1.5708, -1.5708),
    row("insertion", "prismatic", -0.4318, 1.5708),
)
TOOL = chain(row("outer_roll", "revolute", 0.0, d=0.4162))
ECM = {"DH": {"convention": "modified", "links": ARM["DH"]["joints"]}}


def dvrk_files(folder: Path, system: dict | None = None) -> dict[str, Path]:
    (folder / "kinematic").mkdir()
    (folder / "arm").mkdir()
    paths = {"arm": folder / "arm" / "PSM2.json", "tool": folder / "tool.json", "ecm": folder / "ECM.json"}
    (folder / "kinematic" / "PSM.json").write_text("// comment\n" + json.dumps(ARM))
    paths["arm"].write_text('{"kinematic": "kinematic/PSM.json", // found from here\n}')
    paths["tool"].write_text(json.dumps(TOOL))
    paths["ecm"].write_text(json.dumps(ECM))
    if system is not None:
        paths["system"] = folder / "system.json"
        paths["system"].write_text(json.dumps(system))
    return paths


def placed(x_m: float) -> list[list[float]]:
    return [[0, -1, 0, x_m], [1, 0, 0, 0.2], [0, 0, 1, 0], [0, 0, 0, 1]]


@pytest.mark.parametrize("dialect", ["new", "old", "suj-fixed"])
def test_bases_of_a_system_file(tmp_path: Path, dialect: str) -> None:
    def arm(name: str, x_m: float) -> dict:
        if dialect == "suj-fixed":
            return {"name": name, "measured_cp": placed(x_m)}
        keys = ("base_frame", "reference_frame") if dialect == "new" else ("base-frame", "reference-frame")
        return {"name": name, keys[0]: {keys[1]: "cart", "transform": placed(x_m)}}

    paths = dvrk_files(tmp_path, {"arms": [arm("PSM1", 0.3), arm("PSM2", 0.1), arm("ECM", -0.1)]})
    robot = import_dvrk(paths["arm"], paths["tool"], paths["ecm"], paths["system"])
    assert robot.arms["instrument"].joints[3].name == "roll"
    # Metres there, millimetres here; PSM2 by the name of the file. Counter-literal: PSM1's would be 300.
    assert np.asarray(robot.arms["instrument"].base_T_arm_base)[:3, 3].tolist() == [100.0, 200.0, 0.0]
    assert np.asarray(robot.arms["laparoscope"].base_T_arm_base)[:3, 3].tolist() == [-100.0, 200.0, 0.0]
    assert np.asarray(robot.arms["laparoscope"].base_T_arm_base)[:2, :2].tolist() == [[0.0, -1.0], [1.0, 0.0]]


def test_bases_in_different_frames_are_not_used(tmp_path: Path) -> None:
    frames = [{"reference_frame": name, "transform": placed(0.1)} for name in ("left_camera", "cart")]
    system = {"arms": [{"name": n, "base_frame": f} for n, f in zip(("PSM2", "ECM"), frames, strict=True)]}
    paths = dvrk_files(tmp_path, system)
    notes: list[str] = []
    robot = import_dvrk(paths["arm"], paths["tool"], paths["ecm"], paths["system"], note=notes.append)
    assert any("different frames (left_camera and cart)" in note for note in notes)
    assert any("base_T_arm_base is left out" in note for note in notes)
    assert all(arm.base_T_arm_base is None for arm in robot.arms.values())


def test_every_configuration_file_is_read(shared_data: Path) -> None:
    """Against the standard library's parser, once comments are cut out by hand."""
    files = sorted((shared_data / "dvrk" / "config").rglob("*.json"))
    assert len(files) > 60
    for path in files:
        plain = re.sub(r"//.*|/\*.*?\*/", "", path.read_text(encoding="utf-8-sig"))
        plain = re.sub(r",(\s*[\]}])", r"\1", re.sub(r"/\*.*?\*/", "", plain, flags=re.DOTALL))
        assert read_json5(path) == json.loads(plain), path.name


def test_real_placements_on_the_ecm_are_read_and_written_again(shared_data: Path, tmp_path: Path) -> None:
    files = sorted((shared_data / "dvrk" / "registrations").rglob("*-registration-dVRK.json"))
    assert len(files) == 4
    paths = dvrk_files(tmp_path)
    for path in files:
        real = json.loads(path.read_text())
        arms = [{"name": "ECM", "measured_cp": np.eye(4).tolist()}, real]  # as suj-fixed.json has them
        system = tmp_path / f"{path.parent.name}-{path.name}"
        system.write_text(json.dumps({"arms": arms}))
        robot = import_dvrk(paths["arm"], paths["tool"], paths["ecm"], system, instrument_name=real["name"])
        again = tmp_path / f"{system.stem}.yaml"
        again.write_text(robot_text(robot))
        found = np.asarray(load_robot(again).arms["instrument"].base_T_arm_base)
        metres = found * np.where(np.arange(4) == 3, [[1e-3], [1e-3], [1e-3], [1.0]], 1.0)
        np.testing.assert_allclose(metres, real["measured_cp"], rtol=0, atol=1e-12)


def test_registrations_with_and_without_braces(shared_data: Path, tmp_path: Path) -> None:
    files = sorted((shared_data / "dvrk" / "registrations").rglob("*.json"))
    assert files
    for path in files:
        raw = read_json5(path)
        matrix = np.array(raw["measured_cp"] if "measured_cp" in raw else raw["base-frame"]["transform"])
        np.testing.assert_allclose(matrix[:3, :3].T @ matrix[:3, :3], np.eye(3), atol=1e-6)
    (tmp_path / "a.json").write_text('"base-frame": {"reference-frame": "x", "transform": [[1]]}')
    assert read_json5(tmp_path / "a.json")["base-frame"]["reference-frame"] == "x"


@pytest.mark.parametrize(
    ("name", "message"),
    [("PSM_Si_physical.json", "virtual chain"), ("MTML.json", "expected DH convention modified")],
)
def test_chains_without_a_table_are_refused(shared_data: Path, name: str, message: str) -> None:
    folder = shared_data / "dvrk" / "config"
    with pytest.raises(RobotError, match=message):
        import_dvrk(folder / "kinematic" / name, folder / "tool" / "LARGE_NEEDLE_DRIVER_400006.json")


def test_import_show_and_check_on_the_command_line(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    arms = [
        {"name": n, "base_frame": {"reference_frame": "cart", "transform": placed(x)}}
        for n, x in (("PSM2", 0.1), ("ECM", 0.2))
    ]
    paths = dvrk_files(tmp_path, {"arms": arms})
    out = tmp_path / "robot.yaml"
    command = ["robots", "import", str(paths["arm"]), "--tool", str(paths["tool"]), "--ecm", str(paths["ecm"])]
    assert main([*command, "--system", str(paths["system"]), "--out", str(out)]) == 0
    imported = import_dvrk(paths["arm"], paths["tool"], paths["ecm"], paths["system"])
    found = load_robot(out)
    assert {name: arm.joints for name, arm in found.arms.items()} == {n: arm.joints for n, arm in imported.arms.items()}
    capsys.readouterr()
    assert main(["robots", "show", str(out)]) == 0
    (tmp_path / "again.yaml").write_text(capsys.readouterr().out)
    assert load_robot(tmp_path / "again.yaml").arms["instrument"].joints == imported.arms["instrument"].joints
    assert main(["robots", "check", str(out)]) == 0
    assert "shaft misses the RCM by" in capsys.readouterr().out
    assert (tmp_path / "robot_robot.png").stat().st_size > 1000
    assert main([*command, "--out", str(out)]) == 2  # it is there already


def test_a_wrong_shaft_is_a_problem(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    paths = dvrk_files(tmp_path)
    out = tmp_path / "robot.yaml"
    assert main(["robots", "import", str(paths["arm"]), "--tool", str(paths["tool"]), "--out", str(out)]) == 0
    text = out.read_text()
    out.write_text(
        text.replace(
            "name: pitch, type: revolute, alpha_rad: -1.5707963267948966, a_mm: 0.0",
            "name: pitch, type: revolute, alpha_rad: -1.5707963267948966, a_mm: 7.0",
        )
    )
    assert out.read_text() != text
    assert main(["robots", "check", str(out), "--out", str(tmp_path / "a.png")]) == 1
    assert "PROBLEM: the shaft's axis misses the RCM by up to" in capsys.readouterr().out


def test_shipped_robots_keep_their_rcm(capsys: pytest.CaptureFixture[str]) -> None:
    for name in config_names("robots"):
        for report in check_robot(load_robot(name)):
            assert not [p for p in report.problems if "base_T_arm_base" not in p], (name, report.problems)
            if report.is_instrument:
                assert (report.rcm_moves_mm or 0) < MICROMETRE and (report.shaft_misses_mm or 0) < MICROMETRE
    assert main(["robots", "list"]) == 0
    assert "raven-ii" in capsys.readouterr().out


def test_raven_against_its_own_constants() -> None:
    """FK written out from the robot's published constants: La12 75 deg, La23 52 deg, d4 -0.47 m, Lw 13 mm."""
    robot = load_robot("raven-ii")
    readings = np.array([[0.3, -0.4, 395.0, 0.7, 0.2, -0.3], [-0.2, 0.5, 430.0, -1.1, -0.5, 0.4]])
    for arm, alpha1, alpha3, theta3, j1, j2 in (
        ("gold", 0.0, 180.0 - 52.0, 90.0, 205.0, 180.0),
        ("green", 180.0, 52.0, -90.0, 25.0, 0.0),
    ):
        ones = np.ones(2)
        q = readings.T
        table = (
            (alpha1, 0, q[0] + math.radians(j1), 0 * ones), (75.0, 0, q[1] + math.radians(j2), 0 * ones),
            (alpha3, 0, math.radians(theta3) * ones, q[2]), (0.0, 0, q[3], -470.0 * ones),
            (90.0, 0, q[4] - math.pi / 2, 0 * ones), (90.0, 13.0, q[5], 0 * ones),
        )  # fmt: skip
        T = np.broadcast_to(np.eye(4), (2, 4, 4))
        for alpha, a, theta, d in table:
            T = T @ turn("x", math.radians(alpha) * ones) @ shift(0, a * ones) @ turn("z", theta) @ shift(2, d)
        pose = RobotKinematics(robot, None, arm).instrument(torch.from_numpy(readings))
        np.testing.assert_allclose(pose.rcm_p_head.numpy(), T[:, :3, 3], atol=1e-9)
        # The shaft runs from the RCM to the tip: the head lies ahead on it.
        assert bool(((pose.rcm_p_head * pose.rcm_v_axis).sum(-1) > 20.0).all()) and bool((pose.rcm_s_end_mm > 0).all())


def test_a_real_urdf(shared_data: Path) -> None:
    xml = (shared_data / "dvrk" / "config" / "PSM1.urdf").read_bytes()
    robot = robot_from_urdf(xml, "psm1", "PSM1_tool_wrist_link", "PSM1_tool_wrist_sca_link")
    (report,) = check_robot(robot)
    assert report.rcm_moves_mm is not None and report.rcm_moves_mm < MICROMETRE
    assert report.shaft_misses_mm is not None and report.shaft_misses_mm < MICROMETRE and not report.problems
    # The same arm in the dVRK's own table: the head moves by the same distances between the same readings.
    folder = shared_data / "dvrk" / "config"
    table = import_dvrk(folder / "kinematic" / "PSM.json", folder / "tool" / "LARGE_NEEDLE_DRIVER_400006.json")
    readings = torch.from_numpy(random_readings(table.arms["instrument"], 30))
    readings[:, 4:] = 0.0  # the URDF's wrist has lengths of its own
    heads = [
        RobotKinematics(r, None, "instrument").instrument(readings[:, : len(r.arms["instrument"].joints)])
        for r in (robot, table)
    ]
    angles = [h.rcm_v_axis @ h.rcm_v_axis.mT for h in heads]
    torch.testing.assert_close(angles[0], angles[1], atol=1e-4, rtol=0)


PARALLELOGRAM = """<robot name="a"><link name="base"/><link name="yaw"/><link name="back"/><link name="carriage"/>
<link name="tool"/><link name="shaft"/><link name="tip"/>
<joint name="yaw" type="revolute"><parent link="base"/><child link="yaw"/><axis xyz="0 0 1"/>
  <origin rpy="0 1.5708 0" xyz="0 0 0"/><limit lower="-1" upper="1" effort="1" velocity="1"/></joint>
<joint name="pitch" type="revolute"><parent link="yaw"/><child link="back"/><axis xyz="0 1 0"/>
  <origin rpy="0 0 0" xyz="0 0 0.3"/><limit lower="-1" upper="1" effort="1" velocity="1"/></joint>
<joint name="bottom" type="continuous"><parent link="back"/><child link="carriage"/><axis xyz="0 1 0"/>
  <origin rpy="0 0 0" xyz="0.2 0 0"/><mimic joint="pitch" multiplier="-1"/></joint>
<joint name="front" type="continuous"><parent link="carriage"/><child link="tool"/><axis xyz="0 1 0"/>
  <origin rpy="0 0 0" xyz="0 0 -0.3"/><mimic joint="pitch"/></joint>
<joint name="insertion" type="prismatic"><parent link="tool"/><child link="shaft"/><axis xyz="-1 0 0"/>
  <origin rpy="0 0 0" xyz="0 0 0"/><limit lower="0.25" upper="0.4" effort="1" velocity="1"/></joint>
<joint name="fixed" type="fixed"><parent link="shaft"/><child link="tip"/><origin rpy="0 0 0" xyz="-0.01 0 0"/></joint>
</robot>"""


def test_mimic_joints_of_a_parallelogram() -> None:
    """A parallelogram of 300 by 200 mm whose far side pivots about the yaw axis: no joint is at the remote centre."""
    robot = robot_from_urdf(PARALLELOGRAM.encode(), "a", "shaft", "tip")
    (report,) = check_robot(robot)
    assert report.shaft_misses_mm is not None and report.shaft_misses_mm < MICROMETRE and not report.problems
    pose = RobotKinematics(robot, None, "instrument").instrument(torch.tensor([[0.0, 0.0, 300.0]], dtype=torch.float64))
    # 200 mm out on the parallelogram, 300 + 10 back along the shaft: 110 mm beyond the RCM.
    assert float(pose.rcm_p_head.norm()) == pytest.approx(110.0, abs=1e-3)


def test_urdf_mistakes_are_one_clear_line() -> None:
    with pytest.raises(RobotError, match="expected a robot in URDF"):
        robot_from_urdf(b"<robot", "a", "shaft", "tip")
    with pytest.raises(RobotError, match="expected a link 'nowhere'"):
        robot_from_urdf(PARALLELOGRAM.encode(), "a", "shaft", "nowhere")
    wandering = PARALLELOGRAM.replace('multiplier="-1"', 'multiplier="-0.5"')
    with pytest.raises(RobotError, match="expected joints that each turn about, or slide along, one axis"):
        robot_from_urdf(wandering.encode(), "a", "shaft", "tip")
