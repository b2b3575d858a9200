"""Every format, read back by a reader that knows nothing of this program, with numbers derived by hand.

The answer: camera_right_T_arm turns by +90 degrees about z and shifts by (10, 20, 30) mm. Its inverse, where the camera
is in the arm's frame, turns by -90 degrees and shifts by -R^T t = (-20, 10, -30) mm. With ISI axes (x left, y up) the
camera's frame is turned by half a turn about z: +90 degrees, and the place stays.
"""

import csv
import json
import math
from dataclasses import replace
from pathlib import Path
from xml.etree import ElementTree

import cv2
import numpy as np
import pytest
import pytorch_kinematics
import torch
import yaml
from rosbags.typesys import Stores, get_typestore
from scipy.spatial.transform import Rotation

import rmis_calib as rc
from rmis_calib.errors import CalibrationFailed, InputError, OutputError
from rmis_calib.exports import FORMATS
from rmis_calib.exports.hand_eye import HandEye, rpy_rad
from rmis_calib.exports.settings import FORMAT_NAMES
from rmis_calib.geometry.rigid import RigidTransform
from rmis_calib.results import CalibrationResult, Motions

HALF = math.sqrt(0.5)
POSE_M = [-0.02, 0.01, -0.03, 0.0, 0.0, -HALF, HALF]
"""arm_T_camera_right: x y z qx qy qz qw. In mm the first would be -20; as wxyz the last four HALF, 0, 0, -HALF."""
OTHER_WAY_M = [0.01, 0.02, 0.03, 0.0, 0.0, HALF, HALF]
"""camera_right_T_arm."""
ISI_M = [-0.02, 0.01, -0.03, 0.0, 0.0, HALF, HALF]
"""arm_T_camera_right with ISI axes of the camera."""
LEFT_M = [-0.02, 0.015, -0.03, 0.0, 0.0, -HALF, HALF]
"""arm_T_camera_left: the left camera is 5 mm to the left of the right one, which is -x of it and +y of the arm."""
SINGLE_FILES = [name for name in FORMAT_NAMES if FORMATS[name].file is not None]


def transform(dst: str, src: str, R: np.ndarray, t_mm: list[float]) -> RigidTransform:
    matrix = np.eye(4)
    matrix[:3, :3], matrix[:3, 3] = R, t_mm
    return RigidTransform(dst, src, torch.from_numpy(matrix))


@pytest.fixture
def result() -> CalibrationResult:
    quarter = np.array([[0.0, -1.0, 0.0], [1.0, 0.0, 0.0], [0.0, 0.0, 1.0]])
    return CalibrationResult(
        status="ok",
        message="The result passed its own checks",
        method="joint",
        camera_right_T_arm=transform("camera_right", "arm", quarter, [10.0, 20.0, 30.0]),
        camera_left_T_camera_right=transform("camera_left", "camera_right", np.eye(3), [5.0, 0.0, 0.0]),
        covariance=np.diag([1e-6, 2e-6, 3e-6, 0.01, 0.04, 0.09]),
        observability={"verdict": "trustworthy", "sentences": ["all seen"]},
        motions=Motions(np.array([True]), ("",), np.array([0.0])),
        nuisances={"clock": {"value": 0.25, "sigma": 0.01, "unit": "s", "held": False}},
    )


@pytest.fixture
def weak(result: CalibrationResult) -> CalibrationResult:
    return replace(result, status="weak", message='Too loose to be trusted -- <move> more: "much"')


def quaternion_matrix(pose: list[float]) -> np.ndarray:
    matrix = np.eye(4)
    matrix[:3, :3], matrix[:3, 3] = Rotation.from_quat(pose[3:]).as_matrix(), pose[:3]
    return matrix


def is_pose(values: list[float], expected: list[float]) -> bool:
    """Whether x y z qx qy qz qw is the pose, q and -q being one rotation."""
    return np.allclose(values[:3], expected[:3], atol=1e-15) and math.isclose(
        abs(float(np.dot(values[3:], expected[3:]))), 1.0, abs_tol=1e-12
    )


