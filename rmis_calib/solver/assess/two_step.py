"""Estimates of `paper` and `global`, which use the axis lines alone, made into solutions."""

from dataclasses import replace

import torch
from jaxtyping import Float
from torch import Tensor

from rmis_calib.geometry.rigid import rigid_from_rotation_translation
from rmis_calib.solver.assess.assemble import MAX_CHI2_PER_DOF, MIN_CHEIRALITY
from rmis_calib.solver.assess.observability import observability_of
from rmis_calib.solver.assess.residuals_by_motion import residuals_by_motion
from rmis_calib.solver.estimate.multistart import cheirality
from rmis_calib.solver.estimate.noise_levels import assumed_noise
from rmis_calib.solver.model.measurement_rows import MeasurementRows
from rmis_calib.solver.model.motion_covariance import NoiseModel, motion_distance2
from rmis_calib.solver.model.packing import pack
from rmis_calib.solver.model.parameters import TRANSLATION_SIGMA_MM, NuisancePriors, initial_state
from rmis_calib.solver.model.state import State
from rmis_calib.solver.observability import Degeneracy, Verdict
from rmis_calib.solver.problem import Problem
from rmis_calib.solver.settings import Method, SolverSettings
from rmis_calib.solver.solution import Solution
from rmis_calib.solver.start.candidates import COLLAPSED_MM, collapsed
from rmis_calib.solver.status import MotionReason, SolveStatus

CHECKED_MOTIONS = 256
"""Motions that are enough for a first estimate, and to tell a fit in the wrong basin."""


def two_step_solution(
    flat: Problem, R: Tensor, t: Tensor, covariance: Tensor, settings: SolverSettings, method: Method
) -> Solution:
    """Solution of `paper` and `global`, which use the axis lines alone."""
    axis_only = flat.only("axis")
    covariance = covariance + _unseen_depth(flat, R, t)
    measured = pack(axis_only, settings.noise)
    noise, _ = assumed_noise(flat, settings.noise)
    state = initial_state(NuisancePriors.of(axis_only), R, t)
    front = cheirality(measured, state, torch.ones_like(measured.line_ok[0]))
    status = torch.where(front < MIN_CHEIRALITY, SolveStatus.BEHIND_CAMERA, SolveStatus.CONVERGED)
    status = torch.where(
        torch.isfinite(covariance).all(-1).all(-1) & torch.isfinite(t).all(-1), status, SolveStatus.NON_FINITE
    )
    seen = measured.line_ok.any(0).any(0)
    excess = _chi2_per_dof(measured, state, noise)
    status = torch.where((excess > MAX_CHI2_PER_DOF) & (status == SolveStatus.CONVERGED), SolveStatus.MISFIT, status)
    observability = observability_of(axis_only, R, t, covariance, noise, (False, False, False), settings)
    static = (observability.degeneracy & Degeneracy.STATIC_LAPAROSCOPE) > 0
    # A two-step estimate from a laparoscope that stands still is biased by more than its scatter shows.
    observability = replace(
        observability,
        verdict=torch.where(static, observability.verdict.clamp_min(Verdict.WEAK.code), observability.verdict),
    )
    shown = residuals_by_motion(measured, state)
    return Solution(
        method=method,
        camera_right_T_arm=rigid_from_rotation_translation(R, t),
        camera_left_T_camera_right=flat.camera_T_camera_right[:, 1] if flat.n_cameras == 2 else None,
        covariance=covariance,
        status=status,
        cheirality=front,
        iterations=torch.zeros_like(status),
        chi2_per_dof=excess,
        distance=torch.full_like(seen, torch.nan, dtype=t.dtype),
        reason=torch.where(seen, MotionReason.USED, MotionReason.NOT_MEASURED),
        noise={},
        nuisances={},
        bias=torch.zeros_like(covariance[..., 0]),
        observability=observability,
        residual_lines=shown.lines,
        residual_ends=shown.ends,
        residual_heads=shown.heads,
        residual_own=shown.own,
    )


def _chi2_per_dof(measured: MeasurementRows, state: State, noise: NoiseModel) -> Float[Tensor, " b"]:
    """Weighted squared residuals over degrees of freedom, on a few hundred motions: a fit in the wrong basin shows
    here where the cheirality does not."""
    part = measured.narrow(slice(None), slice(None, None, max(1, measured.motions // CHECKED_MOTIONS)))
    return motion_distance2(part, state, noise).sum(-1) / (part.rows_ok.sum((0, 2)) - 6.0).clamp_min(1.0)


def _unseen_depth(flat: Problem, R: Tensor, t: Tensor) -> Float[Tensor, "b 6 6"]:
    """Variance along the ray of the RCM where the lines of one camera do not tell its distance; zero elsewhere."""
    p = flat.arm_T_rcm[..., :3, 3] @ R.mT + t[:, None]
    centred = p - p.mean(-2, keepdim=True)
    nearly_static = centred.norm(dim=-1).mean(-1) < COLLAPSED_MM
    unseen = collapsed(p) | (nearly_static if flat.n_cameras == 1 else torch.zeros_like(nearly_static))
    ray = torch.nn.functional.normalize(p.mean(-2), dim=-1)
    block = TRANSLATION_SIGMA_MM**2 * ray[:, :, None] * ray[:, None]
    return torch.nn.functional.pad(torch.where(unseen[:, None, None], block, 0.0), (3, 0, 3, 0))
