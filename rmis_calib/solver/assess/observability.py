"""What the data can see of the transform: predicted errors, their directions, and the classical degenerate cases.

Directions are ranked by what they do where the instrument works: a transform error (dphi, dt) moves a point w of
`camera_right` by dphi x (w - t) + dt. So the covariance is carried to (lever * dphi, displacement of the working point)
before its principal directions are taken, and "not observable" means a predicted error above a threshold in mm, not a
singular matrix.
"""

from dataclasses import replace

import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor

from rmis_calib.geometry.rotations import matrix_to_rotvec, skew
from rmis_calib.solver.model.motion_covariance import NoiseModel
from rmis_calib.solver.observability import Degeneracy, ObservabilityTensors, Verdict
from rmis_calib.solver.problem import Problem
from rmis_calib.solver.settings import NoiseSettings, SolverSettings, VerdictSettings

LEAST_TURN_RAD = 5e-3
"""Spread of the laparoscope's turns about a second axis below which it turned about one only."""
NOISE_MARGIN = 3.0
"""A spread below this many sigma of the kinematics' noise counts as no motion."""
SHOWN_MOTIONS = 4096
"""Motions from which the degenerate cases are recognised, and on which the scatter of the two-step methods is
measured; longer recordings are sampled evenly."""


def working_point(problem: Problem, R: Tensor, t: Tensor, settings: VerdictSettings) -> Float[Tensor, "b 3"]:
    """The given point; else the mean nominal shaft end or head point seen from the camera; else 100 mm along the
    shaft."""
    if settings.working_point_mm is not None:
        return torch.as_tensor(settings.working_point_mm, dtype=t.dtype, device=t.device).expand_as(t)
    rcm_p = problem.rcm_p_head
    along = torch.where(torch.isfinite(problem.rcm_s_end_mm), problem.rcm_s_end_mm, 100.0)
    rcm_p = torch.where(torch.isfinite(rcm_p).all(-1, keepdim=True), rcm_p, along[..., None] * problem.rcm_v_axis)
    arm_p = (problem.arm_T_rcm[..., :3, :3] @ rcm_p[..., None])[..., 0] + problem.arm_T_rcm[..., :3, 3]
    return (R @ arm_p.mean(-2)[..., None])[..., 0] + t


def working_point_jacobian(
    t: Float[Tensor, "*b 3"], point: Float[Tensor, "*b 3"], lever: float
) -> Float[Tensor, "*b 6 6"]:
    """Matrix from (dphi, dt) to (lever * dphi, displacement of the point)."""
    eye = torch.eye(3, dtype=t.dtype, device=t.device).expand(*t.shape[:-1], 3, 3)
    top = torch.cat((lever * eye, torch.zeros_like(eye)), dim=-1)
    return torch.cat((top, torch.cat((-skew(point - t), eye), dim=-1)), dim=-2)


def assess(
    problem: Problem,
    R: Tensor,
    t: Tensor,
    covariance: Float[Tensor, "b 6 6"],
    settings: VerdictSettings,
    degeneracy: Tensor,
) -> ObservabilityTensors:
    """Predicted errors, verdict and principal directions of every trial."""
    point = working_point(problem, R, t, settings)
    A = working_point_jacobian(t, point, settings.lever_mm)
    C = torch.nan_to_num(A @ covariance @ A.mT, nan=1e12, posinf=1e12, neginf=1e12)
    values, vectors = torch.linalg.eigh(C)
    at_point = C[:, 3:, 3:].diagonal(dim1=-2, dim2=-1).sum(-1).clamp_min(0.0).sqrt()
    rotation = torch.rad2deg(C[:, :3, :3].diagonal(dim1=-2, dim2=-1).sum(-1).clamp_min(0.0).sqrt() / settings.lever_mm)
    weak = (at_point > settings.trustworthy_mm) | (rotation > settings.trustworthy_deg)
    blind = (at_point > settings.unobservable_mm) | (rotation > settings.unobservable_deg)
    v = (R @ (problem.arm_T_rcm[..., :3, :3] @ problem.rcm_v_axis[..., None])[..., 0].mean(-2)[..., None])[..., 0]
    return ObservabilityTensors(
        working_point_mm=point,
        working_point_sigma_mm=at_point,
        rotation_sigma_deg=rotation,
        sigma_mm=values.flip(-1).clamp_min(0.0).sqrt(),
        directions=vectors.flip(-1).mT,
        verdict=torch.where(
            blind, Verdict.UNOBSERVABLE.code, torch.where(weak, Verdict.WEAK.code, Verdict.TRUSTWORTHY.code)
        ),
        degeneracy=degeneracy,
        shaft_direction=v / torch.linalg.vector_norm(v, dim=-1, keepdim=True).clamp_min(1e-12),
    )


