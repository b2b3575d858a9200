"""Cameras in plain numbers, and the checks that every camera file goes through, whoever wrote it. Needs no torch."""

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace

import numpy as np

from rmis_calib.errors import RecordingError
from rmis_calib.geometry.lens_models import LensModel
from rmis_calib.io._checks import Note, rigid_from_text
from rmis_calib.io._schemas import METRES

# From the closest chip-on-tip pair to a bench rig; a laparoscope has 4 to 6 mm.
_BASELINE_MM = (0.1, 200.0)
# From a fish-eye to a microscope, in image widths.
_FOCAL_WIDTHS = (0.05, 100.0)
# Baselines of files that state no unit: above the first millimetres, below the second metres, between them unclear.
_SURELY_MM, _SURELY_METRES = 1.0, 0.25
# Tangential terms of real lenses are below 0.01; of a fisheye's four radial terms the last two are often above this.
_LARGEST_TANGENTIAL = 0.05
_SAME_LENS: dict[str, LensModel] = {
    "plumb_bob": "plumb_bob",
    "radtan": "plumb_bob",
    "none": "plumb_bob",
    "rational_polynomial": "rational_polynomial",
    "equidistant": "equidistant",
    "fisheye": "equidistant",
}

PictureSize = Callable[[], tuple[int, int]]
"""(height, width) of the recording's pictures, for files that do not state a size; raises where nobody knows it."""


@dataclass(frozen=True)
class Intrinsics:
    """One camera in plain numbers, px; the distortion as its model orders it (geometry.lens_models)."""

    fx: float
    fy: float
    cx: float
    cy: float
    distortion: tuple[float, ...]
    image_size: tuple[int, int]
    """(height, width)."""
    model: LensModel = "plumb_bob"

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
        return replace(self, fx=self.fx * scale, fy=self.fy * scale, cx=cx, cy=cy, image_size=(height, width))

    def checked(self, where: str) -> "Intrinsics":
        """The same camera.

        Raises:
            RecordingError: a number that no camera has; names the key.
        """
        height, width = self.image_size
        if min(height, width) < 1:
            raise RecordingError(where=where, expected="an image size of 1 px or more", found=self.image_size)
        least, most = (width * factor for factor in _FOCAL_WIDTHS)
        for key, value in (("fx", self.fx), ("fy", self.fy)):
            if not least <= value <= most:
                expected = f"a focal length of {least:g} to {most:g} px"
                raise RecordingError(where=f"{where}.{key}", expected=expected, found=value)
        for key, value, side in (("cx", self.cx, width), ("cy", self.cy, height)):
            # A crop may move the principal point out of the picture, but not by more than a picture.
            if not -side <= value <= 2 * side:
                expected = f"a principal point of {-side} to {2 * side} px"
                raise RecordingError(where=f"{where}.{key}", expected=expected, found=value)
        if not np.isfinite(self.distortion).all():
            raise RecordingError(where=f"{where}.distortion", expected="finite numbers", found=self.distortion)
        return self

    def to_dict(self) -> dict:
        """As stereo.yaml writes a camera; the model only where it is not the usual one."""
        values = {key: float(getattr(self, key)) for key in ("fx", "fy", "cx", "cy")}
        named = {} if self.model == "plumb_bob" else {"distortion_model": self.model}
        return values | named | {"distortion": [float(value) for value in self.distortion]}


@dataclass(frozen=True, eq=False)
class StereoFile:
    """Content of a camera file."""

    right: Intrinsics
    left: Intrinsics | None
    camera_left_T_camera_right: np.ndarray | None
    """(4, 4), mm."""

    def to_dict(self) -> dict:
        """As stereo.yaml writes it.

        Raises:
            RecordingError: the two cameras have pictures of different sizes, which stereo.yaml cannot say.
        """
        height, width = self.right.image_size
        content: dict = {"image_size": [width, height], "right": self.right.to_dict()}
        if self.left is None or self.camera_left_T_camera_right is None:
            return content
        if self.left.image_size != self.right.image_size:
            found = f"{self.right.image_size} and {self.left.image_size}"
            raise RecordingError(where="stereo.yaml", expected="pictures of one (height, width)", found=found)
        extrinsics = self.camera_left_T_camera_right.tolist()
        return content | {"left": self.left.to_dict(), "camera_left_T_camera_right": extrinsics}


