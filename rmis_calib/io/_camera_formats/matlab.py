"""MATLAB's stereoParameters: `toStruct` of it in a .mat file (version 7 or older), or `jsonencode` of it."""

from pathlib import Path
from typing import Any

import numpy as np

from rmis_calib.errors import RecordingError
from rmis_calib.io._checks import Note
from rmis_calib.io.intrinsics import Intrinsics, PictureSize, StereoFile, lens, stereo_pair

_MM = {"mm": 1.0, "millimeters": 1.0, "millimetres": 1.0, "cm": 10.0, "centimeters": 10.0, "m": 1000.0} | {
    "meters": 1000.0, "metres": 1000.0, "inches": 25.4, "in": 25.4
}  # fmt: skip
_SAVE_AS = "s = toStruct(stereoParams); save('cameras.mat', 's', '-v7')"


def read_mat(path: Path, note: Note, picture_size: PictureSize) -> StereoFile:
    """Raises:
    RecordingError: it is of version 7.3, damaged, or holds an object instead of a struct.
    """
    from scipy.io import loadmat
    from scipy.io.matlab import MatReadError

    try:
        variables = loadmat(str(path), simplify_cells=True)
    except NotImplementedError as problem:
        found = "a file of version 7.3 (HDF5)"
        raise RecordingError(where=str(path), expected=f"a struct saved by {_SAVE_AS}", found=found) from problem
    except (MatReadError, ValueError, TypeError, OSError) as problem:
        raise RecordingError(where=str(path), expected="a MATLAB file", found=f"damage ({problem})") from problem
    candidates = [variables, *(value for value in variables.values() if isinstance(value, dict))]
    for raw in candidates:
        if is_stereo_parameters(raw):
            return from_stereo_parameters(raw, str(path), note, picture_size)
    found = ", ".join(name for name in variables if not name.startswith("__")) or "an object, which only MATLAB reads"
    raise RecordingError(where=str(path), expected=f"stereoParameters as a struct ({_SAVE_AS})", found=found)


def is_stereo_parameters(raw: dict[str, Any]) -> bool:
    """Whether a mapping has the fields of stereoParameters."""
    return "CameraParameters1" in raw and "CameraParameters2" in raw


def from_stereo_parameters(raw: dict[str, Any], where: str, note: Note, picture_size: PictureSize) -> StereoFile:
    """The rig.

    Convention: MATLAB's first pixel is (1, 1), ours (0, 0). RotationOfCamera2 multiplies rows from the right, so that
    p2 = RotationOfCamera2^T p1 + TranslationOfCamera2; PoseCamera2 of newer versions holds the transpose.

    Raises:
        RecordingError: a field is missing or impossible.
    """
    cameras = [
        _camera(raw[f"CameraParameters{i}"], f"{where}: CameraParameters{i}", note, picture_size) for i in (1, 2)
    ]
    if "RotationOfCamera2" in raw:
        R = _numbers(raw["RotationOfCamera2"], 9, f"{where}: RotationOfCamera2").reshape(3, 3).T
        t = _numbers(raw.get("TranslationOfCamera2"), 3, f"{where}: TranslationOfCamera2")
    else:
        pose = raw.get("PoseCamera2") or {}
        R = _numbers(pose.get("R"), 9, f"{where}: PoseCamera2.R").reshape(3, 3)
        t = _numbers(pose.get("Translation"), 3, f"{where}: PoseCamera2.Translation")
    unit = str(raw.get("WorldUnits") or raw["CameraParameters1"].get("WorldUnits") or "").strip().lower()
    if unit and unit not in _MM:
        raise RecordingError(where=f"{where}: WorldUnits", expected=f"one of {', '.join(_MM)}", found=unit)
    note(f"{where}: MATLAB counts pixels from 1: the principal points were moved by one pixel")
    return stereo_pair(cameras[0], cameras[1], R, t, f"{where}: TranslationOfCamera2", note, _MM.get(unit))


def _camera(raw: dict[str, Any], where: str, note: Note, picture_size: PictureSize) -> Intrinsics:
    raw = {**(raw.get("Intrinsics") or {}), **raw}
    if raw.get("K") is not None or raw.get("IntrinsicMatrix") is not None:
        name = "K" if raw.get("K") is not None else "IntrinsicMatrix"
        K = _numbers(raw[name], 9, f"{where}.{name}").reshape(3, 3)
        K = K.T if K[2, 0] != 0 else K  # IntrinsicMatrix is the transpose of K
        (fx, skew, cx), (_, fy, cy) = K[0], K[1]
    else:
        fx, fy = _numbers(raw.get("FocalLength"), 2, f"{where}.FocalLength")
        cx, cy = _numbers(raw.get("PrincipalPoint"), 2, f"{where}.PrincipalPoint")
        skew = float(raw.get("Skew") or 0.0)
    if abs(skew) > 1e-9 * fx:
        raise RecordingError(where=where, expected="pixels without skew", found=f"a skew of {skew:g} px")
    radial = np.ravel(np.asarray(raw.get("RadialDistortion", ()), dtype=np.float64))
    radial = np.append(radial, np.zeros(3))[:3]
    tangential = np.append(np.ravel(np.asarray(raw.get("TangentialDistortion", ()), dtype=np.float64)), np.zeros(2))[:2]
    model, distortion = lens([*radial[:2], *tangential, radial[2]], "plumb_bob", where, note)
    size = np.ravel(np.asarray(raw.get("ImageSize", ()), dtype=np.float64))
    height, width = (int(size[0]), int(size[1])) if size.size == 2 else picture_size()
    return Intrinsics(fx, fy, cx - 1.0, cy - 1.0, distortion, (height, width), model).checked(where)


def _numbers(value: Any, count: int, where: str) -> np.ndarray:
    try:
        array = np.ravel(np.asarray(value, dtype=np.float64))
    except (TypeError, ValueError):
        array = np.empty(0)
    if array.size != count or not np.isfinite(array).all():
        raise RecordingError(where=where, expected=f"{count} finite numbers", found="something else")
    return array
