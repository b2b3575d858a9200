"""Noise levels from the data: variance components by restricted maximum likelihood, Fisher scoring.

The covariance of one motion's residuals is linear in the components, S = sum_j v_j Q_j: image points on lines, ends,
heads (Q diagonal), position and orientation of the kinematics (Q = W W^T and A A^T of residuals.py). With a = S^-1 r
and the projection that the estimated parameters cost, the restricted likelihood has (Patterson & Thompson 1971; Searle,
Casella & McCulloch 1992, ch. 8)

    score_j = 1/2 [ sum a^T Q_j a - sum tr(S^-1 Q_j) + tr(H^-1 sum J^T S^-1 Q_j S^-1 J) ],
    F_ij = 1/2 sum tr(S^-1 Q_i S^-1 Q_j).

Steps are taken in log v_j, with a Gaussian prior about the assumed level: components that the data cannot separate
(one camera, few motions) stay near it.
"""

import math
from dataclasses import replace

import torch
from jaxtyping import Bool, Float
from torch import Tensor

from rmis_calib.solver.model.batched_linalg import rescaled, unit_diagonal
from rmis_calib.solver.model.jacobian import columns
from rmis_calib.solver.model.linearised_rows import LinearisedRows
from rmis_calib.solver.model.measurement_rows import END, HEAD, LINE, MeasurementRows
from rmis_calib.solver.model.motion_covariance import NoiseModel, covariance, image_variance
from rmis_calib.solver.model.normal_equations import accumulate
from rmis_calib.solver.model.parameters import ParameterLayout
from rmis_calib.solver.model.residuals import linearise
from rmis_calib.solver.model.state import State
from rmis_calib.solver.model.weighted_model import WeightedModel
from rmis_calib.solver.problem import Problem
from rmis_calib.solver.settings import NoiseSettings

COMPONENTS = ("line", "end", "head", "kinematics_mm", "kinematics_rad")
MAX_LOG_STEP = 1.5
SCORING_STEPS = 5
SETTLED = 0.02
"""Scoring ends when no level moves by more than this part."""


def assumed_noise(problem: Problem, settings: NoiseSettings) -> tuple[NoiseModel, dict[str, Tensor]]:
    """Noise levels given by the problem, else those of the settings; and per component (b,) whether it is to be
    estimated."""
    given = problem.noise
    one = torch.ones_like(given.image)
    free_image = (
        torch.isnan(given.image) if settings.estimate == "auto" else one.bool() & (settings.estimate == "always")
    )
    free: dict[str, Tensor] = {name: free_image for name in ("line", "end", "head")}
    levels = {}
    for name, assumed in (
        ("kinematics_mm", settings.kinematics_mm),
        ("kinematics_rad", math.radians(settings.kinematics_deg)),
    ):
        value = getattr(given, name)
        free[name] = (
            torch.isnan(value)
            if settings.estimate == "auto"
            else free_image & True
            if settings.estimate == "never"
            else one.bool()
        )
        levels[name] = torch.nan_to_num(value, nan=assumed).square()
    model = NoiseModel(
        one, one, one, **levels, camera_mm=given.camera_mm.square(), camera_rad=given.camera_rad.square()
    )
    return model, free


def estimate_components(
    model: WeightedModel, state: State, assumed: NoiseModel, free: dict[str, Tensor], settings: NoiseSettings
) -> NoiseModel:
    """Components after a few scoring steps at this state. Motions and cameras of weight below 1/2 do not take part.

    Args:
        model: of as many motions as fit at once; a thousand fix every component to a few per cent. Its noise levels are
            where the steps set out from.
    """
    measured, layout, noise = model.measured, model.layout, model.noise
    if not any(bool(value.any()) for value in free.values()):
        return noise
    if model.weight is not None:
        measured = measured.keep(model.weight > 0.5)
    linear, shaft = linearise(measured, state)
    J = columns(layout, linear, shaft, measured, state).permute(2, 3, 0, 1)  # (b, n, k, p)
    r = linear.r.permute(1, 2, 0)[..., None]
    parts = _component_matrices(measured, linear)
    free_mask = free_components(measured, free)
    centre, prior = log_prior(assumed, settings)
    active = free_mask.any(-1, keepdim=True)
    for _ in range(SCORING_STEPS):
        theta = log_levels(noise)
        score, fisher = _score(measured, linear, J, r, noise, parts, layout)
        v = theta.exp()
        score = v * score - prior * (theta - centre)
        fisher = v[:, :, None] * v[:, None] * fisher + prior * torch.eye(
            len(COMPONENTS), dtype=v.dtype, device=v.device
        )
        fixed = ~free_mask
        fisher = torch.where(fixed[:, :, None] | fixed[:, None], torch.diag_embed(torch.ones_like(v)), fisher)
        step = torch.linalg.solve(fisher, torch.where(fixed, 0.0, score)[..., None])[..., 0].clamp(
            -MAX_LOG_STEP, MAX_LOG_STEP
        )
        moved = torch.where(fixed | ~active, v, (theta + step).exp())
        noise = replace(noise, **{name: moved[:, i] for i, name in enumerate(COMPONENTS)})
        active = active & (torch.where(fixed, 0.0, step).abs() > SETTLED).any(-1, keepdim=True)
        if not bool(active.any()):
            break
    return noise


