"""Calibrations as text: SurgPose's .ini, EndoVis 2018's .txt, kalibr's camchain and scikit-surgery's set of files."""

import configparser
from pathlib import Path
from typing import Any

import numpy as np

from rmis_calib.errors import RecordingError
from rmis_calib.io._checks import Note
from rmis_calib.io.configs import read_bytes
from rmis_calib.io.intrinsics import Intrinsics, PictureSize, StereoFile, lens, stereo_pair

_LARGEST_TEXT = 1 << 20
_ENDOVIS_KEYS = ("Width", "Height", "Camera-", "Extrinsic-")
_SURGERY = {"left": "*left.intrinsics.txt", "right": "*right.intrinsics.txt", "l2r": "*l2r.txt"}


def read_ini(path: Path, note: Note) -> StereoFile:
    """SurgPose's StereoCalibrationDVRK.ini: [StereoLeft] and [StereoRight], p_right = R p_left + T, mm.

    Raises:
        RecordingError: an entry is missing or no number.
    """
    parser = configparser.ConfigParser()
    try:
        parser.read_string(_text(path))
        cameras = [_ini_camera(parser[name], f"{path}: [{name}]", note) for name in ("StereoLeft", "StereoRight")]
        right = parser["StereoRight"]
        R = np.array([right.getfloat(f"R_{i}") for i in range(9)], dtype=np.float64).reshape(3, 3)
        t = np.array([right.getfloat(f"T_{i}") for i in range(3)], dtype=np.float64)
    except (configparser.Error, KeyError, ValueError, TypeError) as problem:
        if isinstance(problem, RecordingError):
            raise
        expected = "res_x, res_y, fc_x, fc_y, cc_x, cc_y, kc_0, ... for both eyes, R_0 to R_8 and T_0 to T_2"
        raise RecordingError(
            where=str(path), expected=expected, found=f"trouble at {' '.join(str(problem).split())}"
        ) from problem
    return stereo_pair(cameras[0], cameras[1], R, t, f"{path}: T", note, 1.0, are_named=True)


def _ini_camera(section: configparser.SectionProxy, where: str, note: Note) -> Intrinsics:
    def number(key: str) -> float:
        if key not in section:
            raise RecordingError(where=where, expected=key, found="nothing")
        return float(section[key])

    bent = [section.getfloat(f"kc_{i}", fallback=0.0) for i in range(8)]
    model, distortion = lens(bent, "rational_polynomial", where, note)
    size = (int(number("res_y")), int(number("res_x")))
    camera = Intrinsics(number("fc_x"), number("fc_y"), number("cc_x"), number("cc_y"), distortion, size, model)
    return camera.checked(where)


def read_endovis(path: Path, note: Note) -> StereoFile:
    """EndoVis 2018: `Camera-0-F: ...` lines; camera 0 is the left one, Extrinsic-Omega and -T map left to right, mm.

    Raises:
        RecordingError: a line is missing, or has no numbers.
    """
    from scipy.spatial.transform import Rotation

    lines: dict[str, list[float]] = {}
    for number, line in enumerate(_text(path).splitlines(), start=1):
        key, _, rest = line.partition("//")[0].partition(":")
        if not key.strip().startswith(_ENDOVIS_KEYS):  # some files end in a log of the endoscope's own
            continue
        try:
            lines[key.strip()] = [float(word) for word in rest.split()]
        except ValueError as problem:
            raise RecordingError(where=f"{path} line {number}", expected="numbers", found=rest.strip()) from problem

    def values(key: str, count: int) -> list[float]:
        if len(lines.get(key, ())) != count:
            found = f"{len(lines[key])}" if key in lines else "nothing"
            raise RecordingError(where=f"{path}: {key}", expected=f"{count} numbers", found=found)
        return lines[key]

    size = (int(values("Height", 1)[0]), int(values("Width", 1)[0]))
    cameras = []
    for i in range(2):
        where = f"{path}: Camera-{i}"
        if any(lines.get(f"Camera-{i}-Alpha", ())):
            raise RecordingError(where=where, expected="pixels without skew", found=lines[f"Camera-{i}-Alpha"])
        model, distortion = lens(values(f"Camera-{i}-K", 5), "plumb_bob", where, note)
        (fx, fy), (cx, cy) = values(f"Camera-{i}-F", 2), values(f"Camera-{i}-C", 2)
        cameras.append(Intrinsics(fx, fy, cx, cy, distortion, size, model).checked(where))
    R = Rotation.from_rotvec(values("Extrinsic-Omega", 3)).as_matrix()
    t = np.array(values("Extrinsic-T", 3))
    return stereo_pair(cameras[0], cameras[1], R, t, f"{path}: Extrinsic-T", note, 1.0, are_named=True)