def test_tum(result, tmp_path):
    row = np.loadtxt(rc.export(result, "tum", tmp_path / "pose.txt"))
    assert row.shape == (8,) and row[0] == 0.0
    assert is_pose(row[1:].tolist(), POSE_M) and not is_pose(row[1:].tolist(), OTHER_WAY_M)


@pytest.mark.parametrize(
    ("settings", "expected"),
    [
        ({}, POSE_M),
        ({"axes": "isi"}, ISI_M),
        ({"camera": "left"}, LEFT_M),
    ],
)
def test_camera_and_axes_are_those_asked_for(result, tmp_path, settings, expected):
    path = rc.export(result, "tum", tmp_path / "pose.txt", settings=rc.ExportSettings(**settings))
    assert is_pose(np.loadtxt(path)[1:].tolist(), expected)
    words = {"opencv": "x right, y down", "isi": "x left, y up"}[settings.get("axes", "opencv")]
    assert words in path.read_text()


def test_ethz(result, tmp_path):
    raw = json.loads(rc.export(result, "ethz", tmp_path / "calibration.json").read_text())
    t, q = raw["translation"], raw["rotation"]
    assert is_pose([t["x"], t["y"], t["z"], q["i"], q["j"], q["k"], q["w"]], POSE_M)
    # Joint time = frame time + 0.25 s; theirs: eye time = hand time + delay.
    assert raw["delay"] == -0.25
    assert not any("NOT CONSTANT" in line for line in raw["about"])


@pytest.mark.parametrize(("held", "said"), [(False, True), (True, False)])
def test_ethz_says_that_one_delay_is_not_all_where_the_clocks_differ_in_rate(result, tmp_path, held, said):
    rate = {"clock_rate": {"value": 0.04, "sigma": 0.001, "unit": "relative", "held": held}}
    slow = replace(result, nuisances=result.nuisances | rate)
    raw = json.loads(rc.export(slow, "ethz", tmp_path / "calibration.json").read_text())
    assert raw["delay"] == -0.25
    # By hand: 10 s after the middle, joint time = frame time + 0.25 + 0.4 s: the delay falls by 0.04 s a second.
    assert any("NOT CONSTANT" in line and "-0.04 s a second" in line for line in raw["about"]) == said


def test_easy_handeye2(result, tmp_path):
    raw = yaml.safe_load(rc.export(result, "easy-handeye2", tmp_path / "ecm.calib").read_text())
    t, q = raw["transform"]["translation"], raw["transform"]["rotation"]
    assert is_pose([t["x"], t["y"], t["z"], q["x"], q["y"], q["z"], q["w"]], POSE_M)
    # Fields and types of msg/HandeyeCalibrationParameters.msg.
    types = {key: type(value) for key, value in raw["parameters"].items()}
    words = "name calibration_type robot_base_frame robot_effector_frame tracking_base_frame tracking_marker_frame"
    words += " move_group_namespace move_group"
    assert types == dict.fromkeys(words.split(), str) | {"freehand_robot_movement": bool}
    assert raw["parameters"]["calibration_type"] == "eye_in_hand"
    assert raw["parameters"]["robot_effector_frame"] == "arm"
    assert raw["parameters"]["tracking_base_frame"] == "camera_right"


def test_easy_handeye2_of_a_camera_that_stands_still_hangs_on_the_base(result, tmp_path):
    settings = rc.ExportSettings(eye_on_base=True, arm_frame="world")
    raw = yaml.safe_load(rc.export(result, "easy-handeye2", tmp_path / "f.calib", settings=settings).read_text())
    assert raw["parameters"]["calibration_type"] == "eye_on_base"
    assert raw["parameters"]["robot_base_frame"] == "world"


