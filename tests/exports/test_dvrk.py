"""dvrk and surgsync: registrations of real systems, and a rendered recording with its exact kinematics."""

import json
import shutil
from dataclasses import replace
from pathlib import Path

import cv2
import numpy as np
import pytest
import torch
import yaml
from scipy.optimize import least_squares

import data_synth
import rmis_calib as rc
from data_synth.kinematics import arms_from_dict
from rmis_calib.cli import main
from rmis_calib.errors import InputError
from rmis_calib.exports import read_registration
from rmis_calib.exports.formats.dvrk import registration_text
from rmis_calib.geometry.rigid import RigidTransform
from rmis_calib.io.stereo import read_stereo
from rmis_calib.results import CalibrationResult, Motions

REAL = [
    "matmag01/PSM1-registration-open-cv.json",
    "matmag01/PSM2-registration-open-cv.json",
    "matmag01/resize/PSM1-registration-open-cv.json",
    "matmag01/resize/PSM2-registration-open-cv.json",
    "jhu/PSM2_registration.json",
    "jhu/PSM2_registration1.json",
    "jhu/PSM2_registration2.json",
    "jhu/PSM2_registration3.json",
    "jhu/PSM2_registration_big_grid.json",
    "jhu/PSM2_registration_small_grid.json",
]
ISI = np.diag([-1.0, -1.0, 1.0, 1.0])
"""x left and y up where OpenCV has x right and y down."""


@pytest.mark.parametrize("name", REAL)
def test_real_registrations_are_read_and_written_again_as_they_were(shared_data: Path, name: str):
    path = shared_data / "dvrk" / "registrations" / name
    original = json.loads(path.read_text())
    assert json.loads(registration_text(*read_registration(path))) == original


@pytest.mark.parametrize("psm", ["PSM1", "PSM2"])
@pytest.mark.parametrize("folder", ["matmag01", "matmag01/resize"])
def test_a_real_pair_hangs_on_an_endoscope_with_isi_axes(shared_data: Path, folder: str, psm: str):
    # dVRK file = ecm_base_T_tip @ ISI @ OpenCV file: so what is left must be a pose that the ECM can take. With any
    # other axes of the camera it is none, as its roll goes to 89 degrees only.
    where = shared_data / "dvrk" / "registrations" / folder
    _, camera_T_base = read_registration(where / f"{psm}-registration-open-cv.json")
    measured = np.array(json.loads((where / f"{psm}-registration-dVRK.json").read_text())["measured_cp"])
    assert ecm_misses(measured @ np.linalg.inv(ISI @ camera_T_base)) < 1e-4
    for axes in ([1, 1, 1, 1], [1, -1, -1, 1], [-1, 1, -1, 1]):
        assert ecm_misses(measured @ np.linalg.inv(np.diag(axes) @ camera_T_base)) > 0.5


def ecm_misses(ecm_base_T_tip: np.ndarray) -> float:
    """How far a pose (m) is from the nearest one of a classic ECM within its limits, by the generator's kinematics."""
    robot = yaml.safe_load((Path(rc.__file__).parents[1] / "configs" / "robots" / "dvrk-classic.yaml").read_text())
    arm = arms_from_dict(robot)["laparoscope"]
    low, high = ([joint[key] for joint in robot["arms"]["laparoscope"]["joints"]] for key in ("min", "max"))
    to_mm = np.array([1.0, 1.0, 1000.0, 1.0])

    def difference(q: np.ndarray) -> np.ndarray:
        tip = arm.tool(q * to_mm)
        return np.concatenate(
            [(tip[:3, :3] - ecm_base_T_tip[:3, :3]).ravel(), tip[:3, 3] / 1000 - ecm_base_T_tip[:3, 3]]
        )

    bounds = np.array(low) / to_mm, np.array(high) / to_mm
    fit = least_squares(difference, np.mean(bounds, axis=0), bounds=bounds, x_scale=[1.0, 1.0, 0.1, 1.0])
    return float(np.linalg.norm(fit.fun))


