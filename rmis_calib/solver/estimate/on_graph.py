"""The joint estimate as a differentiable function of the observations.

The estimate and the noise levels solve equations together: the score J^T S^-1 r plus the priors' is zero, and so is the
score of the restricted likelihood (noise_levels.py). Derivatives of their root follow without those of any step that
led there (model/implicit.py); the bias and the covariance are plain functions of it. Held are the choices: which
measurements are outliers, which basin was chosen, and what the draws of the bias simulation were.
"""

from dataclasses import dataclass, replace

import torch
from jaxtyping import Float
from torch import Tensor

from rmis_calib.solver.estimate.map_estimate import MapEstimate, debias, motion_order
from rmis_calib.solver.estimate.noise_levels import (
    COMPONENTS,
    assumed_noise,
    free_components,
    log_levels,
    log_prior,
    restricted_likelihood,
)
from rmis_calib.solver.estimate.noise_modes import SAMPLE_MOTIONS
from rmis_calib.solver.model.batched_linalg import rescaled, unit_diagonal
from rmis_calib.solver.model.implicit import newton_on_graph
from rmis_calib.solver.model.motion_covariance import NoiseModel
from rmis_calib.solver.model.normal_equations import accumulate
from rmis_calib.solver.model.packing import pack
from rmis_calib.solver.model.parameters import NuisancePriors, initial_state, make_layout
from rmis_calib.solver.model.state import State
from rmis_calib.solver.model.weighted_model import WeightedModel
from rmis_calib.solver.problem import Problem
from rmis_calib.solver.settings import SolverSettings

MAX_STEPS = 6
SETTLED_SIGMA = 1e-7
"""Newton steps to the common root end below this part of the standard error; they begin within a few per cent."""
TOO_FAR_SIGMA = 3.0
"""An estimate further than this from a root of its own equations has none: it stays where it is."""


@dataclass(frozen=True)
class EstimateOnGraph:
    """State and covariance of every parameter, and chi^2 with priors, attached to the graph of the observations."""

    state: State
    covariance: Float[Tensor, "b p p"]
    chi2: Float[Tensor, " b"]


def attach(problem: Problem, fit: MapEstimate, settings: SolverSettings) -> EstimateOnGraph:
    """The estimate `fit` of this problem, as a function of its tensors.

    Args:
        problem: what `fit` is the estimate of, with one trial axis, its tensors on the graph.
        fit: the estimate; made of tensors that autograd may use (not of inference mode).
        settings: those of `fit`.
    """
    measured = replace(pack(problem, settings.noise), exact=True).with_ends_of(fit.model.measured)
    assumed, free = assumed_noise(problem, settings.noise)
    nominal = NuisancePriors.of(problem)
    fresh = initial_state(nominal, fit.state.R, fit.state.t)
    layout = make_layout(nominal, measured, fresh, settings.unknowns, settings.noise)
    model = WeightedModel(measured, layout, assumed, fit.model.weight, chunk=settings.chunk)
    order = motion_order(measured, settings.seed)[:SAMPLE_MOTIONS]
    sample = model.take_motions(order) if measured.motions > SAMPLE_MOTIONS else model
    if sample.weight is not None:
        sample = replace(sample, measured=sample.measured.keep(sample.weight > 0.5), weight=None)
    estimated = free_components(sample.measured, free)
    centre, prior = log_prior(assumed, settings.noise)

    def noise_at(theta: Tensor) -> NoiseModel:
        given = torch.stack([getattr(assumed, name) for name in COMPONENTS], dim=-1)
        levels = torch.where(estimated, theta.exp(), given)
        return replace(assumed, **{name: levels[:, i] for i, name in enumerate(COMPONENTS)})

    def equations(state: State, theta: Tensor, step: Tensor) -> Tensor:
        """Score of the parameters, then of the logarithms of the noise levels, after a step from both."""
        at, theta = state.moved(layout.step(step[:, : layout.size])), theta + step[:, layout.size :]
        score = accumulate(replace(model, noise=noise_at(theta)), at).g
        if not bool(estimated.any()):
            return torch.cat((score, step[:, layout.size :]), dim=-1)
        likelihood = restricted_likelihood(replace(sample, noise=noise_at(theta)), at)
        (slope,) = torch.autograd.grad(likelihood.sum(), theta, create_graph=True)
        of_noise = torch.where(estimated, prior * (theta - centre) - slope, step[:, layout.size :])
        return torch.cat((score, of_noise), dim=-1)

    undone = layout.step(fit.bias)
    state, theta = fit.state.moved(undone), log_levels(fit.model.noise)
    sigma = torch.cat((_sigma(fit.covariance), torch.ones_like(theta)), dim=-1)
    step = torch.zeros_like(sigma)
    for _ in range(MAX_STEPS):
        at_state, at_theta = state, theta
        step = newton_on_graph(lambda d, s=at_state, v=at_theta: equations(s, v, d), sigma)
        small = (step.detach().abs() / sigma).amax(-1)
        if bool((small < SETTLED_SIGMA).all()):
            break
        taken = torch.where((small < TOO_FAR_SIGMA)[:, None], step.detach().nan_to_num(), 0.0)
        state, theta = state.moved(layout.step(taken[:, : layout.size])), theta + taken[:, layout.size :]
    step = torch.where(((step.detach().abs() / sigma).amax(-1) < TOO_FAR_SIGMA)[:, None], step, 0.0)
    state = state.moved(layout.step(step[:, : layout.size]))
    model = replace(model, noise=noise_at(theta + step[:, layout.size :]))
    normal = accumulate(model, state)
    information = normal.H
    if settings.bias_correction:
        state, information, _ = debias(model, state, normal, settings)
    return EstimateOnGraph(state, _inverse(information, fit.covariance), normal.chi2)


def _sigma(covariance: Float[Tensor, "b p p"]) -> Float[Tensor, "b p"]:
    return covariance.diagonal(dim1=-2, dim2=-1).clamp_min(1e-300).sqrt()


def _inverse(information: Float[Tensor, "b p p"], fallback: Float[Tensor, "b p p"]) -> Float[Tensor, "b p p"]:
    """Covariance; the fallback, which has no derivative, where the information is singular."""
    scaled, scale = unit_diagonal(information)
    inverse, failed = torch.linalg.inv_ex(scaled)
    usable = (failed == 0) & torch.isfinite(inverse.detach()).flatten(1).all(-1)
    return torch.where(usable[:, None, None], rescaled(inverse, scale), fallback)
