"""The camera or the stereo rig of a recording: stereo.yaml (docs/recording.md), or a calibration of another program.

What a file is shows in its content, never in its name. Plain numbers: no torch is needed.
"""

import json
from pathlib import Path
from typing import Any

import numpy as np

from rmis_calib.errors import FileError, RecordingError
from rmis_calib.io._camera_formats import camera_info, matlab, matrices, texts
from rmis_calib.io._checks import Note, no_note, rigid_from_text
from rmis_calib.io._schemas import CameraSchema, StereoSchema
from rmis_calib.io.configs import LARGEST_YAML, load_yaml, read_bytes
from rmis_calib.io.intrinsics import Intrinsics, PictureSize, StereoFile, check_baseline
from rmis_calib.io.validation import validate

_KNOWN = (
    "stereo.yaml of this program, a ROS camera_info, OpenCV FileStorage, a kalibr camchain, MATLAB stereoParameters, "
    "SurgPose .ini, stereo_calib_params.json, EndoVis .txt, or a folder with left.yaml and right.yaml, "
    "intrinsics.yml and extrinsics.yml, or scikit-surgery's files"
)
_PAIR, _EXTRINSICS = ("left.yaml", "right.yaml"), "stereo_calib_params.json"


def read_stereo(path: str | Path, note: Note = no_note, picture_size: PictureSize | None = None) -> StereoFile:
    """Intrinsics and extrinsics. `left` is None for a file of one camera.

    Args:
        path: a file, or a folder that holds the files of a pair.
        note: told what was mended and guessed.
        picture_size: (height, width) of the pictures, for files that do not state it.

    Raises:
        FileError: the file is absent or unreadable.
        RecordingError: no known calibration, or an entry is missing, unknown or impossible; names the key.
    """
    path = Path(path)

    def size() -> tuple[int, int]:
        if picture_size is None:
            expected = "an image size in the file (or stereo.yaml of this program)"
            raise RecordingError(where=str(path), expected=expected, found="none")
        return picture_size()

    if path.is_dir():
        return _read_folder(path, note, size)
    head = read_bytes(path, LARGEST_YAML)
    start = head.lstrip(b"\xef\xbb\xbf \t\r\n")
    if start.startswith(b"MATLAB") or head[:4] == b"\x89HDF":
        return matlab.read_mat(path, note, size)
    if start.startswith(b"%YAML:1.0") or b"opencv-matrix" in head or b"<opencv_storage>" in head[:4096]:
        return matrices.read_opencv((path,), note, size)
    if b"[StereoLeft]" in head:
        return texts.read_ini(path, note)
    if b"Camera-0-F:" in head:
        return texts.read_endovis(path, note)
    if start.startswith(b"{") and path.suffix.lower() == ".json":
        return _from_json(path, head, note, size)
    return _from_yaml(path, note)


def read_camera_pair(right: Path, left: Path, note: Note = no_note) -> StereoFile:
    """The rig of two ROS camera_info files.

    Raises:
        FileError, RecordingError: as `read_stereo`.
    """
    return camera_info.pair_of_infos(
        camera_info.read_camera_info(left), camera_info.read_camera_info(right), rectified=False, note=note
    )


def _read_folder(folder: Path, note: Note, size: PictureSize) -> StereoFile:
    left, right = (folder / name for name in _PAIR)
    if left.is_file() and right.is_file():
        infos = camera_info.read_camera_info(left), camera_info.read_camera_info(right)
        extrinsics = folder / _EXTRINSICS
        if not infos[1].P[:, 3].any() and extrinsics.is_file():
            note(f"{right}: no baseline in its projection matrix: the cameras were read from {extrinsics.name}")
            height, width = infos[0].size
            return _from_json(extrinsics, read_bytes(extrinsics, LARGEST_YAML), note, lambda: (height, width))
        return camera_info.pair_of_infos(*infos, rectified=False, note=note)
    if texts.is_surgery_folder(folder):
        return texts.read_surgery_folder(folder, note, size)
    for suffix in (".yml", ".yaml", ".xml"):
        pair = (folder / f"intrinsics{suffix}", folder / f"extrinsics{suffix}")
        if all(path.is_file() for path in pair):
            return matrices.read_opencv(pair, note, size)
    if not folder.exists():
        raise FileError(where=str(folder), expected="a readable file", found="nothing there")
    found = ", ".join(sorted(path.name for path in folder.iterdir())[:6]) or "an empty folder"
    raise RecordingError(where=str(folder), expected=_KNOWN, found=found)


def _from_json(path: Path, content: bytes, note: Note, size: PictureSize) -> StereoFile:
    try:
        raw = json.loads(content.decode("utf-8-sig"))
    except (ValueError, RecursionError) as problem:
        raise RecordingError(where=str(path), expected="JSON", found="other text") from problem
    # jsonencode of a struct of structs, or of the variables around it
    for candidate in (raw, *(value for value in raw.values() if isinstance(value, dict))):
        if matlab.is_stereo_parameters(candidate):
            return matlab.from_stereo_parameters(candidate, str(path), note, size)
    if {"right", "image_size"} <= set(raw):
        return _from_yaml(path, note)
    return matrices.from_matrices(raw, str(path), note, size)


def _from_yaml(path: Path, note: Note) -> StereoFile:
    raw = load_yaml(path, RecordingError)
    if camera_info.is_camera_info(raw):
        note(f"{path}: one ROS camera_info: one camera (for a pair, name right and left, or their folder)")
        return camera_info.mono_of_info(camera_info.read_camera_info(path, raw), rectified=False, note=note)
    if texts.is_camchain(raw):
        return texts.from_camchain(raw, path, note)
    return _ours(path, raw, note)


def _ours(path: Path, raw: dict[str, Any], note: Note) -> StereoFile:
    schema = validate(StereoSchema, raw, str(path), RecordingError)
    width, height = schema.image_size
    right = _camera(schema.right, (height, width), f"{path}: right")
    if schema.left is None or schema.camera_left_T_camera_right is None:
        return StereoFile(right, None, None)
    left = _camera(schema.left, (height, width), f"{path}: left")
    where = f"{path}: camera_left_T_camera_right"
    matrix = rigid_from_text(schema.camera_left_T_camera_right, where, RecordingError, note)
    check_baseline(float(np.linalg.norm(matrix[:3, 3])), where)
    return StereoFile(right, left, matrix)


def _camera(schema: CameraSchema, size: tuple[int, int], where: str) -> Intrinsics:
    values = (schema.fx, schema.fy, schema.cx, schema.cy, tuple(schema.distortion))
    return Intrinsics(*values, size, schema.distortion_model).checked(where)
