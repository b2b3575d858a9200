"""The camera or the stereo rig of a recording, from stereo.yaml (DESIGN.md 6.1)."""

from pathlib import Path

import numpy as np
import torch

from rmis_calib.errors import RecordingError
from rmis_calib.geometry.cameras import Camera, StereoRig
from rmis_calib.geometry.rigid import RigidTransform
from rmis_calib.io._checks import Note, check_rigid, no_note
from rmis_calib.io._schemas import METRES, CameraSchema, StereoSchema
from rmis_calib.io._validation import validate
from rmis_calib.io.configs import load_yaml

# From the closest chip-on-tip pair to a bench rig; a laparoscope has 4 to 6 mm.
_BASELINE_MM = (0.1, 200.0)
# From a fish-eye to a microscope, in image widths.
_FOCAL_WIDTHS = (0.05, 100.0)


def load_stereo(path: str | Path, note: Note = no_note) -> StereoRig:
    """Cameras in float64. `left` is None for a file of one camera.

    Args:
        path: stereo.yaml.
        note: told what was mended.

    Raises:
        FileError: the file is absent or unreadable.
        RecordingError: an entry is missing, unknown or impossible; names the key.
    """
    path = Path(path)
    schema = validate(StereoSchema, load_yaml(path, RecordingError), str(path), RecordingError)
    width, height = schema.image_size
    right = _camera(schema.right, (height, width), f"{path}: right")
    if schema.left is None:
        return StereoRig(right)
    left = _camera(schema.left, (height, width), f"{path}: left")
    matrix = np.array(schema.camera_left_T_camera_right, dtype=np.float64)
    where = f"{path}: camera_left_T_camera_right"
    check_rigid(matrix, where, RecordingError)
    _check_baseline(float(np.linalg.norm(matrix[:3, 3])), where)
    return StereoRig(right, left, RigidTransform("camera_left", "camera_right", torch.from_numpy(matrix)))


def _camera(schema: CameraSchema, size: tuple[int, int], where: str) -> Camera:
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
    return Camera.from_values(schema.fx, schema.fy, schema.cx, schema.cy, schema.distortion, image_size=size)


def _check_baseline(baseline_mm: float, where: str) -> None:
    least, most = _BASELINE_MM
    if not least <= baseline_mm <= most:
        hint = METRES if 0 < baseline_mm < least else ""
        expected = f"a baseline of {least:g} to {most:g} mm"
        raise RecordingError(hint, where=where, expected=expected, found=f"{baseline_mm:g} mm")
