"""ROS `camera_info`: one camera a file or message; the pose of the pair is implied by R and P of both."""

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from rmis_calib.errors import RecordingError
from rmis_calib.io._checks import Note
from rmis_calib.io.configs import load_yaml
from rmis_calib.io.intrinsics import Intrinsics, StereoFile, lens, stereo_pair


@dataclass(frozen=True, eq=False)
class CameraInfo:
    """The numbers of a sensor_msgs/CameraInfo; metres in P."""

    where: str
    size: tuple[int, int]
    """(height, width)."""
    model: str
    D: tuple[float, ...]
    K: np.ndarray
    """(3, 3) of the raw pictures."""
    R: np.ndarray
    """(3, 3): turns the raw camera frame into the rectified one."""
    P: np.ndarray
    """(3, 4) of the rectified pictures."""

    @classmethod
    def from_values(
        cls, where: str, size: tuple[int, int], model: str, D: Sequence[float], K: Any, R: Any, P: Any
    ) -> "CameraInfo":
        """From lists in row order.

        Raises:
            RecordingError: a matrix of another size, a skewed or an empty camera matrix.
        """
        arrays = []
        for name, value, shape in (("K", K, (3, 3)), ("R", R, (3, 3)), ("P", P, (3, 4))):
            array = np.asarray(value, dtype=np.float64).ravel()
            if array.size != np.prod(shape) or not np.isfinite(array).all():
                expected = f"{np.prod(shape)} finite numbers"
                raise RecordingError(where=f"{where}: {name}", expected=expected, found=f"{array.size} entries")
            arrays.append(array.reshape(shape))
        if arrays[0][0, 0] == 0.0:
            raise RecordingError(where=f"{where}: K", expected="a calibrated camera", found="a camera matrix of zeros")
        if not arrays[1].any():  # not set: of a camera that is no part of a pair
            arrays[1] = np.eye(3)
        return cls(where, size, model, tuple(map(float, D)), *arrays)

    def intrinsics(self, rectified: bool, note: Note) -> Intrinsics:
        """The camera of the raw pictures (K, D), or of the rectified ones (P, no distortion)."""
        M = self.P if rectified else self.K
        if M[0, 0] == 0.0:
            raise RecordingError(where=f"{self.where}: P", expected="the camera of rectified pictures", found="zeros")
        if abs(M[0, 1]) > 1e-9 * M[0, 0]:
            raise RecordingError(where=self.where, expected="pixels without skew", found=f"a skew of {M[0, 1]:g} px")
        model, distortion = (
            lens((), None, self.where, note) if rectified else lens(self.D, self.model, self.where, note)
        )
        camera = Intrinsics(M[0, 0], M[1, 1], M[0, 2], M[1, 2], distortion, self.size, model)
        return camera.checked(self.where)


def read_camera_info(path: Path, raw: dict[str, Any] | None = None) -> CameraInfo:
    """From a file as `camera_calibration` or `rostopic echo` write it.

    Raises:
        FileError: the file is absent or unreadable.
        RecordingError: an entry is missing or impossible.
    """
    raw = load_yaml(path, RecordingError) if raw is None else raw

    def entry(*names: str, optional: bool = False) -> Any:
        for name in names:
            if name in raw:
                value = raw[name]
                return value["data"] if isinstance(value, dict) and "data" in value else value
        if optional:
            return None
        raise RecordingError(where=str(path), expected=f"{names[0]} of a ROS camera_info", found="nothing")

    size = (int(entry("image_height", "height")), int(entry("image_width", "width")))
    model = str(entry("distortion_model", optional=True) or "plumb_bob")
    K = entry("camera_matrix", "K", "k")
    R = entry("rectification_matrix", "R", "r", optional=True)
    P = entry("projection_matrix", "P", "p", optional=True)
    D = entry("distortion_coefficients", "D", "d", optional=True) or ()
    try:
        return CameraInfo.from_values(
            str(path), size, model, D, K, np.eye(3) if R is None else R, np.zeros((3, 4)) if P is None else P
        )
    except (TypeError, ValueError) as problem:
        if isinstance(problem, RecordingError):
            raise
        raise RecordingError(where=str(path), expected="numbers in a ROS camera_info", found=str(problem)) from problem


def is_camera_info(raw: dict[str, Any]) -> bool:
    """Whether a YAML mapping is one."""
    return "camera_matrix" in raw or {"K", "D", "P"} <= set(raw) or {"k", "d", "p"} <= set(raw)


def pair_of_infos(left: CameraInfo, right: CameraInfo, rectified: bool, note: Note) -> StereoFile:
    """The rig of two infos of a calibrated pair.

    Convention: with t = P[:, 3] / fx of each, p_rect_right = R_right p_right = R_left p_left + t_right - t_left.

    Raises:
        RecordingError: there is no baseline in P, or the cameras are swapped.
    """
    offsets = []
    for info in (left, right):
        if info.P[0, 0] == 0.0:
            raise RecordingError(where=f"{info.where}: P", expected="projection_matrix of a stereo pair", found="zeros")
        offsets.append(info.P[:, 3] / np.array([info.P[0, 0], info.P[1, 1], 1.0]))
    rect_t = offsets[1] - offsets[0]
    if not rect_t.any():
        expected = "a baseline in P[0, 3] of the second camera (a pair that was calibrated together)"
        raise RecordingError(where=right.where, expected=expected, found="0")
    if rectified:
        right_R_left, right_t_left = np.eye(3), rect_t
    else:
        right_R_left, right_t_left = right.R.T @ left.R, right.R.T @ rect_t
    cameras = (left.intrinsics(rectified, note), right.intrinsics(rectified, note))
    return stereo_pair(*cameras, right_R_left, right_t_left, right.where, note, 1000.0, are_named=True)


def mono_of_info(info: CameraInfo, rectified: bool, note: Note) -> StereoFile:
    """One camera on its own."""
    return StereoFile(info.intrinsics(rectified, note), None, None)