@pytest.mark.parametrize("to", ["opencv-json", "opencv-yaml"])
def test_opencv(result, tmp_path, to):
    path = rc.export(result, to, tmp_path / f"hand_eye{'.json' if to == 'opencv-json' else '.yaml'}")
    storage = cv2.FileStorage(str(path), cv2.FILE_STORAGE_READ)
    np.testing.assert_allclose(storage.getNode("camera_right_T_arm").mat(), quaternion_matrix(OTHER_WAY_M), atol=1e-15)
    np.testing.assert_allclose(storage.getNode("arm_T_camera_right").mat(), quaternion_matrix(POSE_M), atol=1e-15)
    np.testing.assert_allclose(storage.getNode("arm_T_camera_left").mat(), quaternion_matrix(LEFT_M), atol=1e-15)
    # calibrateHandEye's answer maps camera to gripper.
    np.testing.assert_allclose(storage.getNode("t_cam2gripper").mat()[:, 0], POSE_M[:3], atol=1e-15)
    np.testing.assert_allclose(storage.getNode("R_cam2gripper").mat(), quaternion_matrix(POSE_M)[:3, :3], atol=1e-15)
    # 0.01 mm^2 is 1e-8 m^2; radians stay.
    covariance = storage.getNode("covariance_camera_right_T_arm").mat()
    np.testing.assert_allclose(np.diag(covariance), [1e-6, 2e-6, 3e-6, 1e-8, 4e-8, 9e-8], rtol=1e-12)
    assert storage.getNode("status").string() == "ok"
    if to == "opencv-json":
        assert set(json.loads(path.read_text())) >= {"about", "camera_right_T_arm"}


def test_urdf(result, tmp_path):
    text = rc.export(result, "urdf-origin", tmp_path / "hand_eye.urdf").read_text()
    for camera, pose in (("camera_right", POSE_M), ("camera_left", LEFT_M)):
        chain = pytorch_kinematics.build_serial_chain_from_urdf(text.encode(), camera).to(dtype=torch.float64)
        at = chain.forward_kinematics(torch.zeros(1, 0, dtype=torch.float64)).get_matrix()[0].numpy()
        np.testing.assert_allclose(at, quaternion_matrix(pose), atol=1e-7)  # that library computes in float32 in part
    origin = ElementTree.fromstring(text).find("joint/origin")
    assert origin is not None
    np.testing.assert_allclose([float(x) for x in origin.attrib["xyz"].split()], POSE_M[:3], atol=1e-15)
    np.testing.assert_allclose([float(x) for x in origin.attrib["rpy"].split()], [0, 0, -math.pi / 2], atol=1e-15)


def test_rpy_is_scipys_also_where_pitch_is_90_degrees():
    for rotation in Rotation.random(50, random_state=1):
        np.testing.assert_allclose(rpy_rad(rotation.as_matrix()), rotation.as_euler("xyz"), atol=1e-12)
    for pitch in (90.0, -90.0):
        locked = Rotation.from_euler("xyz", [0.3, math.radians(pitch), -0.7])
        again = Rotation.from_euler("xyz", rpy_rad(locked.as_matrix()))
        assert (again.inv() * locked).magnitude() < 1e-7


def test_moveit(result, tmp_path):
    root = ElementTree.fromstring(rc.export(result, "moveit", tmp_path / "camera.launch").read_text())
    node = root.find("node")
    assert node is not None and (node.attrib["pkg"], node.attrib["type"]) == ("tf2_ros", "static_transform_publisher")
    words = node.attrib["args"].split()
    assert is_pose([float(word) for word in words[:7]], POSE_M) and words[7:] == ["arm", "camera_right"]