def free_components(measured: MeasurementRows, free: dict[str, Tensor]) -> Bool[Tensor, "b m"]:
    """Which components are estimated: those left open that act on any measured row."""
    return torch.stack([free[name] for name in COMPONENTS], dim=-1) & _present(measured)


def log_prior(assumed: NoiseModel, settings: NoiseSettings) -> tuple[Float[Tensor, "b m"], float]:
    """Centre of the prior of each component's logarithm, and its weight 1/sigma^2."""
    return log_levels(assumed), (2.0 * math.log(settings.prior_factor)) ** -2


def log_levels(noise: NoiseModel) -> Float[Tensor, "b m"]:
    """Logarithm of each component's variance."""
    return torch.stack([getattr(noise, name) for name in COMPONENTS], dim=-1).clamp_min(1e-30).log()


def restricted_likelihood(model: WeightedModel, state: State) -> Float[Tensor, " b"]:
    """Log of the restricted likelihood of the noise levels, up to a constant."""
    normal = accumulate(model, state)
    scaled, scale = unit_diagonal(normal.H)
    logdet_H = torch.linalg.slogdet(scaled).logabsdet - 2.0 * scale.log().sum(-1)
    return -0.5 * (normal.chi2 + normal.logdet + logdet_H)


def _present(measured: MeasurementRows) -> Tensor:
    """Which components act on any measured row, (5,)."""
    kinds = torch.tensor(measured.row_kind, device=measured.p.device)
    seen = measured.rows_ok.flatten(1).any(1)
    present = [bool((seen & (kinds == kind)).any()) for kind in (LINE, END, HEAD)]
    return torch.tensor([*present, True, True], device=measured.p.device)


def _component_matrices(measured: MeasurementRows, linear: LinearisedRows) -> tuple[list[Tensor], Tensor]:
    """Diagonals of the image components (b, n, k) each, and the two kinematic matrices (2, b, n, k, k)."""
    kinds = torch.tensor(measured.row_kind, device=linear.r.device)[:, None, None]
    nominal = torch.where(measured.rows_ok, measured.rows_var, 0.0)
    diagonals = [torch.where(kinds == kind, nominal, 0.0).permute(1, 2, 0) for kind in (LINE, END, HEAD)]
    vectors = torch.stack((linear.w, linear.a)).permute(0, 3, 4, 2, 1)  # (2, b, n, k, 3)
    return diagonals, vectors @ vectors.mT


def _score(
    measured: MeasurementRows,
    linear: LinearisedRows,
    J: Tensor,
    r: Tensor,
    noise: NoiseModel,
    parts: tuple[list[Tensor], Tensor],
    layout: ParameterLayout,
) -> tuple[Float[Tensor, "b m"], Float[Tensor, "b m m"]]:
    """Score with respect to each variance, and the Fisher information."""
    k, b, n = linear.r.shape
    S = torch.empty((k, k, b, n), dtype=r.dtype, device=r.device)
    covariance(linear.w, linear.a, image_variance(measured, noise), measured.cameras, noise, S)
    inverse = _inverse(S.permute(2, 3, 0, 1))
    a, B = inverse @ r, inverse @ J
    H = (J.mT @ B).sum(1) + torch.diag_embed(layout.sigma.square().reciprocal())
    H_inverse = _inverse(H)
    diagonals, kinematic = parts
    products, scores = [], []
    for Q in (*diagonals, *kinematic):
        diagonal = Q.ndim == 3
        QS = inverse * Q[..., None, :] if diagonal else inverse @ Q  # S^-1 Q
        Qa, QB = (Q[..., None] * a, Q[..., None] * B) if diagonal else (Q @ a, Q @ B)
        cost = (H_inverse * (B.mT @ QB).sum(1).mT).sum((-2, -1))
        scores.append(0.5 * ((a * Qa).sum((1, 2, 3)) - QS.diagonal(dim1=-2, dim2=-1).sum((1, 2)) + cost))
        products.append(QS)
    flat = torch.stack([p.flatten(1) for p in products], dim=1)
    flat_t = torch.stack([p.mT.flatten(1) for p in products], dim=1)
    return torch.stack(scores, dim=-1), 0.5 * flat @ flat_t.mT


def _inverse(matrix: Float[Tensor, "*batch m m"]) -> Float[Tensor, "*batch m m"]:
    """Inverse of positive definite matrices, scaled to a unit diagonal; zero for one that is singular to rounding.

    Such a motion, or such an unknown, then takes no part in the score. It happens where an estimate runs away along a
    direction that the data do not see.
    """
    unit, scale = unit_diagonal(matrix)
    inverse, failed = torch.linalg.inv_ex(unit)
    usable = (failed == 0) & torch.isfinite(inverse).flatten(-2).all(-1)
    return torch.where(usable[..., None, None], rescaled(inverse, scale), 0.0)
