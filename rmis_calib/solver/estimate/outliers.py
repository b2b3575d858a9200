"""Outliers: graduated non-convexity on truncated least squares, one weight for each camera's measurements of a motion.

A detector fails for one picture at a time: a wrong line, the other instrument, edges swapped. So the unit that is kept
or dropped is (motion, camera), by its Mahalanobis distance d^2, which includes the noise of the kinematics; frozen
joints show in both cameras. With the rejection threshold c^2 (a quantile of chi^2), the weights of Yang, Antonante,
Tzoumas & Carlone (RA-L 2020) anneal from convex (mu small) to a hard decision:

    w = 1 for d^2 <= mu/(mu+1) c^2,   0 for d^2 >= (mu+1)/mu c^2,   c sqrt(mu (mu+1)) / d - mu between.

A weight enters as covariance / w, so a dropped camera costs nothing and distorts nothing. What remains is 0 or 1:
efficiency and covariance are those of the good measurements.
"""

from dataclasses import replace
from functools import lru_cache

import numpy as np
import torch
from jaxtyping import Bool, Float
from scipy.special import chdtri
from torch import Tensor

from rmis_calib.solver.estimate.gauss_newton import solve_system
from rmis_calib.solver.model.motion_covariance import camera_distance2
from rmis_calib.solver.model.normal_equations import normal_equations, with_prior
from rmis_calib.solver.model.state import State
from rmis_calib.solver.model.weighted_model import WeightedModel
from rmis_calib.solver.tensors import spans

MIN_WEIGHT = 1e-6
REJECTED = 0.5
"""Weights are MIN_WEIGHT or 1 in the end; below this is rejected."""
ANNEALING_STEPS = 24
FINAL_STEPS = 3
"""Hard reclassifications after annealing, each followed by a step."""


@lru_cache(maxsize=32)
def _quantiles(most_rows: int, probability: float) -> Tensor:
    return torch.as_tensor(chdtri(np.maximum(np.arange(most_rows + 1), 1), probability))


def chi2_quantile(rows: Float[Tensor, "..."], probability: float) -> Float[Tensor, "..."]:
    """Value that chi^2 with as many degrees of freedom as rows exceeds with this probability; that of one row for
    none."""
    table = _quantiles(int(rows.max()) if rows.numel() else 1, probability).to(rows)
    return table[rows.long()]


def truncated_cost(
    distance2: Float[Tensor, "c b n"], rows: Float[Tensor, "c b n"], probability: float
) -> Float[Tensor, " b"]:
    """Sum of min(d^2, c^2) over cameras and motions: what competing starts are judged by."""
    limit = chi2_quantile(rows, probability)
    return torch.where(rows > 0, torch.minimum(torch.nan_to_num(distance2, nan=torch.inf), limit), 0.0).sum((0, 2))


def inlier_weight(distance2: Tensor, rows: Tensor, probability: float) -> Float[Tensor, "c b n"]:
    """1 where the distance is below the quantile, else MIN_WEIGHT."""
    return torch.where(distance2 <= chi2_quantile(rows, probability), 1.0, MIN_WEIGHT).to(distance2.dtype)


def anneal(
    model: WeightedModel, state: State, probability: float, steps: int = ANNEALING_STEPS
) -> tuple[State, Float[Tensor, "c b n"]]:
    """State and weights after graduated non-convexity from this state; one Gauss-Newton step at each level."""
    measured, layout, noise = model.measured, model.layout, model.noise
    distance2, rows = camera_distance2(measured, state, noise)
    limit = chi2_quantile(rows, probability)
    ratio = torch.where(rows > 0, distance2 / limit, 0.0).amax((0, 2))
    mu = 1.0 / (2.0 * ratio - 1.0).clamp_min(1e-3)
    # Reach a hard decision (mu = 100) from any start within the steps.
    factor = (100.0 / mu).clamp_min(1.0).pow(1.0 / steps).clamp_min(1.0)
    for level in range(steps + FINAL_STEPS):
        if level < steps:
            m = mu[:, None]
            soft = (limit * m * (m + 1.0) / distance2.clamp_min(1e-300)).sqrt() - m
            weight = torch.where(
                distance2 <= m / (m + 1.0) * limit,
                1.0,
                torch.where(distance2 >= (m + 1.0) / m * limit, MIN_WEIGHT, soft.clamp(MIN_WEIGHT, 1.0)),
            )
            mu = mu * factor
        else:
            weight = inlier_weight(distance2, rows, probability)
        normal = with_prior(normal_equations(replace(model, weight=weight), state), layout, state)
        delta, _ = solve_system(normal.H, normal.g)
        state = state.moved(layout.step(delta))
        distance2, rows = camera_distance2(measured, state, noise)
    return state, inlier_weight(distance2, rows, probability)


def classify(
    model: WeightedModel, state: State, probability: float, distance2: Float[Tensor, "b n"] | None = None
) -> Float[Tensor, "c b n"]:
    """`inlier_weight` of any number of motions, a chunk at a time. Weights that the model has do not count.

    Args:
        distance2: of each motion as a whole, where it is known: a camera's own distance is never larger, so only
            motions above the least threshold are looked at.
    """
    measured, noise = model.measured, model.noise
    if distance2 is not None:
        rows = measured.rows_seen
        limit = chi2_quantile(rows.to(distance2.dtype), probability)
        limit = torch.where(rows > 0, limit, torch.inf).amin(0)
        trial, motion = torch.nonzero(~(distance2 <= limit) & (rows.sum(0) > 0), as_tuple=True)
        weight = torch.ones_like(rows, dtype=distance2.dtype)
        for part in spans(len(trial), model.chunk):
            b, n = trial[part], motion[part]
            each = inlier_weight(*camera_distance2(measured.gather(b, n), state.take(b), noise.take(b)), probability)
            weight[:, b, n] = each[:, :, 0]
        return weight
    weights = []
    for trials, along in model.parts():
        at, own = state.take(trials), noise.take(trials)
        parts = [
            inlier_weight(*camera_distance2(measured.narrow(trials, motions), at, own), probability)
            for motions in along
        ]
        weights.append(torch.cat(parts, dim=2))
    return torch.cat(weights, dim=1)


def classify_contaminated(
    model: WeightedModel, state: State, contaminated: Bool[Tensor, " b"], probability: float
) -> Float[Tensor, "c b n"] | None:
    """Weights of the contaminated trials; 1 in the others, and None where there are no contaminated ones."""
    if not bool(contaminated.any()):
        return None
    return torch.where(contaminated[:, None], classify(model, state, probability), 1.0)