def test_the_fragment_that_is_no_json_is_read_and_never_written(tmp_path: Path):
    # What dvrk_camera_registration writes without an ECM.
    fragment = '"base-frame": {"reference-frame": "/left", "transform": [[1,0,0,0.1],[0,1,0,0],[0,0,1,0],[0,0,0,1]]}\n'
    path = tmp_path / "PSM1-registration-dVRK.json"
    path.write_text(fragment)
    with pytest.raises(json.JSONDecodeError):
        json.loads(fragment)
    name, matrix = read_registration(path)
    assert name == "/left" and matrix[0, 3] == 0.1
    json.loads(registration_text(name, matrix))


@pytest.mark.parametrize("text", ["", "{}", "[]", '{"base-frame": 3}', '{"base-frame": {"reference-frame": "a"}}'])
def test_what_is_no_registration_is_named(tmp_path: Path, text: str):
    path = tmp_path / "registration.json"
    path.write_text(text)
    with pytest.raises(InputError, match=r"registration\.json.*base-frame"):
        read_registration(path)


@pytest.fixture(scope="module")
def rendered(tmp_path_factory) -> Path:
    path = tmp_path_factory.mktemp("rendered") / "recording"
    data_synth.write_recording(path, data_synth.load_synth_config({"motions": 2, "seed": 5}))
    return path


@pytest.fixture(scope="module")
def truth(rendered: Path) -> np.ndarray:
    """camera_right_T_arm, m."""
    matrix = np.array(yaml.safe_load((rendered / "ground_truth.yaml").read_text())["camera_right_T_arm"])
    matrix[:3, 3] /= 1000
    return matrix


@pytest.fixture(scope="module")
def result(rendered: Path, truth: np.ndarray) -> CalibrationResult:
    matrix = truth.copy()
    matrix[:3, 3] *= 1000
    extrinsics = yaml.safe_load((rendered / "stereo.yaml").read_text())["camera_left_T_camera_right"]
    return CalibrationResult(
        status="ok",
        message="The result passed its own checks",
        method="joint",
        camera_right_T_arm=RigidTransform("camera_right", "arm", torch.from_numpy(matrix)),
        camera_left_T_camera_right=RigidTransform(
            "camera_left", "camera_right", torch.tensor(extrinsics, dtype=torch.float64)
        ),
        covariance=None,
        observability={},
        motions=Motions(np.array([True, True]), ("", ""), None),
    )


def placed(rendered: Path, frame: int) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """base_T_arm at a frame, and both arms' bases, m, by the generator's own kinematics."""
    robot = yaml.safe_load((rendered / "robot.yaml").read_text())
    arms = arms_from_dict(robot)
    log = np.genfromtxt(rendered / "joints.csv", delimiter=",", names=True, deletechars="")
    names = [name for name in log.dtype.names if name.startswith("laparoscope.")]
    times = np.genfromtxt(rendered / "frame_times.csv", delimiter=",", names=True)["timestamp_s"]
    row = int(np.argmin(np.abs(log["timestamp_s"] - times[frame])))
    base_T_arm = arms["laparoscope"].tool(np.array([log[name][row] for name in names]))
    bases = [np.array(robot["arms"][arm]["base_T_arm_base"], dtype=float) for arm in ("laparoscope", "instrument")]
    for matrix in (base_T_arm, *bases):
        matrix[:3, 3] /= 1000
    return base_T_arm, bases[0], bases[1]