def test_ros_static_tf(result, tmp_path):
    settings = rc.ExportSettings(arm_frame="ECM", camera_right_frame="scope/right")
    folder = rc.export(result, "ros-static-tf", tmp_path / "tf", settings=settings)
    ros1 = ElementTree.parse(folder / "ros1.launch").getroot().findall("node")
    ros2 = ElementTree.parse(folder / "ros2.launch.xml").getroot().findall("node")
    expected = [("scope/right", POSE_M), ("camera_left", LEFT_M)]
    for node, (camera, pose) in zip(ros1, expected, strict=True):
        words = node.attrib["args"].split()
        assert is_pose([float(word) for word in words[:7]], pose) and words[7:] == ["ECM", camera]
    for node, (camera, pose) in zip(ros2, expected, strict=True):
        words = node.attrib["args"].split()
        flags = dict(zip(words[::2], words[1::2], strict=True))
        assert (flags.pop("--frame-id"), flags.pop("--child-frame-id")) == ("ECM", camera)
        assert is_pose([float(flags[f"--{name}"]) for name in ("x", "y", "z", "qx", "qy", "qz", "qw")], pose)
    lines = (folder / "commands.txt").read_text().splitlines()
    assert sum(line.startswith("rosrun tf2_ros static_transform_publisher -0.02 ") for line in lines) == 2
    assert sum(line.startswith("ros2 run tf2_ros static_transform_publisher --x -0.02 ") for line in lines) == 2


def test_pose_with_covariance_is_a_message_of_ros(result, tmp_path):
    folder = rc.export(result, "ros-static-tf", tmp_path / "tf")
    raw = yaml.safe_load((folder / "pose_with_covariance.yaml").read_text())
    types = get_typestore(Stores.ROS2_HUMBLE).types
    point = types["geometry_msgs/msg/Point"](**raw["pose"]["pose"]["position"])
    quaternion = types["geometry_msgs/msg/Quaternion"](**raw["pose"]["pose"]["orientation"])
    pose = types["geometry_msgs/msg/Pose"](point, quaternion)
    message = types["geometry_msgs/msg/PoseWithCovariance"](pose, np.array(raw["pose"]["covariance"]))
    store = get_typestore(Stores.ROS2_HUMBLE)
    data = store.serialize_cdr(message, message.__msgtype__)
    again = store.deserialize_cdr(data, message.__msgtype__)
    assert again.pose.position.x == pytest.approx(-0.02, abs=1e-15) and again.pose.orientation.w == pytest.approx(HALF)
    # Rotation about the arm's x is that about the camera's y (R^T turns by -90 degrees): ROS counts it fourth.
    covariance = again.covariance.reshape(6, 6)
    np.testing.assert_allclose(np.diag(covariance)[3:], [2e-6, 1e-6, 3e-6], rtol=1e-9)


def test_covariance_of_the_other_direction_is_that_of_samples(result):
    R, t = Rotation.from_rotvec([0.3, -0.5, 0.9]).as_matrix(), np.array([0.02, -0.01, 0.05])
    matrix = np.eye(4)
    matrix[:3, :3], matrix[:3, 3] = R, t
    root = np.random.default_rng(2).normal(size=(6, 6)) * 1e-4
    item = HandEye("camera", "arm", "opencv", matrix, root @ root.T)
    samples = np.random.default_rng(3).normal(size=(40_000, 6)) @ root.T
    turned = Rotation.from_rotvec(samples[:, :3]).as_matrix() @ R
    back_R = turned.transpose(0, 2, 1)
    back_t = -(back_R @ (t + samples[:, 3:])[..., None])[..., 0]
    dphi = Rotation.from_matrix(back_R @ R).as_rotvec()
    measured = np.cov(np.concatenate([dphi, back_t + R.T @ t], axis=1).T)
    assert item.arm_covariance is not None
    # 40,000 samples give a variance to 0.7 %.
    assert np.abs(measured - item.arm_covariance).max() < 0.03 * np.abs(item.arm_covariance).max()


