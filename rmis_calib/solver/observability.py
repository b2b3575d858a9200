"""What the data can see of the transform, as numbers for every trial and in words for one.

Directions are ranked by what they do where the instrument works: a transform error (dphi, dt) moves a point w of
`camera_right` by dphi x (w - t) + dt. So the covariance is carried to (lever * dphi, displacement of the working point)
before its principal directions are taken, and "not observable" means a predicted error above a threshold in mm, not a
singular matrix.
"""

from enum import IntFlag

import torch
from jaxtyping import Float, Int
from torch import Tensor

from rmis_calib.geometry.rotations import skew
from rmis_calib.solver.problem import Problem
from rmis_calib.solver.settings import NoiseSettings, VerdictSettings
from rmis_calib.solver.solution import Observability, Sight, Verdict

VERDICTS = (Verdict.TRUSTWORTHY, Verdict.WEAK, Verdict.UNOBSERVABLE)
NEAR_AXIS_COS = 0.8
"""Cosine from which a direction is called by the name of an axis (37 degrees)."""
NOISE_MARGIN = 3.0
"""A spread below this many sigma of the kinematics' noise counts as no motion."""


class Degeneracy(IntFlag):
    """Classical degenerate cases; `sentences` puts them into words."""

    NONE = 0
    STATIC_LAPAROSCOPE = 1
    NO_DEPTH_CUE = 2
    SINGLE_AXIS_MOTION = 4
    ONE_PLANE = 8
    MOTION_BELOW_NOISE = 16
    SHORT_BASELINE = 32
    NO_ALONG_AXIS_CUE = 64


_SENTENCES = {
    Degeneracy.STATIC_LAPAROSCOPE: "the laparoscope did not move",
    Degeneracy.NO_DEPTH_CUE: "no shaft radius is known",
    Degeneracy.SINGLE_AXIS_MOTION: "the shaft turned about a single axis only",
    Degeneracy.ONE_PLANE: "all positions of the shaft lie in one plane",
    Degeneracy.MOTION_BELOW_NOISE: "the motion is below the noise of the kinematics",
    Degeneracy.SHORT_BASELINE: "the stereo baseline is too short to tell depth",
    Degeneracy.NO_ALONG_AXIS_CUE: "nothing tells the place along the shaft",
}


_REMEDIES = {
    Degeneracy.STATIC_LAPAROSCOPE: "move the laparoscope's arm as well, with its joints logged",
    Degeneracy.NO_DEPTH_CUE: "give the shaft's diameter, so that its width in the picture tells its distance",
    Degeneracy.SINGLE_AXIS_MOTION: "turn the instrument about a second axis",
    Degeneracy.ONE_PLANE: "move the instrument out of the plane that it stayed in",
    Degeneracy.MOTION_BELOW_NOISE: "move farther: several degrees and centimetres",
    Degeneracy.SHORT_BASELINE: "use the shaft's diameter for the distance, as with one camera",
    Degeneracy.NO_ALONG_AXIS_CUE: "keep the end of the dark shaft in view, or label head points",
}


def remedies(sight: Sight, trial: int) -> tuple[str, ...]:
    """What would end each degenerate case that was recognised in one trial, in words."""
    return tuple(_REMEDIES[flag] for flag in Degeneracy if flag and int(sight.degeneracy[trial]) & flag)


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


def carried(t: Float[Tensor, "*b 3"], point: Float[Tensor, "*b 3"], lever: float) -> Float[Tensor, "*b 6 6"]:
    """Matrix from (dphi, dt) to (lever * dphi, displacement of the point)."""
    eye = torch.eye(3, dtype=t.dtype, device=t.device).expand(*t.shape[:-1], 3, 3)
    top = torch.cat((lever * eye, torch.zeros_like(eye)), dim=-1)
    return torch.cat((top, torch.cat((-skew(point - t), eye), dim=-1)), dim=-2)


