"""Residuals of each kind of measurement and camera, by motion, with their median and root mean square."""

import numpy as np

from rmis_calib.io import Recording
from rmis_calib.pipeline.arms.poses import MotionPoses
from rmis_calib.results import Residual
from rmis_calib.solver import Solution


def residuals_normalised(solution: Solution, used: np.ndarray) -> dict[str, Residual]:
    """Residuals per kind and camera in normalised image units, for observations without a camera."""
    return {
        name: residual_of(by_motion, "1e-3 of the focal length", used)
        for name, by_motion in residual_arrays(solution, 1e3, 1e3).items()
    }


def residual_arrays(solution: Solution, scale_right: float, scale_left: float) -> dict[str, np.ndarray]:
    """(N,) residuals of each kind and camera, times the camera's scale (its focal length turns them into px)."""
    scales = (("right", scale_right), ("left", scale_left))
    arrays = {}
    for name, kind in (("contour", "lines"), ("end", "ends"), ("head", "heads")):
        values = getattr(solution, f"residual_{kind}").cpu().numpy()
        for row, (side, scale) in zip(values, scales, strict=False):
            if np.isfinite(row).any():
                arrays[f"{name}_{side}"] = row * scale
    return arrays


def residual_of(by_motion: np.ndarray, unit: str, used: np.ndarray) -> Residual:
    """Median and root mean square over the used motions, with the value of every motion that was measured."""
    known = by_motion[np.isfinite(by_motion) & used]
    median = float(np.median(known)) if len(known) else None
    rms = float(np.sqrt(np.mean(known**2))) if len(known) else None
    return Residual(unit, median, rms, by_motion)


def residuals_px(recording: Recording, poses: MotionPoses, solution: Solution, used: np.ndarray) -> dict[str, Residual]:
    """Residuals of each kind and camera in pixels, by frame."""
    left = recording.stereo.left
    arrays = residual_arrays(
        solution, float(recording.stereo.right.focal), float(left.focal) if left is not None else 1.0
    )
    found = {}
    for name, by_motion in arrays.items():
        by_frame = np.full(recording.n_frames, np.nan)
        by_frame[poses.frames] = by_motion
        found[name] = residual_of(by_frame, "px", used)
    return found