def lens(distortion: Sequence[float], name: str | None, where: str, note: Note) -> tuple[LensModel, tuple[float, ...]]:
    """Model and coefficients of a distortion as other programs list it.

    Args:
        distortion: in OpenCV's order; any number of entries that OpenCV knows.
        name: the model, as ROS, kalibr or OpenCV call it; None where the file does not say.
        where: file and camera, for messages.
        note: told what was guessed.

    Raises:
        RecordingError: a model or a number of entries that is not known, or terms that are not modelled.
    """
    values = tuple(float(value) for value in distortion)
    if not np.isfinite(values).all():
        raise RecordingError(where=where, expected="finite distortion coefficients", found=list(values))
    if name is not None and name not in _SAME_LENS:
        expected = f"a lens model of {', '.join(sorted(_SAME_LENS))}"
        raise RecordingError(where=where, expected=expected, found=name)
    model = None if name is None else _SAME_LENS[name]
    if model == "equidistant":
        if len(values) not in (0, 4):
            raise RecordingError(where=where, expected="4 coefficients of a fisheye lens", found=len(values))
        return model, values or (0.0,) * 4
    if len(values) not in (0, 4, 5, 8, 12, 14):
        raise RecordingError(where=where, expected="0, 4, 5, 8, 12 or 14 distortion coefficients", found=len(values))
    if len(values) == 4 and name is None:
        if max(map(abs, values[2:])) > _LARGEST_TANGENTIAL:
            found = f"{list(values)}: a fisheye lens (k1 to k4), or k1, k2, p1, p2?"
            raise RecordingError(where=where, expected="a file that names its lens model", found=found)
        note(f"{where}: four distortion coefficients were read as k1, k2, p1, p2 (not as a fisheye's k1 to k4)")
    values += (0.0,) * (5 - len(values))
    if any(values[8:]):
        expected = "no thin-prism or tilted-sensor terms (coefficients 9 to 14)"
        raise RecordingError(where=where, expected=expected, found=list(values[8:]))
    return ("rational_polynomial", values[:8]) if any(values[5:8]) else ("plumb_bob", values[:5])


def stereo_pair(
    first: Intrinsics,
    second: Intrinsics,
    second_R_first: np.ndarray,
    second_t_first: np.ndarray,
    where: str,
    note: Note,
    mm_per_unit: float | None = None,
    are_named: bool = False,
) -> StereoFile:
    """Two cameras of another program's file as a rig: p_second = R p_first + t.

    Args:
        first, second: the cameras; `first` is the left one where the file names them.
        second_R_first: (3, 3).
        second_t_first: (3,), in the file's unit.
        where: file and key, for messages.
        note: told what was guessed.
        mm_per_unit: of the translation; None where the file states no unit, which is then told from its size.
        are_named: the file says which camera is the left one; else the one that lies on the left is taken for it.

    Raises:
        RecordingError: no rotation, no baseline that a camera has, a unit that cannot be told, or a left camera that
            lies right of the right one.
    """
    t = np.asarray(second_t_first, dtype=np.float64).reshape(3)
    length = float(np.linalg.norm(t))
    if mm_per_unit is None:
        mm_per_unit = _mm_per_unit(length, where)
        unit = "millimetres" if mm_per_unit == 1.0 else "metres"
        note(f"{where}: the translation was read in {unit}: a baseline of {length * mm_per_unit:.4g} mm")
    rows = np.eye(4)
    rows[:3, :3], rows[:3, 3] = second_R_first, t * mm_per_unit
    if not np.isfinite(rows).all():
        raise RecordingError(where=where, expected="finite numbers in rotation and translation", found="others")
    second_T_first = rigid_from_text(rows.tolist(), where, RecordingError, note)
    check_baseline(length * mm_per_unit, where)
    first_p_second = -second_T_first[:3, :3].T @ second_T_first[:3, 3]
    if first_p_second[0] > 0:
        return StereoFile(second, first, _inverse(second_T_first))
    if are_named:
        found = f"the right camera {abs(first_p_second[0]):.3g} mm to the left of the left one"
        expected = (
            "the right camera on the right (x) of the left one; are the names swapped, or the transform inverted?"
        )
        raise RecordingError(where=where, expected=expected, found=found)
    note(f"{where}: the first camera lies to the right of the second one and was taken for the right one")
    return StereoFile(first, second, second_T_first)


def check_baseline(baseline_mm: float, where: str) -> None:
    """Refuse a distance between the cameras that no rig has."""
    least, most = _BASELINE_MM
    if not least <= baseline_mm <= most:
        hint = METRES if 0 < baseline_mm < least else ""
        expected = f"a baseline of {least:g} to {most:g} mm"
        raise RecordingError(hint, where=where, expected=expected, found=f"{baseline_mm:g} mm")


def _mm_per_unit(length: float, where: str) -> float:
    if length >= _SURELY_MM:
        return 1.0
    if length <= _SURELY_METRES:
        return 1000.0
    expected = (
        f"a translation in mm ({_SURELY_MM:g} or more) or metres ({_SURELY_METRES:g} or less); the file states no unit"
    )
    raise RecordingError(where=where, expected=expected, found=f"a length of {length:g}")


def _inverse(b_T_a: np.ndarray) -> np.ndarray:
    a_T_b = np.eye(4)
    a_T_b[:3, :3] = b_T_a[:3, :3].T
    a_T_b[:3, 3] = -b_T_a[:3, :3].T @ b_T_a[:3, 3]
    return a_T_b