@pytest.mark.parametrize("frame", [0, 1])
def test_registrations_are_the_geometry_of_the_rendered_scene(rendered, result, truth, tmp_path, frame):
    settings = rc.ExportSettings(frame=frame, instrument="PSM2")
    folder = rc.export(result, "dvrk", tmp_path / "dvrk", recording=rendered, settings=settings)
    base_T_arm, base_T_ecm, base_T_psm = placed(rendered, frame)
    camera_T_psm = truth @ np.linalg.inv(base_T_arm) @ base_T_psm
    on_ecm = np.linalg.inv(base_T_ecm) @ base_T_arm @ ISI @ camera_T_psm

    def read(name: str) -> dict:
        return json.loads((folder / name).read_text())

    opencv = read("PSM2-registration-open-cv.json")
    assert set(opencv) == {"base-frame"} and set(opencv["base-frame"]) == {"reference-frame", "transform"}
    np.testing.assert_allclose(opencv["base-frame"]["transform"], camera_T_psm, atol=1e-9)
    newer = read("PSM2-base_frame.json")
    # The schema of dVRK 2.4 allows exactly these keys.
    assert set(newer) == {"base_frame"} and set(newer["base_frame"]) == {"reference_frame", "transform"}
    np.testing.assert_allclose(newer["base_frame"]["transform"], ISI @ camera_T_psm, atol=1e-9)
    assert np.abs(np.array(newer["base_frame"]["transform"]) - camera_T_psm).max() > 0.01  # axes are not OpenCV's
    older = read("PSM2-registration-dVRK.json")
    assert set(older) == {"name", "measured_cp"} and older["name"] == "PSM2"
    np.testing.assert_allclose(older["measured_cp"], on_ecm, atol=1e-9)
    # mtsIntuitiveResearchKitSUJFixed asks for these four, and starts from measured_cp where there is one.
    suj = {arm["name"]: arm.get("measured_cp") for arm in read("suj-fixed.json")["arms"]}
    assert set(suj) == {"ECM", "PSM1", "PSM2", "PSM3"} and suj["PSM1"] is None
    np.testing.assert_allclose(suj["PSM2"], on_ecm, atol=1e-9)
    np.testing.assert_array_equal(suj["ECM"], np.eye(4))


def test_a_camera_that_stands_still_has_no_suj(rendered, result, truth, tmp_path):
    still = Path(shutil.copytree(rendered, tmp_path / "still"))
    description = yaml.safe_load((still / "recording.yaml").read_text()) | {"laparoscope_arm": None}
    (still / "recording.yaml").write_text(yaml.safe_dump(description))
    rows = [line.split(",") for line in (still / "joints.csv").read_text().splitlines()]
    kept = [index for index, name in enumerate(rows[0]) if not name.startswith("laparoscope.")]
    (still / "joints.csv").write_text("".join(",".join(row[i] for i in kept) + "\n" for row in rows))
    folder = rc.export(result, "dvrk", tmp_path / "dvrk", recording=still)
    assert not (folder / "suj-fixed.json").exists()
    _, _, base_T_psm = placed(rendered, 0)
    raw = json.loads((folder / "PSM1-registration-dVRK.json").read_text())["base-frame"]
    np.testing.assert_allclose(raw["transform"], ISI @ truth @ base_T_psm, atol=1e-9)


def test_joint_offsets_that_were_found_are_applied(rendered, result, truth, tmp_path):
    offset = {"value": 0.1, "sigma": 0.01, "unit": "rad", "held": False}
    robot = yaml.safe_load((rendered / "robot.yaml").read_text())
    first = robot["arms"]["laparoscope"]["joints"][0]
    assert first["type"] == "revolute"
    found = replace(result, nuisances={f"joint_offset laparoscope.{first['name']}": offset})
    read = []
    for name, answer in (("without", result), ("with", found)):
        folder = rc.export(answer, "dvrk", tmp_path / name, recording=rendered)
        raw = json.loads((folder / "PSM1-registration-open-cv.json").read_text())
        read.append(np.array(raw["base-frame"]["transform"]))
    # A turn of the laparoscope's first joint is seen as the instrument's base turning the other way by as much.
    R = read[0][:3, :3].T @ read[1][:3, :3]
    assert np.arccos((np.trace(R) - 1) / 2) == pytest.approx(0.1, abs=1e-9)


