"""Calibrations of other programs, each written by the test or its own library, against one rig with known numbers."""

import contextlib
import json
from collections.abc import Callable
from pathlib import Path

import cv2
import numpy as np
import pytest
import yaml
from breaking import edit
from recording_files import RecordingFolder
from scipy.io import savemat
from scipy.spatial.transform import Rotation

from rmis_calib.errors import RecordingError, RmisCalibError
from rmis_calib.io.intrinsics import StereoFile
from rmis_calib.io.recording import load_recording
from rmis_calib.io.stereo import read_stereo

SIZE = (64, 96)
LEFT = np.array([[90.0, 0, 47.5], [0, 91.0, 31.5], [0, 0, 1]])
RIGHT = np.array([[92.0, 0, 40.5], [0, 93.0, 30.5], [0, 0, 1]])
BENT_LEFT, BENT_RIGHT = [-0.1, 0.01, 1e-3, -2e-3, 0.003], [-0.2, 0.02, 2e-3, -1e-3, 0.004]
right_R_left = Rotation.from_rotvec([0.01, -0.03, 0.02]).as_matrix()
right_t_left = np.array([-5.1, 0.3, -0.2])  # mm: the right camera is on the right
"""The truth: p_right = R p_left + t."""


def left_T_right() -> np.ndarray:
    matrix = np.eye(4)
    matrix[:3, :3], matrix[:3, 3] = right_R_left.T, -right_R_left.T @ right_t_left
    return matrix


def check(found: StereoFile, bent: bool = True, tolerance: float = 1e-9) -> None:
    assert found.left is not None and found.camera_left_T_camera_right is not None
    for camera, K, distortion in ((found.left, LEFT, BENT_LEFT), (found.right, RIGHT, BENT_RIGHT)):
        numbers = (camera.fx, camera.fy, camera.cx, camera.cy)
        np.testing.assert_allclose(numbers, (K[0, 0], K[1, 1], K[0, 2], K[1, 2]), atol=tolerance)
        np.testing.assert_allclose(camera.distortion, distortion if bent else [0.0] * 5, atol=tolerance)
        assert camera.image_size == SIZE and camera.model == "plumb_bob"
    np.testing.assert_allclose(found.camera_left_T_camera_right, left_T_right(), atol=tolerance)
    # Counter-literal: the transform of left into right has +x where ours has -x.
    assert found.camera_left_T_camera_right[0, 3] > 5.0


def camera_info(side: str) -> dict:
    """As ROS's camera_calibration writes it: R and P from OpenCV's stereoRectify."""
    bent = [np.array(BENT_LEFT), np.array(BENT_RIGHT)]
    R1, R2, P1, P2, *_ = cv2.stereoRectify(
        LEFT,
        bent[0],
        RIGHT,
        bent[1],
        SIZE[::-1],
        right_R_left,
        right_t_left[:, None] / 1000.0,
        flags=cv2.CALIB_ZERO_DISPARITY,
    )
    K, D, R, P = (LEFT, bent[0], R1, P1) if side == "left" else (RIGHT, bent[1], R2, P2)

    def matrix(value: np.ndarray) -> dict:
        value = np.atleast_2d(value)
        return {"rows": value.shape[0], "cols": value.shape[1], "data": value.ravel().tolist()}

    return {
        "image_width": SIZE[1], "image_height": SIZE[0], "camera_name": side, "camera_matrix": matrix(K),
        "distortion_model": "plumb_bob", "distortion_coefficients": matrix(D), "rectification_matrix": matrix(R),
        "projection_matrix": matrix(P),
    }  # fmt: skip


def ros_folder(path: Path) -> Path:
    for side in ("left", "right"):
        (path / f"{side}.yaml").write_text(yaml.safe_dump(camera_info(side)))
    return path