def is_camchain(raw: dict[str, Any]) -> bool:
    """Whether a YAML mapping is kalibr's."""
    first = raw.get("cam0")
    return isinstance(first, dict) and "intrinsics" in first


def from_camchain(raw: dict[str, Any], path: Path, note: Note) -> StereoFile:
    """kalibr's camchain: one or two pinhole cameras, T_cn_cnm1 of cam1 maps cam0 to cam1, metres.

    Raises:
        RecordingError: another camera model, more than two cameras, or an entry that is missing.
    """
    names = sorted(name for name in raw if name.startswith("cam"))
    if len(names) > 2:
        raise RecordingError(where=str(path), expected="one or two cameras", found=", ".join(names))
    cameras = []
    for name in names:
        where, camera = f"{path}: {name}", raw[name] if isinstance(raw[name], dict) else {}
        if camera.get("camera_model") != "pinhole":
            expected = "camera_model pinhole (kalibr_calibrate_cameras --models pinhole-radtan or pinhole-equi)"
            raise RecordingError(where=where, expected=expected, found=camera.get("camera_model"))
        try:
            fx, fy, cx, cy = map(float, camera["intrinsics"])
            width, height = map(int, camera["resolution"])
            bent = [float(value) for value in camera.get("distortion_coeffs") or ()]
        except (KeyError, TypeError, ValueError) as problem:
            expected = "numbers: 4 intrinsics, a resolution of 2, distortion_coeffs"
            raise RecordingError(where=where, expected=expected, found="others") from problem
        model, distortion = lens(bent, camera.get("distortion_model"), where, note)
        cameras.append(Intrinsics(fx, fy, cx, cy, distortion, (height, width), model).checked(where))
    if len(cameras) == 1:
        return StereoFile(cameras[0], None, None)
    try:
        rows = np.asarray(raw[names[1]].get("T_cn_cnm1", ()), dtype=np.float64)
    except (TypeError, ValueError):
        rows = np.empty(0)
    if rows.shape != (4, 4):
        raise RecordingError(where=f"{path}: {names[1]}.T_cn_cnm1", expected="4 rows of 4", found=rows.shape)
    return stereo_pair(cameras[0], cameras[1], rows[:3, :3], rows[:3, 3], f"{path}: {names[1]}.T_cn_cnm1", note, 1000.0)


def is_surgery_folder(folder: Path) -> bool:
    """Whether a folder holds scikit-surgerycalibration's files of a stereo pair."""
    return all(next(folder.glob(pattern), None) is not None for pattern in _SURGERY.values())


def read_surgery_folder(folder: Path, note: Note, picture_size: PictureSize) -> StereoFile:
    """scikit-surgerycalibration: NAME.left.intrinsics.txt, .distortion.txt, the same of right, NAME.l2r.txt (mm).

    Raises:
        RecordingError: several sets, a file that is missing, or a matrix of another size.
    """
    size = picture_size()
    cameras = []
    for side in ("left", "right"):
        path = _only(folder, _SURGERY[side])
        K = _matrix(path, (3, 3))
        bent = path.with_name(path.name.replace("intrinsics", "distortion"))
        model, distortion = lens(_matrix(bent, None).ravel().tolist(), "plumb_bob", str(bent), note)
        cameras.append(Intrinsics(K[0, 0], K[1, 1], K[0, 2], K[1, 2], distortion, size, model).checked(str(path)))
    path = _only(folder, _SURGERY["l2r"])
    rows = _matrix(path, (4, 4))
    return stereo_pair(cameras[0], cameras[1], rows[:3, :3], rows[:3, 3], str(path), note, are_named=True)


def _only(folder: Path, pattern: str) -> Path:
    found = sorted(folder.glob(pattern))
    if len(found) != 1:
        raise RecordingError(where=str(folder), expected=f"one file {pattern}", found=f"{len(found)} of them")
    return found[0]


def _matrix(path: Path, shape: tuple[int, int] | None) -> np.ndarray:
    text = _text(path)
    try:
        matrix = np.loadtxt(text.splitlines(), ndmin=2) if text.strip() else np.empty((0, 0))
    except ValueError as problem:
        raise RecordingError(where=str(path), expected="rows of numbers", found="other text") from problem
    if shape is not None and matrix.shape != shape:
        raise RecordingError(where=str(path), expected=f"{shape[0]} rows of {shape[1]}", found=matrix.shape)
    return matrix


def _text(path: Path) -> str:
    try:
        return read_bytes(path, _LARGEST_TEXT).decode("utf-8-sig")
    except UnicodeDecodeError as problem:
        raise RecordingError(where=str(path), expected="UTF-8 text", found="other bytes") from problem