def detect_degeneracies(
    problem: Problem,
    noise_mm: Tensor,
    noise_rad: Tensor,
    uses: tuple[bool, bool, bool],
    settings: NoiseSettings,
    distance_mm: Tensor,
) -> Int[Tensor, " b"]:
    """Which classical degenerate cases the motions show.

    Args:
        uses: whether contours, ends and heads were measured and used.
        distance_mm: of the working point from the camera.
    """
    contours, ends, heads = uses
    p = problem.arm_T_rcm[..., :3, 3]
    v = (problem.arm_T_rcm[..., :3, :3] @ problem.rcm_v_axis[..., None])[..., 0]
    p_spread, v_spread = _spread(p), _spread(v)
    floor_p = NOISE_MARGIN * noise_mm + 1e-3
    floor_v = NOISE_MARGIN * noise_rad + 1e-6
    static = p_spread[:, -1] < floor_p
    still = static & (v_spread[:, -1] < floor_v)
    second_moment = torch.linalg.eigvalsh(v.mT @ v / v.shape[-2]).clamp_min(0.0).sqrt()
    one_axis = static & ~still & ((v_spread[:, -2] < floor_v) | _cone(v, floor_v))
    plane = ~still & (second_moment[:, 0] < floor_v) & (p_spread[:, 0] < floor_p)
    flags = torch.zeros_like(static, dtype=torch.int64)
    flags = flags + Degeneracy.STATIC_LAPAROSCOPE * static + Degeneracy.MOTION_BELOW_NOISE * still
    flags = flags + Degeneracy.SINGLE_AXIS_MOTION * one_axis + Degeneracy.ONE_PLANE * plane
    if problem.n_cameras == 2:
        offset = problem.camera_T_camera_right[:, 1, :3, 3]
        image = torch.nan_to_num(problem.noise.image, nan=settings.image)
        angle = torch.nan_to_num(problem.noise.stereo_rad, nan=settings.stereo_deg * torch.pi / 180.0) + 1.4 * image
        flags = flags + Degeneracy.SHORT_BASELINE * (
            torch.linalg.vector_norm(offset, dim=-1) < 3.0 * angle * distance_mm
        )
    if not (contours or heads):
        flags = flags + int(Degeneracy.NO_DEPTH_CUE)
    if not (ends or heads):
        flags = flags + int(Degeneracy.NO_ALONG_AXIS_CUE)
    return flags


def turns_about_one_axis(laparoscope_base_T_arm: Float[Tensor, "b n 4 4"]) -> Bool[Tensor, " b"]:
    """Whether the laparoscope turned about a single axis at most: the transform and the set-up can then change together
    without a trace (Tsai & Lenz 1989, of the same equation AX = XB)."""
    R = laparoscope_base_T_arm[..., :3, :3]
    turned = matrix_to_rotvec(R[:, :1].mT @ R)
    return _spread(turned)[:, -2] < LEAST_TURN_RAD


def _spread(x: Float[Tensor, "b n 3"]) -> Float[Tensor, "b 3"]:
    """Standard deviations along the principal axes, ascending."""
    centred = x - x.mean(-2, keepdim=True)
    return torch.linalg.eigvalsh(centred.mT @ centred / x.shape[-2]).clamp_min(0.0).sqrt()


def _cone(v: Float[Tensor, "b n 3"], floor: Tensor) -> Tensor:
    """Whether all directions make one angle with one axis: the smallest principal spread of the directions is noise,
    and so is the width of the ring."""
    centred = v - v.mean(-2, keepdim=True)
    _, axes = torch.linalg.eigh(centred.mT @ centred)
    flat = torch.cat((centred @ axes[..., 1:], torch.ones_like(v[..., :1])), dim=-1)
    squares = (flat[..., :2] ** 2).sum(-1, keepdim=True)
    fit = torch.linalg.pinv(flat) @ squares
    radius = (0.25 * (fit[..., :2, 0] ** 2).sum(-1) + fit[..., 2, 0]).clamp_min(1e-12).sqrt()
    residual = ((squares - flat @ fit)[..., 0].square().mean(-1)).sqrt() / (2.0 * radius)
    tall = (centred @ axes[..., :1]).square().mean((-2, -1)).sqrt()
    return (residual < floor) & (tall < floor) & (radius < 1.0)


def observability_of(
    problem: Problem,
    R: Tensor,
    t: Tensor,
    C: Tensor,
    noise: NoiseModel,
    uses: tuple[bool, bool, bool],
    settings: SolverSettings,
) -> ObservabilityTensors:
    """What the data can see by an estimate, with the degenerate cases among its motions.

    Args:
        uses: whether contours, ends and heads were measured and used.
    """
    if problem.n_motions > SHOWN_MOTIONS:
        problem = problem.select_motions(slice(None, None, problem.n_motions // SHOWN_MOTIONS))
    first = assess(problem, R, t, C, settings.verdict, torch.zeros_like(t[:, 0], dtype=torch.int64))
    distance = torch.linalg.vector_norm(first.working_point_mm, dim=-1)
    flags = detect_degeneracies(
        problem, noise.kinematics_mm.sqrt(), noise.kinematics_rad.sqrt(), uses, settings.noise, distance
    )
    if settings.unknowns.setup != "known" and problem.laparoscope_base_T_arm is not None:
        flags = flags + Degeneracy.SETUP_AND_TRANSFORM * turns_about_one_axis(problem.laparoscope_base_T_arm)
    return replace(first, degeneracy=flags)
