"""How good a result is: head-point reprojection error, and the distance to a known truth."""

import math
from dataclasses import asdict, dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
from torch import Tensor

from rmis_calib.errors import InputError
from rmis_calib.geometry.cameras import Camera
from rmis_calib.geometry.rigid import RigidTransform, rigid_inverse, transform_points
from rmis_calib.geometry.rotations import matrix_to_rotvec
from rmis_calib.io import Recording, load_recording
from rmis_calib.io.reference import Reference, read_reference
from rmis_calib.pipeline.arms.found_offsets import poses_at, poses_at_motions
from rmis_calib.pipeline.arms.kinematic_unknowns import KinematicUnknowns
from rmis_calib.pipeline.arms.poses import MotionPoses, row_delay_s
from rmis_calib.results import CalibrationResult, HeadPointError, KinematicOffsets


@dataclass(frozen=True)
class Evaluation:
    """Measures of one result.

    Attributes:
        head_point_error_px: per camera; None without head points.
        rotation_error_deg: angle between the result and the reference; None without a reference.
        translation_error_mm: distance between the two translations.
        error_sigmas: Mahalanobis distance of the error under the sum of both covariances (6 degrees of freedom).
        result_sigma_deg, result_sigma_mm: of the result; root of the trace, as in a result.
        reference_sigma_deg, reference_sigma_mm: of the reference; zero for one that counts as exact.
    """

    head_point_error_px: dict[str, HeadPointError] | None
    rotation_error_deg: float | None = None
    translation_error_mm: float | None = None
    error_sigmas: float | None = None
    result_sigma_deg: float | None = None
    result_sigma_mm: float | None = None
    reference_sigma_deg: float | None = None
    reference_sigma_mm: float | None = None

    def to_dict(self) -> dict[str, Any]:
        return asdict(self)

    def rows(self) -> list[tuple[str, str]]:
        """What a table shows."""
        rows = []
        for camera, error in (self.head_point_error_px or {}).items():
            text = f"median {error.median:.2f} px, rms {error.rms:.2f} px, max {error.max:.2f} px"
            rows.append((f"head point, camera_{camera}", f"{text} ({error.count} points)"))
        if self.rotation_error_deg is not None and self.translation_error_mm is not None:
            rows.append(("rotation error", f"{self.rotation_error_deg:.3f} deg"))
            rows.append(("translation error", f"{self.translation_error_mm:.3f} mm"))
        if self.result_sigma_deg is not None and self.result_sigma_mm is not None:
            rows.append(("1 sigma of the result", f"{self.result_sigma_deg:.3f} deg, {self.result_sigma_mm:.3f} mm"))
        if self.reference_sigma_deg is not None and self.reference_sigma_mm is not None:
            sigma = f"{self.reference_sigma_deg:.3f} deg, {self.reference_sigma_mm:.3f} mm"
            is_exact = not self.reference_sigma_deg and not self.reference_sigma_mm
            rows.append(("1 sigma of the reference", "none stated: it counts as exact" if is_exact else sigma))
        if self.error_sigmas is not None:
            bound = f"{CHI_3_SIGMA:.2f} is the 3 sigma bound of 6 unknowns"
            rows.append(("error in sigmas of both", f"{self.error_sigmas:.2f} ({bound})"))
        return rows or [("nothing to compare with", "no head_points.csv, no truth")]


CHI_3_SIGMA = 4.4876
"""Mahalanobis distance in 6 dimensions that a Gaussian error exceeds as rarely as 3 sigma in one (0.27 %)."""


def evaluate(
    result: CalibrationResult, recording: Recording | str | Path, truth: str | Path | None = None
) -> Evaluation:
    """Measure a result against the recording's head points and against a reference.

    The clock, the joint offsets and the RCM offset that the calibration found are applied, as it applied them itself.

    Args:
        result: what is measured.
        recording: the recording, or its folder.
        truth: a file as `read_reference` takes it; default: the recording's ground_truth.yaml, if any.

    Raises:
        InputError: the result has no transform, or a file breaks its format.
    """
    if result.camera_right_T_arm is None:
        raise InputError(where="result", expected="a transform to evaluate", found=f"status {result.status}")
    opened = load_recording(recording) if isinstance(recording, (str, Path)) else recording
    beside = opened.path / "ground_truth.yaml"
    errors = head_point_errors(result, opened, poses_at(opened, result.kinematic_offsets))
    measured = Evaluation(summarise_head_points(errors))
    if truth is None and not beside.is_file():
        return measured
    return _compared(measured, result, read_reference(Path(truth or beside)))