def opencv_file(path: Path, suffix: str = ".yml", scale: float = 1.0) -> Path:
    storage = cv2.FileStorage(str(path / f"rig{suffix}"), cv2.FILE_STORAGE_WRITE)
    for name, value in (
        ("M1", LEFT), ("D1", np.array([BENT_LEFT])), ("M2", RIGHT), ("D2", np.array([BENT_RIGHT])),
        ("R", right_R_left), ("T", scale * right_t_left[:, None]),
    ):  # fmt: skip
        storage.write(name, value)
    storage.write("image_width", SIZE[1])
    storage.write("image_height", SIZE[0])
    storage.release()
    return path / f"rig{suffix}"


def opencv_two_files(path: Path) -> Path:
    for name, entries in (
        ("intrinsics", {"M1": LEFT, "D1": np.array([BENT_LEFT]), "M2": RIGHT, "D2": np.array([BENT_RIGHT])}),
        ("extrinsics", {"R": right_R_left, "T": right_t_left[:, None]}),
    ):
        storage = cv2.FileStorage(str(path / f"{name}.yml"), cv2.FILE_STORAGE_WRITE)
        for key, value in entries.items():
            storage.write(key, value)
        storage.release()
    return path


def kalibr_file(path: Path, swapped: bool = False) -> Path:
    def camera(K: np.ndarray, bent: list[float]) -> dict:
        intrinsics = [float(K[0, 0]), float(K[1, 1]), float(K[0, 2]), float(K[1, 2])]
        return {"camera_model": "pinhole", "distortion_model": "radtan", "distortion_coeffs": bent[:4],
                "intrinsics": intrinsics, "resolution": [SIZE[1], SIZE[0]], "rostopic": "/x"}  # fmt: skip

    T = np.linalg.inv(left_T_right())
    cameras = [camera(LEFT, BENT_LEFT), camera(RIGHT, BENT_RIGHT)]
    if swapped:
        T, cameras = np.linalg.inv(T), cameras[::-1]
    T[:3, 3] /= 1000.0
    cameras[1]["T_cn_cnm1"] = T.tolist()
    (path / "camchain.yaml").write_text(yaml.safe_dump(dict(zip(("cam0", "cam1"), cameras, strict=True))))
    return path / "camchain.yaml"


def matlab_struct() -> dict:
    """As toStruct writes it: matrices for rows that are multiplied from the left, pixels from 1."""

    def camera(K: np.ndarray, bent: list[float]) -> dict:
        K = K + np.array([[0, 0, 1.0], [0, 0, 1.0], [0, 0, 0]])
        return {"RadialDistortion": [bent[0], bent[1], bent[4]], "TangentialDistortion": bent[2:4],
                "ImageSize": list(SIZE), "IntrinsicMatrix": K.T.tolist(), "WorldUnits": "millimeters"}  # fmt: skip

    return {
        "CameraParameters1": camera(LEFT, BENT_LEFT), "CameraParameters2": camera(RIGHT, BENT_RIGHT),
        "RotationOfCamera2": right_R_left.T.tolist(), "TranslationOfCamera2": right_t_left.tolist(),
        "WorldUnits": "millimeters",
    }  # fmt: skip


def matlab_mat(path: Path) -> Path:
    savemat(path / "rig.mat", {"stereoParams": matlab_struct()})
    return path / "rig.mat"


def matlab_json(path: Path) -> Path:
    (path / "rig.json").write_text(json.dumps(matlab_struct()))
    return path / "rig.json"


def matlab_json_of_new_versions(path: Path) -> Path:
    raw = matlab_struct()
    del raw["RotationOfCamera2"], raw["TranslationOfCamera2"]
    raw["PoseCamera2"] = {"R": right_R_left.tolist(), "Translation": right_t_left.tolist()}
    for i, K in ((1, LEFT), (2, RIGHT)):
        camera = raw[f"CameraParameters{i}"]
        del camera["IntrinsicMatrix"]
        focal, centre = [K[0, 0], K[1, 1]], [K[0, 2] + 1, K[1, 2] + 1]
        camera["Intrinsics"] = {"FocalLength": focal, "PrincipalPoint": centre, "ImageSize": list(SIZE)}
    (path / "rig.json").write_text(json.dumps({"stereoParams": raw}))
    return path / "rig.json"


