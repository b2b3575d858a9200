"""Files that hold camera matrices, distortions and [R t] under names that vary: OpenCV FileStorage and plain JSON."""

from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np

from rmis_calib.errors import RecordingError
from rmis_calib.io._checks import Note
from rmis_calib.io.intrinsics import Intrinsics, PictureSize, StereoFile, lens, stereo_pair

# First (left) and second (right) camera; the names that OpenCV's samples, dVRK tools and common scripts use.
_MATRICES = (
    ("M1", "M2"), ("K1", "K2"), ("cameraMatrix1", "cameraMatrix2"), ("camera_matrix_1", "camera_matrix_2"),
    ("cameraMatrixL", "cameraMatrixR"), ("camera_matrix_left", "camera_matrix_right"), ("K_left", "K_right"),
    ("left_camera_matrix", "right_camera_matrix"), ("mtxL", "mtxR"), ("K_l", "K_r"),
)  # fmt: skip
_DISTORTIONS = (
    ("D1", "D2"), ("distCoeffs1", "distCoeffs2"), ("dist_coeffs_1", "dist_coeffs_2"), ("distCoeffsL", "distCoeffsR"),
    ("dist_coeffs_left", "dist_coeffs_right"), ("D_left", "D_right"), ("left_distortion", "right_distortion"),
    ("distL", "distR"), ("D_l", "D_r"), ("distortion_left", "distortion_right"),
)  # fmt: skip
_ONE_MATRIX = ("camera_matrix", "Camera_Matrix", "cameraMatrix", "K", "M")
_ONE_DISTORTION = ("distortion_coefficients", "Distortion_Coefficients", "distCoeffs", "dist_coeffs", "D")
_ROTATIONS, _TRANSLATIONS = ("R", "R_stereo", "rotation"), ("T", "T_mm", "t", "T_stereo", "translation")
_WIDTHS = ("Camera.width", "Camera_width", "image_width", "image_Width", "imageWidth", "width")
_HEIGHTS = ("Camera.height", "Camera_height", "image_height", "image_Height", "imageHeight", "height")
_SIZES = ("imageSize", "image_size", "size")
_MODELS = ("distortion_model", "camera_model", "model")


def read_opencv(paths: tuple[Path, ...], note: Note, picture_size: PictureSize) -> StereoFile:
    """OpenCV FileStorage files (YAML, XML or JSON), one or several that belong together.

    Raises:
        RecordingError: it is damaged, or holds no camera that is known by its names.
    """
    import cv2

    entries: dict[str, Any] = {}
    for path in paths:
        try:
            storage = cv2.FileStorage(str(path), cv2.FILE_STORAGE_READ)
            names = storage.root().keys()
            entries |= {name: _node_value(storage.getNode(name)) for name in names}
            storage.release()
        except (cv2.error, SystemError) as problem:  # its constructor fails as a SystemError
            raise RecordingError(
                where=str(path), expected="a whole OpenCV FileStorage file", found="damage"
            ) from problem
    return from_matrices(entries, str(paths[0]), note, picture_size)


def from_matrices(entries: Mapping[str, Any], where: str, note: Note, picture_size: PictureSize) -> StereoFile:
    """A rig, or one camera, from named matrices.

    Convention: as cv2.stereoCalibrate writes it, p_second = R p_first + T. Cameras that are only numbered count as left
    and right by where they lie.

    Raises:
        RecordingError: something is missing or impossible.
    """
    size = _image_size(entries, where, note, picture_size)
    pair = _first_pair(entries, _MATRICES)
    if pair is None:
        name = next((name for name in _ONE_MATRIX if name in entries), None)
        if name is None:
            expected = f"camera matrices under names such as {' '.join(_MATRICES[0])} or {_ONE_MATRIX[0]}"
            raise RecordingError(where=where, expected=expected, found=", ".join(map(str, entries)) or "nothing")
        bent = next((entries[name] for name in _ONE_DISTORTION if name in entries), ())
        return StereoFile(_camera(entries, entries[name], bent, size, f"{where}: {name}", note), None, None)
    names, matrices = pair
    bends = _first_pair(entries, _DISTORTIONS)
    if bends is None:
        note(f"{where}: no distortion coefficients: the pictures were taken for undistorted ones")
    cameras = [
        _camera(entries, matrices[i], () if bends is None else bends[1][i], size, f"{where}: {names[i]}", note)
        for i in range(2)
    ]
    R = next((entries[name] for name in _ROTATIONS if name in entries), None)
    t_name = next((name for name in _TRANSLATIONS if name in entries), None)
    if R is None or t_name is None:
        expected = "R and T of the second camera (OpenCV's sample writes them to a second file: name the folder)"
        raise RecordingError(where=where, expected=expected, found="camera matrices only")
    are_named = names[0][-1] in "Llt"  # ...L, K_l, ..._left
    mm = 1.0 if t_name == "T_mm" else None
    R, t = _matrix(R, (3, 3), f"{where}: R"), _matrix(entries[t_name], (3,), f"{where}: {t_name}")
    return stereo_pair(cameras[0], cameras[1], R, t, f"{where}: {t_name}", note, mm, are_named)


def _camera(
    entries: Mapping[str, Any], matrix: Any, bent: Any, size: tuple[int, int], where: str, note: Note
) -> Intrinsics:
    K = _matrix(matrix, (3, 3), where)
    if abs(K[0, 1]) > 1e-9 * abs(K[0, 0]):
        raise RecordingError(where=where, expected="pixels without skew", found=f"a skew of {K[0, 1]:g} px")
    named = next((str(entries[name]) for name in _MODELS if isinstance(entries.get(name), str)), None)
    if entries.get("fisheye") in (1, True):
        named = "fisheye"
    model, distortion = lens(np.ravel(np.asarray(bent, dtype=np.float64)).tolist(), named, where, note)
    return Intrinsics(K[0, 0], K[1, 1], K[0, 2], K[1, 2], distortion, size, model).checked(where)


def _image_size(entries: Mapping[str, Any], where: str, note: Note, picture_size: PictureSize) -> tuple[int, int]:
    """(height, width)."""
    width = next((entries[name] for name in _WIDTHS if name in entries), None)
    height = next((entries[name] for name in _HEIGHTS if name in entries), None)
    if width is not None and height is not None:
        return int(height), int(width)
    size = next((entries[name] for name in _SIZES if name in entries), None)
    if size is not None and len(np.ravel(size)) == 2:
        width, height = np.ravel(size)
        return int(height), int(width)
    height, width = picture_size()
    note(f"{where}: no image size is stated: that of the pictures was taken ({width} x {height} px)")
    return height, width


def _first_pair(
    entries: Mapping[str, Any], names: tuple[tuple[str, str], ...]
) -> tuple[tuple[str, str], list[Any]] | None:
    return next((((a, b), [entries[a], entries[b]]) for a, b in names if a in entries and b in entries), None)


def _matrix(value: Any, shape: tuple[int, ...], where: str) -> np.ndarray:
    try:
        array = np.asarray(value, dtype=np.float64).ravel()
    except (TypeError, ValueError):
        array = np.empty(0)
    if array.size != np.prod(shape) or not np.isfinite(array).all():
        raise RecordingError(where=where, expected=f"{np.prod(shape)} finite numbers", found=f"{array.size} numbers")
    return array.reshape(shape)


def _node_value(node: Any) -> Any:
    if node.isInt():
        return int(node.real())
    if node.isReal():
        return node.real()
    if node.isString():
        return node.string()
    if node.isSeq():
        return [_node_value(node.at(i)) for i in range(node.size())]
    matrix = node.mat()
    return matrix