def head_point_errors(
    result: CalibrationResult, recording: Recording, poses: MotionPoses
) -> dict[str, np.ndarray] | None:
    """Distance in px of each labelled head point from where the result puts it, (N,) per camera, NaN where unlabelled.

    Each point is predicted at the instant at which its row was read.

    Args:
        result: with a transform.
        recording: with the labels.
        poses: of the motions, with what the calibration found to be off (clock, joints, RCM, set-up).

    Source: paper, "Experimental results": the known point on the instrument, seen through kinematics and calibration.
    """
    points = recording.head_points
    if points is None or result.camera_right_T_arm is None:
        return None
    errors = {}
    views = {"right": (recording.stereo.right, result.camera_right_T_arm, points.uv_right)}
    if points.uv_left is not None and result.camera_left_T_arm is not None and recording.stereo.left is not None:
        views["left"] = (recording.stereo.left, result.camera_left_T_arm, points.uv_left)
    ends = _poses_at_first_and_last_row(recording, result.kinematic_offsets, poses)
    for name, (camera, camera_T_arm, uv) in views.items():
        predicted = np.full((recording.n_frames, 2), np.nan)
        camera = camera.corrected(*result.intrinsic_correction(name))

        def seen(at: MotionPoses, camera: Camera = camera, camera_T_arm: RigidTransform = camera_T_arm) -> Tensor:
            arm_p_head = transform_points(at.arm_T_rcm.cpu(), at.rcm_p_head.cpu())
            return camera.project(camera_T_arm.apply(arm_p_head))[0]

        uv_px = seen(poses)
        if ends:
            travel = seen(ends[1]) - seen(ends[0])
            uv_px = uv_px + row_delay_s(camera, uv_px[:, 1], 1.0)[:, None] * travel
        predicted[poses.frames] = uv_px.numpy()
        errors[name] = np.full(recording.n_frames, np.nan)
        errors[name][points.frames] = np.linalg.norm(predicted[points.frames] - uv, axis=-1)
    return errors


def _poses_at_first_and_last_row(
    recording: Recording, offsets: KinematicOffsets, poses: MotionPoses
) -> list[MotionPoses]:
    """Poses of the motions when the first and when the last row of each picture is read; none where all are read
    together, or the joints' velocity is not known."""
    half_s = 0.5 * recording.rolling_shutter_s
    if not half_s:
        return []
    unknowns = KinematicUnknowns(recording, poses.frames, str(poses.arm_T_rcm.device))
    return [poses_at_motions(unknowns, poses, offsets, s) for s in (-half_s, half_s)] if unknowns.has_clock else []


def summarise_head_points(errors: dict[str, np.ndarray] | None) -> dict[str, HeadPointError] | None:
    """Median, root mean square and maximum over the labelled frames of each camera."""
    if errors is None:
        return None
    summary = {}
    for name, distance in errors.items():
        known = distance[np.isfinite(distance)]
        if len(known):
            rms = float(np.sqrt(np.mean(known**2)))
            summary[name] = HeadPointError(float(np.median(known)), rms, float(known.max()), len(known))
    return summary or None


def _compared(measured: Evaluation, result: CalibrationResult, reference: Reference) -> Evaluation:
    """The evaluation with the distance to a reference, in deg, mm, and units of both covariances."""
    found, truth = result.camera_right_T_arm, reference.camera_right_T_arm
    if found is None:
        return measured
    # R_true = exp(dphi) R_found and t_true = t_found + dt: the perturbation that the covariance describes.
    dphi = matrix_to_rotvec(truth.R @ rigid_inverse(found.matrix)[..., :3, :3])
    dt = truth.t - found.t
    error = np.concatenate([dphi.numpy(), dt.numpy()])
    both = [C for C in (result.covariance, reference.covariance) if C is not None]
    own_C, other_C = result.covariance, np.zeros((6, 6)) if reference.covariance is None else reference.covariance
    return replace(
        measured,
        rotation_error_deg=math.degrees(float(dphi.norm())),
        translation_error_mm=float(dt.norm()),
        error_sigmas=mahalanobis(error, np.sum(both, axis=0)) if own_C is not None else None,
        result_sigma_deg=result.rotation_sigma_deg,
        result_sigma_mm=result.translation_sigma_mm,
        reference_sigma_deg=math.degrees(math.sqrt(np.trace(other_C[:3, :3]))),
        reference_sigma_mm=math.sqrt(np.trace(other_C[3:, 3:])),
    )


def mahalanobis(error: np.ndarray, covariance: np.ndarray) -> float:
    """sqrt(e^T C^-1 e) of a (6,) error, rotation first, rad and mm.

    Scaled to unit variances: radians and millimetres, and directions that are hardly known, differ by 1e12.
    """
    scale = np.sqrt(np.diag(covariance))
    unit = error / scale
    return math.sqrt(unit @ np.linalg.pinv(covariance / np.outer(scale, scale), hermitian=True) @ unit)