def look(
    problem: Problem,
    R: Tensor,
    t: Tensor,
    covariance: Float[Tensor, "b 6 6"],
    settings: VerdictSettings,
    degeneracy: Tensor,
) -> Sight:
    """Predicted errors, verdict and principal directions of every trial."""
    point = working_point(problem, R, t, settings)
    A = carried(t, point, settings.lever_mm)
    C = torch.nan_to_num(A @ covariance @ A.mT, nan=1e12, posinf=1e12, neginf=1e12)
    values, vectors = torch.linalg.eigh(C)
    at_point = C[:, 3:, 3:].diagonal(dim1=-2, dim2=-1).sum(-1).clamp_min(0.0).sqrt()
    rotation = torch.rad2deg(C[:, :3, :3].diagonal(dim1=-2, dim2=-1).sum(-1).clamp_min(0.0).sqrt() / settings.lever_mm)
    weak = (at_point > settings.trustworthy_mm) | (rotation > settings.trustworthy_deg)
    blind = (at_point > settings.unobservable_mm) | (rotation > settings.unobservable_deg)
    v = (R @ (problem.arm_T_rcm[..., :3, :3] @ problem.rcm_v_axis[..., None])[..., 0].mean(-2)[..., None])[..., 0]
    return Sight(
        working_point_mm=point,
        working_point_sigma_mm=at_point,
        rotation_sigma_deg=rotation,
        sigma_mm=values.flip(-1).clamp_min(0.0).sqrt(),
        directions=vectors.flip(-1).mT,
        verdict=weak.long() + blind.long() * (1 - weak.long()) + (weak & blind).long(),
        degeneracy=degeneracy,
        shaft_direction=v / torch.linalg.vector_norm(v, dim=-1, keepdim=True).clamp_min(1e-12),
    )


def recognise(
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


def describe(sight: Sight, trial: int) -> Observability:
    """One trial in words."""
    sigma = [float(s) for s in sight.sigma_mm[trial]]
    names = [_direction_name(d, sight.shaft_direction[trial]) for d in sight.directions[trial]]
    verdict = VERDICTS[int(sight.verdict[trial])]
    flags = [flag for flag in Degeneracy if flag and int(sight.degeneracy[trial]) & flag]
    reasons = [_SENTENCES[flag] for flag in flags]
    at_point, rotation = float(sight.working_point_sigma_mm[trial]), float(sight.rotation_sigma_deg[trial])
    x, y, z = (float(value) for value in sight.working_point_mm[trial])
    if verdict is Verdict.TRUSTWORTHY:
        sentence = f"predicted error {at_point:.2f} mm at the working point, {rotation:.2f} deg"
    else:
        word = "is not observable" if verdict is Verdict.UNOBSERVABLE else "is only weakly observable"
        size = f"{min(at_point, 9999.0):.1f} mm at the working point, {min(rotation, 180.0):.1f} deg"
        sentence = f"{names[0]} {word} (predicted error {size})"
        sentence += f": {_joined(reasons)}" if reasons else ""
    return Observability(
        verdict=verdict,
        working_point_mm=(x, y, z),
        working_point_sigma_mm=at_point,
        rotation_sigma_deg=rotation,
        directions=tuple(zip(sigma, names, strict=True)),
        degeneracies=tuple(flag.name or "" for flag in flags),
        sentence=sentence,
    )


def _joined(parts: list[str]) -> str:
    return parts[0] if len(parts) == 1 else ", ".join(parts[:-1]) + " and " + parts[-1]


def _direction_name(direction: Float[Tensor, "6"], shaft: Float[Tensor, "3"]) -> str:
    """A principal direction in plain words."""
    turn, shift = direction[:3], direction[3:]
    rotating = float(turn.norm()) > float(shift.norm())
    axis = (turn if rotating else shift) / max(float((turn if rotating else shift).norm()), 1e-12)
    eye = torch.eye(3, dtype=axis.dtype, device=axis.device)
    named = {
        "the viewing direction": eye[2],
        "the shaft": shaft,
        "the picture's horizontal": eye[0],
        "the picture's vertical": eye[1],
    }
    cosines = {name: abs(float(axis @ other)) for name, other in named.items()}
    best = max(cosines, key=lambda name: cosines[name])
    if cosines[best] < NEAR_AXIS_COS:
        x, y, z = (float(value) for value in axis)
        best = f"the direction ({x:+.2f}, {y:+.2f}, {z:+.2f})"
    return f"{'rotation about' if rotating else 'translation along'} {best}"