def surgpose_ini(path: Path) -> Path:
    lines = []
    for name, K, bent in (("StereoLeft", LEFT, BENT_LEFT), ("StereoRight", RIGHT, BENT_RIGHT)):
        lines += [f"[{name}]", f"res_x={SIZE[1]}", f"res_y={SIZE[0]}", f"fc_x={K[0, 0]}", f"fc_y={K[1, 1]}"]
        lines += [f"cc_x={K[0, 2]}", f"cc_y={K[1, 2]}", *(f"kc_{i}={v}" for i, v in enumerate([*bent, 0, 0, 0]))]
    lines += [f"R_{i}={v!r}" for i, v in enumerate(right_R_left.ravel().tolist())]
    lines += [f"T_{i}={v!r}" for i, v in enumerate(right_t_left.tolist())]
    (path / "StereoCalibrationDVRK.ini").write_text("\n".join(lines) + "\n")
    return path / "StereoCalibrationDVRK.ini"


def surgsync_json(path: Path) -> Path:
    content = {
        "cameraMatrixL": LEFT.tolist(), "distCoeffsL": [BENT_LEFT], "cameraMatrixR": RIGHT.tolist(),
        "distCoeffsR": [BENT_RIGHT], "R": right_R_left.tolist(), "T": (right_t_left[:, None] / 1000).tolist(),
        "baseline_m": -0.0051,
    }  # fmt: skip
    (path / "stereo_calib_params.json").write_text(json.dumps(content))
    return path / "stereo_calib_params.json"


def endovis_txt(path: Path) -> Path:
    omega = Rotation.from_matrix(right_R_left).as_rotvec()
    lines = [f"Width: {SIZE[1]}   // width of the images in pixels", f"Height: {SIZE[0]}"]
    for i, K, bent in ((0, LEFT, BENT_LEFT), (1, RIGHT, BENT_RIGHT)):
        lines += [f"Camera-{i}-F: {K[0, 0]} {K[1, 1]}  // focal", f"Camera-{i}-C: {K[0, 2]} {K[1, 2]}"]
        lines += [f"Camera-{i}-Alpha: 0.00000", f"Camera-{i}-K: {' '.join(map(repr, bent))}"]
    lines += [f"Extrinsic-Omega: {' '.join(repr(float(v)) for v in omega)}   // left to right camera rotation"]
    lines += [f"Extrinsic-T: {' '.join(repr(float(v)) for v in right_t_left)}"]
    (path / "seq.txt").write_text("\n".join(lines))
    return path / "seq.txt"


def surgery_folder(path: Path) -> Path:
    for side, K, bent in (("left", LEFT, BENT_LEFT), ("right", RIGHT, BENT_RIGHT)):
        np.savetxt(path / f"calib.{side}.intrinsics.txt", K)
        np.savetxt(path / f"calib.{side}.distortion.txt", np.array([bent]))
    np.savetxt(path / "calib.l2r.txt", np.linalg.inv(left_T_right()))
    return path


WRITERS: dict[str, Callable[[Path], Path]] = {
    "ROS camera_info pair": ros_folder,
    "OpenCV YAML": opencv_file,
    "OpenCV XML": lambda path: opencv_file(path, ".xml"),
    "OpenCV JSON": lambda path: opencv_file(path, ".json"),
    "OpenCV in metres": lambda path: opencv_file(path, scale=1e-3),
    "OpenCV, two files": opencv_two_files,
    "MATLAB .mat": matlab_mat,
    "MATLAB JSON": matlab_json,
    "MATLAB JSON, PoseCamera2": matlab_json_of_new_versions,
    "SurgPose": surgpose_ini,
    "stereo_calib_params": surgsync_json,
    "EndoVis 2018": endovis_txt,
    "scikit-surgery": surgery_folder,
}


@pytest.mark.parametrize("name", WRITERS)
def test_the_same_rig_in_every_format(tmp_path: Path, name: str) -> None:
    notes: list[str] = []
    # stereoRectify's P and R lose nothing, but go through a Rodrigues vector.
    check(read_stereo(WRITERS[name](tmp_path), notes.append, lambda: SIZE), tolerance=1e-7)
    if "metres" in name or name == "stereo_calib_params":
        assert any("read in metres: a baseline of 5.1" in note for note in notes)