def test_surgsync_is_one_consistent_calibration(rendered, result, truth, tmp_path):
    folder = rc.export(result, "surgsync", tmp_path / "clip", recording=rendered)
    stereo = yaml.safe_load((rendered / "stereo.yaml").read_text())
    cameras = {
        side: yaml.safe_load((folder / "camera_calibration" / f"{side}.yaml").read_text()) for side in ("left", "right")
    }

    def entry(side: str, key: str) -> np.ndarray:
        value = cameras[side][key]
        return np.array(value["data"]).reshape(value["rows"], value["cols"])

    left_T_right = np.array(stereo["camera_left_T_camera_right"])
    right_T_left = np.linalg.inv(left_T_right)
    np.testing.assert_allclose(entry("right", "R_stereo"), right_T_left[:3, :3], atol=1e-12)
    np.testing.assert_allclose(entry("right", "T_stereo")[:, 0], right_T_left[:3, 3] / 1000, atol=1e-12)
    assert entry("left", "camera_matrix")[0, 0] == stereo["left"]["fx"]
    again = read_stereo(folder / "camera_calibration")
    assert again.camera_left_T_camera_right is not None and again.left is not None
    np.testing.assert_allclose(again.camera_left_T_camera_right, left_T_right, atol=1e-6)
    assert again.left.distortion == pytest.approx(stereo["left"]["distortion"])
    baseline = json.loads((folder / "camera_calibration" / "stereo_calib_params.json").read_text())["baseline_m"]
    assert baseline == pytest.approx(np.linalg.norm(left_T_right[:3, 3]) / 1000)
    # A point on the instrument's base axis, 0.2 m out: through the raw left camera and OpenCV's rectification of it,
    # and through the registration and the rectified projection, it is one pixel.
    base_T_arm, _, base_T_psm = placed(rendered, 1)
    base_p = np.array([0.0, 0.0, -0.2, 1.0])
    left_T_right_m = left_T_right.copy()
    left_T_right_m[:3, 3] /= 1000
    left_p = (left_T_right_m @ truth @ np.linalg.inv(base_T_arm) @ base_T_psm @ base_p)[:3]
    if left_p[2] < 0:
        base_p[2] = 0.2
        left_p = (left_T_right_m @ truth @ np.linalg.inv(base_T_arm) @ base_T_psm @ base_p)[:3]
    K, D, R, P = (
        entry("left", key)
        for key in ("camera_matrix", "distortion_coefficients", "rectification_matrix", "projection_matrix")
    )
    raw, _ = cv2.projectPoints(left_p[None], np.zeros(3), np.zeros(3), K, D)
    expected = cv2.undistortPoints(raw, K, D, R=R, P=P)[0, 0]
    registration = folder / "hand_eye_calibration" / "PSM1-registration-open-cv.json"
    _, rectified_T_base = read_registration(registration)
    pixel = P @ np.append((rectified_T_base @ base_p)[:3], 1.0)
    np.testing.assert_allclose(pixel[:2] / pixel[2], expected, atol=0.01)


def test_what_is_not_trustworthy_says_so_where_a_robot_reads_it(rendered, result, tmp_path):
    weak = replace(result, status="weak", message="too loose")
    folder = rc.export(weak, "dvrk", tmp_path / "dvrk", recording=rendered, force=True)
    frame = json.loads((folder / "PSM1-base_frame.json").read_text())["base_frame"]
    assert frame["reference_frame"] == "camera_right_NOT_TRUSTWORTHY"
    for name in ("suj-fixed.json", "PSM1-registration-dVRK.json", "README.txt"):
        assert "NOT TRUSTWORTHY (weak): too loose" in (folder / name).read_text()


def test_command_line(rendered, result, tmp_path, capsys):
    result.write(tmp_path / "result.json")
    where = [str(tmp_path / "result.json"), "--out", str(tmp_path / "out"), "--to"]
    assert main(["export", *where, "dvrk"]) == 2
    assert "--recording" in capsys.readouterr().err
    assert main(["export", *where, "dvrk", "--recording", str(rendered), "--instrument", "PSM7"]) == 2
    assert "one of PSM1, PSM2, PSM3" in capsys.readouterr().err
    assert main(["export", *where, "dvrk", "--recording", str(rendered), "--frame", "7"]) == 2
    assert "frame" in capsys.readouterr().err
    assert not (tmp_path / "out").exists()
    assert main(["export", *where, "dvrk", "--recording", str(rendered)]) == 0
    assert main(["export", *where, "dvrk", "--recording", str(rendered)]) == 2
    assert main(["export", *where, "dvrk", "--recording", str(rendered), "--overwrite"]) == 0
    replace(result, status="weak").write(tmp_path / "result.json")
    where[2] = str(tmp_path / "weak")
    assert main(["export", *where, "tum"]) == 1
    assert "no trustworthy result" in capsys.readouterr().err
    assert main(["export", *where, "tum", "--force"]) == 0
