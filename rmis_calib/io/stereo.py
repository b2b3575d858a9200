"""The camera or the stereo rig of a recording, from stereo.yaml (DESIGN.md 6.1). Plain numbers: no torch is needed."""

from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np

from rmis_calib.errors import RecordingError
from rmis_calib.io._checks import Note, no_note, rigid_from_text
from rmis_calib.io._schemas import METRES, CameraSchema, StereoSchema
from rmis_calib.io.configs import LARGEST_YAML, load_yaml, read_bytes
from rmis_calib.io.validation import validate

# From the closest chip-on-tip pair to a bench rig; a laparoscope has 4 to 6 mm.
_BASELINE_MM = (0.1, 200.0)
# From a fish-eye to a microscope, in image widths.
_FOCAL_WIDTHS = (0.05, 100.0)
_OURS = "a stereo.yaml of this program (image_size, right, left, camera_left_T_camera_right)"


@dataclass(frozen=True)
class Intrinsics:
    """One camera in plain numbers; px, Brown-Conrady distortion [k1, k2, p1, p2, k3]."""

    fx: float
    fy: float
    cx: float
    cy: float
    distortion: tuple[float, ...]
    image_size: tuple[int, int]
    """(height, width)."""

    def cropped(self, crop: list[int] | None, where: str) -> "Intrinsics":
        """The camera of pictures that show [u, v, width, height] of the calibrated one.

        Raises:
            RecordingError: the part reaches beyond the calibrated picture.
        """
        if crop is None:
            return self
        u, v, width, height = crop
        if u + width > self.image_size[1] or v + height > self.image_size[0]:
            expected = f"a part of the calibrated picture ({self.image_size[1]} x {self.image_size[0]} px)"
            raise RecordingError(where=where, expected=expected, found=crop)
        return replace(self, cx=self.cx - u, cy=self.cy - v, image_size=(height, width))

    def scaled(self, scale: float) -> "Intrinsics":
        """The camera of pictures that are resized by this factor; pixel (0, 0) is the centre of the first pixel."""
        height, width = (round(scale * side) for side in self.image_size)
        cx, cy = ((centre + 0.5) * scale - 0.5 for centre in (self.cx, self.cy))
        return Intrinsics(self.fx * scale, self.fy * scale, cx, cy, self.distortion, (height, width))


@dataclass(frozen=True, eq=False)
class StereoFile:
    """Content of a stereo.yaml."""

    right: Intrinsics
    left: Intrinsics | None
    camera_left_T_camera_right: np.ndarray | None
    """(4, 4), mm."""


def read_stereo(path: str | Path, note: Note = no_note) -> StereoFile:
    """Intrinsics and extrinsics. `left` is None for a file of one camera.

    Args:
        path: stereo.yaml.
        note: told what was mended.

    Raises:
        FileError: the file is absent or unreadable.
        RecordingError: it is of another program, or an entry is missing, unknown or impossible; names the key.
    """
    path = Path(path)
    _refuse_opencv(path)
    raw = load_yaml(path, RecordingError)
    _refuse_other_programs(path, raw)
    schema = validate(StereoSchema, raw, str(path), RecordingError)
    width, height = schema.image_size
    right = _camera(schema.right, (height, width), f"{path}: right")
    if schema.left is None or schema.camera_left_T_camera_right is None:
        return StereoFile(right, None, None)
    left = _camera(schema.left, (height, width), f"{path}: left")
    where = f"{path}: camera_left_T_camera_right"
    matrix = rigid_from_text(schema.camera_left_T_camera_right, where, RecordingError, note)
    _check_baseline(float(np.linalg.norm(matrix[:3, 3])), where)
    return StereoFile(right, left, matrix)


def _refuse_opencv(path: Path) -> None:
    head = read_bytes(path, LARGEST_YAML)[:4096]
    if head.startswith(b"%YAML:1.0") or b"opencv-matrix" in head or b"<opencv_storage>" in head:
        found = (
            "an OpenCV FileStorage file: copy fx, fy, cx, cy from its camera matrices and k1, k2, p1, p2, k3 from its "
            "distortion, in this order; with stereoCalibrate of (left, right), camera_left_T_camera_right is the "
            "inverse of its [R T], in mm"
        )
        raise RecordingError(where=str(path), expected=_OURS, found=found)


def _refuse_other_programs(path: Path, raw: dict[str, Any]) -> None:
    if {"camera_matrix", "distortion_coefficients"} & set(raw) or {"K", "D", "P"} <= set(raw):
        found = (
            "a ROS camera_info of one camera: copy fx, fy, cx, cy from camera_matrix and k1, k2, p1, p2, k3 from "
            "distortion_coefficients; the baseline, m, is -P[0,3] / P[0,0] of the second camera's projection_matrix, "
            "and the rotation R_left^T R_right of the two rectification matrices"
        )
        raise RecordingError(where=str(path), expected=_OURS, found=found)
    first = raw.get("cam0")
    if isinstance(first, dict) and "intrinsics" in first:
        found = (
            "a kalibr camchain: intrinsics are fx, fy, cx, cy; distortion_coeffs of radtan are k1, k2, p1, p2 "
            "(k3 = 0); T_cn_cnm1 of cam1, its translation times 1000, maps cam0 to cam1"
        )
        raise RecordingError(where=str(path), expected=_OURS, found=found)


def _camera(schema: CameraSchema, size: tuple[int, int], where: str) -> Intrinsics:
    height, width = size
    least, most = (width * factor for factor in _FOCAL_WIDTHS)
    for key, value in (("fx", schema.fx), ("fy", schema.fy)):
        if not least <= value <= most:
            expected = f"a focal length of {least:g} to {most:g} px"
            raise RecordingError(where=f"{where}.{key}", expected=expected, found=value)
    for key, value, side in (("cx", schema.cx, width), ("cy", schema.cy, height)):
        # A crop may move the principal point out of the picture, but not by more than a picture.
        if not -side <= value <= 2 * side:
            expected = f"a principal point of {-side} to {2 * side} px"
            raise RecordingError(where=f"{where}.{key}", expected=expected, found=value)
    return Intrinsics(schema.fx, schema.fy, schema.cx, schema.cy, tuple(schema.distortion), size)


def _check_baseline(baseline_mm: float, where: str) -> None:
    least, most = _BASELINE_MM
    if not least <= baseline_mm <= most:
        hint = METRES if 0 < baseline_mm < least else ""
        expected = f"a baseline of {least:g} to {most:g} mm"
        raise RecordingError(hint, where=where, expected=expected, found=f"{baseline_mm:g} mm")