@pytest.mark.parametrize("swapped", [False, True])
def test_kalibr_cameras_are_told_by_where_they_lie(tmp_path: Path, swapped: bool) -> None:
    notes: list[str] = []
    found = read_stereo(kalibr_file(tmp_path, swapped), notes.append)
    assert found.left is not None and found.camera_left_T_camera_right is not None
    assert (found.left.fx, found.right.fx) == (90.0, 92.0)
    assert found.left.distortion == (*BENT_LEFT[:4], 0.0)  # radtan is k1, k2, p1, p2
    np.testing.assert_allclose(found.camera_left_T_camera_right, left_T_right(), atol=1e-12)
    assert any("taken for the right one" in note for note in notes) == swapped


def test_kalibr_fisheye(tmp_path: Path) -> None:
    path = kalibr_file(tmp_path)
    path.write_text(path.read_text().replace("radtan", "equidistant"))
    found = read_stereo(path)
    assert (found.right.model, found.right.distortion) == ("equidistant", tuple(BENT_RIGHT[:4]))


def test_eight_coefficients_are_a_rational_model(tmp_path: Path) -> None:
    path = surgpose_ini(tmp_path)
    path.write_text(path.read_text().replace("kc_6=0", "kc_6=0.25"))
    found = read_stereo(path)
    assert found.right.model == "rational_polynomial" and found.right.distortion == (*BENT_RIGHT, 0.0, 0.25, 0.0)


def test_real_endovis_calibrations(shared_data: Path) -> None:
    paths = sorted((shared_data / "dvrk" / "endovis2018_stereo_calib").glob("*.txt"))
    assert paths
    for path in paths:
        found = read_stereo(path)
        assert found.camera_left_T_camera_right is not None
        # "About 4.35 mm" (data/README.md), with a right camera on the right.
        assert np.linalg.norm(found.camera_left_T_camera_right[:3, 3]) == pytest.approx(4.35, abs=0.15)
        assert found.camera_left_T_camera_right[0, 3] > 0


CASES = {
    "left and right swapped": (
        lambda p: swap_sides(surgpose_ini(p)),
        "are the names swapped, or the transform inverted",
    ),
    "a unit between mm and m": (lambda p: opencv_file(p, scale=0.1), "the file states no unit"),
    "no image size": (lambda p: surgsync_json(p), "expected an image size in the file"),
    "a fisheye or not": (lambda p: ambiguous_lens(p), "expected a file that names its lens model"),
    "MATLAB 7.3": (lambda p: written(p / "a.mat", b"MATLAB 7.3 MAT-file, Platform: GLNXA64" + bytes(600)), "MATLAB"),
    "an unknown folder": (lambda p: written(p / "notes.txt", b"x").parent, "found notes.txt"),
    "omni": (lambda p: replaced(kalibr_file(p), "pinhole", "omni"), "expected camera_model pinhole"),
    "no baseline": (lambda p: flat(ros_folder(p)), r"expected a baseline in P\[0, 3\]"),
}


@pytest.mark.parametrize("name", CASES)
def test_what_cannot_be_told_is_refused(tmp_path: Path, name: str) -> None:
    write, message = CASES[name]
    with pytest.raises(RecordingError, match=message):
        read_stereo(write(tmp_path))


def swap_sides(path: Path) -> Path:
    text = path.read_text().replace(f"T_0={float(right_t_left[0])!r}", f"T_0={-float(right_t_left[0])!r}")
    return written(path, text.encode())


def ambiguous_lens(path: Path) -> Path:
    content = {"K1": LEFT.tolist(), "K2": RIGHT.tolist(), "D1": [0.1, 0.2, -0.3, 0.4], "D2": [0.1, 0.2, -0.3, 0.4]}
    content |= {"R": right_R_left.tolist(), "T": right_t_left.tolist(), "image_size": list(SIZE[::-1])}
    return written(path / "a.json", json.dumps(content).encode())


def flat(folder: Path) -> Path:
    for side in ("left", "right"):
        raw = camera_info(side)
        raw["projection_matrix"]["data"][3] = 0.0
        (folder / f"{side}.yaml").write_text(yaml.safe_dump(raw))
    return folder


