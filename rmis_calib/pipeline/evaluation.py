"""How good a result is: head-point reprojection error, and the distance to a known truth."""

import math
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import torch
from jaxtyping import Float
from torch import Tensor

from rmis_calib.errors import InputError
from rmis_calib.geometry.rigid import RigidTransform, rigid_inverse, transform_points
from rmis_calib.geometry.rotations import matrix_to_rotvec
from rmis_calib.io import Recording, load_recording, load_yaml
from rmis_calib.pipeline.poses import MotionPoses, motion_poses
from rmis_calib.results import CalibrationResult


@dataclass(frozen=True)
class Evaluation:
    """Measures of one result.

    Attributes:
        head_point_error_px: per camera `{median, rms, max, count}`; None without head points.
        rotation_error_deg: angle between the result and the truth; None without a truth.
        translation_error_mm: distance between the two translations.
        error_sigmas: Mahalanobis distance of the error under the result's own covariance (6 degrees of freedom).
    """

    head_point_error_px: dict[str, dict[str, float]] | None
    rotation_error_deg: float | None
    translation_error_mm: float | None
    error_sigmas: float | None

    def to_dict(self) -> dict[str, Any]:
        return dict(vars(self))

    def rows(self) -> list[tuple[str, str]]:
        """What a table shows."""
        rows = []
        for camera, error in (self.head_point_error_px or {}).items():
            text = f"median {error['median']:.2f} px, rms {error['rms']:.2f} px, max {error['max']:.2f} px"
            rows.append((f"head point, camera_{camera}", f"{text} ({error['count']:.0f} points)"))
        if self.rotation_error_deg is not None and self.translation_error_mm is not None:
            rows.append(("rotation error", f"{self.rotation_error_deg:.3f} deg"))
            rows.append(("translation error", f"{self.translation_error_mm:.3f} mm"))
        if self.error_sigmas is not None:
            bound = f"{CHI_3_SIGMA:.2f} is the 3 sigma bound of 6 unknowns"
            rows.append(("error in its own sigmas", f"{self.error_sigmas:.2f} ({bound})"))
        return rows or [("nothing to compare with", "no head_points.csv, no truth")]


CHI_3_SIGMA = 4.4876
"""Mahalanobis distance in 6 dimensions that a Gaussian error exceeds as rarely as 3 sigma in one (0.27 %)."""


def evaluate(
    result: CalibrationResult, recording: Recording | str | Path, truth: str | Path | None = None
) -> Evaluation:
    """Measure a result against the recording's head points and against a truth.

    Args:
        result: what is measured.
        recording: the recording, or its folder.
        truth: YAML file with `camera_right_T_arm` (4x4 rows, mm); default: the recording's ground_truth.yaml, if any.
    Raises:
        InputError: the result has no transform, or a file breaks its format.
    """
    if result.camera_right_T_arm is None:
        raise InputError(where="result", expected="a transform to evaluate", found=f"status {result.status}")
    opened = load_recording(recording) if isinstance(recording, (str, Path)) else recording
    beside = opened.path / "ground_truth.yaml"
    rotation_deg, translation_mm, sigmas = None, None, None
    if truth is not None or beside.is_file():
        rotation_deg, translation_mm, sigmas = _errors(
            result.camera_right_T_arm.matrix, result.covariance, read_transform(Path(truth or beside))
        )
    errors = head_point_errors(result, opened, motion_poses(opened))
    return Evaluation(summarise_head_points(errors), rotation_deg, translation_mm, sigmas)


def head_point_errors(
    result: CalibrationResult, recording: Recording, poses: MotionPoses
) -> dict[str, np.ndarray] | None:
    """Distance in px of each labelled head point from where the result puts it, (N,) per camera, NaN where unlabelled.

    Source: paper, "Experimental results": the known point on the instrument, seen through kinematics and calibration.
    """
    points = recording.head_points
    if points is None or result.camera_right_T_arm is None:
        return None
    errors = {}
    views = {"right": (recording.stereo.right, result.camera_right_T_arm, points.uv_right)}
    if points.uv_left is not None and result.camera_left_T_arm is not None and recording.stereo.left is not None:
        views["left"] = (recording.stereo.left, result.camera_left_T_arm, points.uv_left)
    arm_p_head = transform_points(poses.arm_T_rcm.cpu(), poses.rcm_p_head.cpu())
    for name, (camera, camera_T_arm, uv) in views.items():
        predicted = np.full((recording.n_frames, 2), np.nan)
        predicted[poses.frames] = camera.project(camera_T_arm.apply(arm_p_head))[0].numpy()
        errors[name] = np.full(recording.n_frames, np.nan)
        errors[name][points.frames] = np.linalg.norm(predicted[points.frames] - uv, axis=-1)
    return errors


def summarise_head_points(errors: dict[str, np.ndarray] | None) -> dict[str, dict[str, float]] | None:
    """Median, root mean square and maximum over the labelled frames of each camera."""
    if errors is None:
        return None
    summary = {}
    for name, distance in errors.items():
        known = distance[np.isfinite(distance)]
        if len(known):
            rms = float(np.sqrt(np.mean(known**2)))
            summary[name] = {"median": float(np.median(known)), "rms": rms, "max": float(known.max())}
            summary[name]["count"] = len(known)
    return summary or None


def read_transform(path: Path) -> RigidTransform:
    """`camera_right_T_arm` of a YAML file (4x4 rows, mm) or of a result.json.

    Raises:
        FileError: the file cannot be read.
        InputError: it holds no such transform.
    """
    raw = load_yaml(path, error=InputError)
    if "camera_right_T_arm" not in raw:
        raise InputError(where=str(path), expected="a key camera_right_T_arm", found=", ".join(raw))
    rows = raw["camera_right_T_arm"]
    try:
        matrix = torch.tensor(rows["matrix"] if isinstance(rows, dict) else rows, dtype=torch.float64)
    except (KeyError, TypeError, ValueError) as error:
        raise InputError(where=f"{path}: camera_right_T_arm", expected="4x4 rows", found=str(error)) from error
    return RigidTransform("camera_right", "arm", matrix)


def _errors(
    found: Float[Tensor, "4 4"], covariance: np.ndarray | None, truth: RigidTransform
) -> tuple[float, float, float | None]:
    """Rotation error (deg), translation error (mm), and both in units of the result's own covariance."""
    # R_true = exp(dphi) R_found and t_true = t_found + dt: the perturbation that the covariance describes.
    dphi = matrix_to_rotvec(truth.R @ rigid_inverse(found)[..., :3, :3])
    dt = truth.t - found[..., :3, 3]
    sigmas = None
    if covariance is not None:
        # Scaled to unit variances: radians and millimetres, and directions that are hardly known, differ by 1e12.
        scale = np.sqrt(np.diag(covariance))
        error = np.concatenate([dphi.numpy(), dt.numpy()]) / scale
        sigmas = math.sqrt(error @ np.linalg.pinv(covariance / np.outer(scale, scale), hermitian=True) @ error)
    return math.degrees(float(dphi.norm())), float(dt.norm()), sigmas