def test_csv_has_both_directions_and_both_cameras(result, tmp_path):
    with rc.export(result, "csv", tmp_path / "hand_eye.csv").open(newline="") as stream:
        rows = {row["transform"]: row for row in csv.DictReader(stream)}
    expected = {"camera_right_T_arm": OTHER_WAY_M, "arm_T_camera_right": POSE_M, "arm_T_camera_left": LEFT_M}
    assert set(rows) == {*expected, "camera_left_T_arm"}
    for name, pose in expected.items():
        row = rows[name]
        assert is_pose([float(row[key]) for key in ("x_m", "y_m", "z_m", "qx", "qy", "qz", "qw")], pose)
        R = np.array([[float(row[f"r{i}{j}"]) for j in range(3)] for i in range(3)])
        np.testing.assert_allclose(R, quaternion_matrix(pose)[:3, :3], atol=1e-15)
    assert float(rows["camera_right_T_arm"]["cov_y_y"]) == pytest.approx(4e-8)
    assert float(rows["camera_right_T_arm"]["cov_rz_rz"]) == pytest.approx(3e-6)


@pytest.mark.parametrize("to", SINGLE_FILES)
def test_both_directions_are_named(result, tmp_path, to):
    text = rc.export(result, to, tmp_path / "out").read_text()
    assert "arm_T_camera_right" in text and "camera_right_T_arm" in text


@pytest.mark.parametrize("to", [*SINGLE_FILES, "ros-static-tf"])
def test_what_is_not_trustworthy_needs_force_and_says_so(weak, tmp_path, to):
    out = tmp_path / "out"
    with pytest.raises(CalibrationFailed, match="--force"):
        rc.export(weak, to, out)
    assert not out.exists()
    rc.export(weak, to, out, force=True)
    files = [out] if out.is_file() else [path for path in out.iterdir() if path.suffix != ".json"]
    for path in files:
        text = path.read_text()
        assert "NOT TRUSTWORTHY (weak): Too loose to be trusted" in text
        if text.startswith("<"):
            ElementTree.fromstring(text)  # neither hyphens nor brackets of the message break it
    if to in ("ethz", "opencv-json"):
        json.loads(out.read_text())


def test_a_result_without_a_transform_is_never_exported(weak, tmp_path):
    empty = replace(weak, camera_right_T_arm=None)
    with pytest.raises(CalibrationFailed, match="no transform"):
        rc.export(empty, "tum", tmp_path / "out", force=True)


@pytest.mark.parametrize("to", SINGLE_FILES)
def test_nothing_is_overwritten_unasked_and_nothing_foreign_ever(result, tmp_path, to):
    ours, foreign = tmp_path / "ours", tmp_path / "foreign"
    rc.export(result, to, ours)
    with pytest.raises(OutputError, match="--overwrite"):
        rc.export(result, to, ours)
    rc.export(result, to, ours, overwrite=True)
    foreign.write_text("my own notes")
    with pytest.raises(OutputError):
        rc.export(result, to, foreign, overwrite=True)
    assert foreign.read_text() == "my own notes"


def test_the_input_is_never_the_output(result, tmp_path):
    path = tmp_path / "result.json"
    result.write(path)
    before = path.read_bytes()
    with pytest.raises(OutputError, match="input"):
        rc.export(path, "ethz", path, overwrite=True)
    assert path.read_bytes() == before


def test_a_result_exports_itself(result, tmp_path):
    assert result.export("tum", tmp_path / "a") == tmp_path / "a"
    rc.export(result, "tum", tmp_path / "b")
    assert (tmp_path / "a").read_bytes() == (tmp_path / "b").read_bytes()


def test_mistakes_are_named(result, tmp_path):
    with pytest.raises(InputError, match=r"did you mean ethz"):
        rc.export(result, "eth", tmp_path / "out")
    for name in ("dvrk", "surgsync"):
        with pytest.raises(InputError, match="--recording"):
            rc.export(result, name, tmp_path / "out")
    mono = replace(result, camera_left_T_camera_right=None)
    with pytest.raises(InputError, match="only camera"):
        rc.export(mono, "tum", tmp_path / "out", settings=rc.ExportSettings(camera="left"))
    for name in ("a b", "", 'x"', "-x", "<x>"):
        with pytest.raises(ValueError, match="a name of letters"):
            rc.ExportSettings(arm_frame=name)
    assert not list(Path(tmp_path).iterdir())
