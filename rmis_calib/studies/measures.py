"""How far an estimate is from the truth, and the Cramer-Rao bound of how near it can come."""

from dataclasses import dataclass, replace

import torch
from jaxtyping import Float
from torch import Tensor

from rmis_calib.geometry.rotations import matrix_to_rotvec
from rmis_calib.solver import Problem, SolverSettings
from rmis_calib.solver.estimate.noise_levels import assumed_noise
from rmis_calib.solver.model.normal_equations import accumulate
from rmis_calib.solver.model.packing import pack
from rmis_calib.solver.model.parameters import NuisancePriors, initial_state, make_layout
from rmis_calib.solver.model.weighted_model import WeightedModel

_DRAWS = 20_000


def transform_errors(
    estimate: Float[Tensor, "*batch 4 4"], truth: Float[Tensor, "*#batch 4 4"]
) -> Float[Tensor, "*batch 6"]:
    """(dphi, dt) of R = exp(dphi) R_true and t = t_true + dt, rad and mm."""
    turn = matrix_to_rotvec(estimate[..., :3, :3] @ truth[..., :3, :3].mT)
    return torch.cat((turn, estimate[..., :3, 3] - truth[..., :3, 3]), dim=-1)


def rotation_deg(errors: Float[Tensor, "*batch 6"]) -> Float[Tensor, "*batch"]:
    """Angle of the rotation error: the paper's theta_omega."""
    return torch.rad2deg(torch.linalg.vector_norm(errors[..., :3], dim=-1))


def translation_mm(errors: Float[Tensor, "*batch 6"]) -> Float[Tensor, "*batch"]:
    """Length of the translation error: the paper's theta_t."""
    return torch.linalg.vector_norm(errors[..., 3:], dim=-1)


def working_point_mm(
    estimate: Float[Tensor, "*batch 4 4"], truth: Float[Tensor, "*#batch 4 4"], camera_p: Float[Tensor, " 3"]
) -> Float[Tensor, "*batch"]:
    """How far the estimate moves the point of the arm that is at `camera_p` in the right camera."""
    arm_p = (truth[..., :3, :3].mT @ (camera_p - truth[..., :3, 3])[..., None])[..., 0]
    moved = (estimate[..., :3, :3] @ arm_p[..., None])[..., 0] + estimate[..., :3, 3]
    return torch.linalg.vector_norm(moved - camera_p, dim=-1)


def cramer_rao_bound(
    exact: Problem, truth: Float[Tensor, "b 4 4"], end_offset_mm: float, settings: SolverSettings
) -> Float[Tensor, "b 6 6"]:
    """Least covariance of (dphi, dt) that an unbiased estimate can have: the inverse of the information at the truth,
    with the unknowns beside the transform and their priors.

    Args:
        exact: the measurements with the true poses and stereo extrinsics; its noise levels are those of the data.
        truth: `camera_right_T_arm`.
        end_offset_mm: true offset of the shaft's end along the axis.
        settings: which unknowns there are.
    """
    measured = pack(exact, settings.noise)
    state = initial_state(NuisancePriors.of(exact), truth[:, :3, :3], truth[:, :3, 3])
    state = replace(state, end_offset=torch.full_like(truth[:, 0, 0], end_offset_mm))
    layout = make_layout(NuisancePriors.of(exact), measured, state, settings.unknowns, settings.noise)
    noise, _ = assumed_noise(exact, settings.noise)
    information = accumulate(WeightedModel(measured, layout, noise, chunk=settings.chunk), state).H
    return torch.linalg.inv(information)[:, :6, :6]


@dataclass(frozen=True)
class Bound:
    """A bound in the measures of an error: its rms, and the median of an error that is normal with that covariance."""

    rotation_rms_deg: float
    translation_rms_mm: float
    working_point_rms_mm: float
    rotation_median_deg: float
    translation_median_mm: float
    working_point_median_mm: float


def bound_in_measures(
    covariance: Float[Tensor, "6 6"], truth: Float[Tensor, "4 4"], camera_p: Float[Tensor, " 3"]
) -> Bound:
    """Rms and median of |dphi|, |dt| and the displacement of a point, dt + dphi x (p - t)."""
    lever = camera_p - truth[:3, 3]
    zero = lever.new_zeros(())
    x, y, z = lever.unbind()
    skew = torch.stack([torch.stack(r) for r in ((zero, -z, y), (z, zero, -x), (-y, x, zero))])
    A = torch.cat((-skew, torch.eye(3, dtype=lever.dtype)), dim=1)
    parts = (covariance[:3, :3] * torch.rad2deg(torch.ones_like(zero)) ** 2, covariance[3:, 3:], A @ covariance @ A.mT)
    rms = [float(part.trace().sqrt()) for part in parts]
    return Bound(*rms, *(_median_length(part) for part in parts))


def _median_length(covariance: Float[Tensor, "3 3"]) -> float:
    """Median length of a normal vector, from draws that are the same in every call."""
    generator = torch.Generator().manual_seed(0)
    squares = torch.randn(_DRAWS, 3, generator=generator, dtype=covariance.dtype).square()
    return float((squares @ torch.linalg.eigvalsh(covariance).clamp_min(0.0)).sqrt().median())