def written(path: Path, content: bytes) -> Path:
    path.write_bytes(content)
    return path


def replaced(path: Path, old: str, new: str) -> Path:
    return written(path, path.read_text().replace(old, new).encode())


def test_a_recording_may_name_a_pair_of_files(folder: RecordingFolder) -> None:
    ros_folder(folder.path)
    edit("recording.yaml", stereo={"right": "right.yaml", "left": "left.yaml"})(folder)
    found = load_recording(folder.path).stereo
    assert found.left is not None and found.camera_left_T_camera_right is not None
    assert (float(found.left.fx), float(found.right.fx)) == (90.0, 92.0)
    np.testing.assert_allclose(found.camera_left_T_camera_right.matrix.numpy(), left_T_right(), atol=1e-7)


def test_a_file_without_a_size_takes_that_of_the_pictures(folder: RecordingFolder) -> None:
    surgsync_json(folder.path)
    edit("recording.yaml", stereo="stereo_calib_params.json")(folder)
    recording = load_recording(folder.path)
    assert recording.stereo.right.image_size == SIZE
    assert any("no image size is stated" in note for note in recording.notes)


def test_one_camera_info_is_one_camera(folder: RecordingFolder) -> None:
    ros_folder(folder.path)
    edit("recording.yaml", stereo="right.yaml", left=None)(folder)
    recording = load_recording(folder.path)
    assert recording.stereo.left is None and float(recording.stereo.right.fx) == 92.0


def test_our_own_file_with_a_fisheye(folder: RecordingFolder) -> None:
    edit("stereo.yaml", right__distortion=[0.1, 0.0, 0.0, 0.0], right__distortion_model="equidistant")(folder)
    recording = load_recording(folder.path)
    assert recording.stereo.right.model == "equidistant"
    assert recording.stereo.left is not None and recording.stereo.left.model == "plumb_bob"


def test_what_we_write_is_what_we_read(tmp_path: Path) -> None:
    found = read_stereo(surgpose_ini(tmp_path))
    (tmp_path / "stereo.yaml").write_text(yaml.safe_dump(found.to_dict()))
    check(read_stereo(tmp_path / "stereo.yaml"), tolerance=1e-12)


@pytest.mark.parametrize("name", [*WRITERS, "kalibr"])
@pytest.mark.parametrize("share", [0.0, 0.1, 0.35, 0.6, 0.8, 0.95])
def test_a_file_that_is_cut_off_is_one_clear_line(tmp_path: Path, name: str, share: float) -> None:
    whole = kalibr_file(tmp_path) if name == "kalibr" else WRITERS[name](tmp_path)
    for path in sorted(whole.iterdir()) if whole.is_dir() else [whole]:
        content = path.read_bytes()
        path.write_bytes(content[: int(share * len(content))])
        try:
            found = read_stereo(whole, picture_size=lambda: SIZE)
        except RmisCalibError as error:
            assert str(tmp_path) in str(error) and "\n" not in str(error)
        else:
            # Only something without a meaning can be missing: an end tag, the last digits of a number.
            assert found.left is None or found.camera_left_T_camera_right is not None
        path.write_bytes(content)


@pytest.mark.parametrize("seed", range(40))
def test_damaged_files_never_end_in_a_traceback(tmp_path: Path, seed: int) -> None:
    generator = np.random.default_rng(seed)
    # Not .mat: what MATLAB writes is compressed and has checksums; SciPy's own writer leaves them out, and its reader
    # then runs off the end of a damaged file.
    names = [name for name in WRITERS if name != "MATLAB .mat"]
    name = names[seed % len(names)]
    whole = WRITERS[name](tmp_path)
    for path in sorted(whole.iterdir()) if whole.is_dir() else [whole]:
        content = bytearray(path.read_bytes())
        for place in generator.integers(0, len(content), 4):
            content[place] = generator.integers(32, 127)
        path.write_bytes(bytes(content))
        with contextlib.suppress(RmisCalibError):
            read_stereo(whole, picture_size=lambda: SIZE)
