"""Noise levels and outliers settle together, and may settle in more than one way.

"The joints are noisy and the pictures exact" and "the pictures are noisy and the joints exact" can both be maxima of
the restricted likelihood, and outliers that one of them rejects are noise to the other. Where the levels settle far
from what robots and cameras have, the rivals are tried too, and the one of the greatest posterior is taken.
"""

from dataclasses import replace

import torch
from jaxtyping import Bool, Float
from torch import Tensor

from rmis_calib.solver.estimate.gauss_newton import gauss_newton
from rmis_calib.solver.estimate.multistart import any_free
from rmis_calib.solver.estimate.noise_levels import (
    estimate_components,
    free_components,
    log_levels,
    log_prior,
    restricted_likelihood,
)
from rmis_calib.solver.estimate.outliers import anneal, classify_contaminated
from rmis_calib.solver.model.normal_equations import NoiseModel, WeightedModel
from rmis_calib.solver.model.state import State
from rmis_calib.solver.settings import SolverSettings

SAMPLE_MOTIONS = 512
"""Motions on which outliers are annealed and noise levels estimated; all motions are classified afterwards."""
NOISE_ROUNDS = 2
RIVALS = (0.1, 3.0)
"""Kinematic noise, times the assumed one, that rivals set out from."""
CLEARLY = 2.0
"""Gain in the log posterior from which a rival is another mode, and not the same one settled a little differently."""
USUAL = 1.0
"""Distance of a level from the assumed one, in sigmas of its prior, up to which no rival is tried."""


def settle_noise(
    model: WeightedModel,
    state: State,
    order: Tensor,
    contaminated: Bool[Tensor, " b"],
    assumed: NoiseModel,
    free: dict[str, Tensor],
    settings: SolverSettings,
    compete: bool = True,
) -> tuple[State, NoiseModel]:
    """State and noise levels, estimated on a sample without its outliers.

    Args:
        model: its noise levels are where the first estimate sets out from.
        state: to set out from.
        order: motions in the order in which they are drawn.
        contaminated: trials with outliers.
        assumed: levels that are given, and about which the others have their priors.
        free: which components are estimated.
        compete: whether rivals are tried; not where the levels to set out from won before.
    """
    sample = model.take_motions(order[:SAMPLE_MOTIONS]) if model.measured.motions > SAMPLE_MOTIONS else model
    if not any_free(free):
        return _anneal(sample, state, contaminated, settings), sample.noise
    settled, noise = _settle(sample, state, contaminated, assumed, free, settings)
    at = torch.nonzero(_unusual(sample, noise, assumed, free, settings))[:, 0]
    if not compete or not len(at):
        return settled, noise
    part, start, mixed = sample.take_trials(at), state.take(at), contaminated[at]
    own, own_free = assumed.take(at), {name: value[at] for name, value in free.items()}
    best_state, best_noise = settled.take(at), noise.take(at)
    best = _log_posterior(replace(part, noise=best_noise), best_state, mixed, own, own_free, settings)
    for factor in RIVALS:
        levels = _with_kinematics(part.noise, own, own_free, factor)
        rival_state, rival = _settle(replace(part, noise=levels), start, mixed, own, own_free, settings)
        value = _log_posterior(replace(part, noise=rival), rival_state, mixed, own, own_free, settings)
        better = torch.nonzero(value > best + CLEARLY)[:, 0]
        best_state = best_state.put(better, rival_state.take(better))
        best_noise = best_noise.put(better, rival.take(better))
        best = torch.where(value > best + CLEARLY, value, best)
    return settled.put(at, best_state), noise.put(at, best_noise)


def _settle(
    sample: WeightedModel,
    state: State,
    contaminated: Bool[Tensor, " b"],
    assumed: NoiseModel,
    free: dict[str, Tensor],
    settings: SolverSettings,
) -> tuple[State, NoiseModel]:
    """Outliers annealed away at the model's levels, then levels and state in turn."""
    state = _anneal(sample, state, contaminated, settings)
    for _ in range(NOISE_ROUNDS):
        weight = classify_contaminated(sample, state, contaminated, settings.outlier_probability)
        sample = replace(sample, weight=weight)
        sample = replace(sample, noise=estimate_components(sample, state, assumed, free, settings.noise))
        state = gauss_newton(sample, state, 0.1, 4).state
    return state, sample.noise


def _anneal(sample: WeightedModel, state: State, contaminated: Bool[Tensor, " b"], settings: SolverSettings) -> State:
    at = torch.nonzero(contaminated)[:, 0]
    if not len(at):
        return state
    return state.put(at, anneal(sample.take_trials(at), state.take(at), settings.outlier_probability)[0])


def _unusual(
    sample: WeightedModel, noise: NoiseModel, assumed: NoiseModel, free: dict[str, Tensor], settings: SolverSettings
) -> Bool[Tensor, " b"]:
    """Trials of which some estimated level is far from the assumed one."""
    centre, weight = log_prior(assumed, settings.noise)
    away = (log_levels(noise) - centre).abs() * weight**0.5
    return (free_components(sample.measured, free) & (away > USUAL)).any(-1)


def _with_kinematics(noise: NoiseModel, assumed: NoiseModel, free: dict[str, Tensor], factor: float) -> NoiseModel:
    """The levels with the kinematic ones, where they are free, `factor` times the assumed ones."""
    changed = {
        name: torch.where(free[name], factor**2 * getattr(assumed, name), getattr(noise, name))
        for name in ("kinematics_mm", "kinematics_rad")
    }
    return replace(noise, **changed)


def _log_posterior(
    model: WeightedModel,
    state: State,
    contaminated: Bool[Tensor, " b"],
    assumed: NoiseModel,
    free: dict[str, Tensor],
    settings: SolverSettings,
) -> Float[Tensor, " b"]:
    """Of the levels. A rejected measurement counts as one of a distribution a thousand times as wide (its weight), so
    that modes that reject more do not win by that."""
    weight = classify_contaminated(model, state, contaminated, settings.outlier_probability)
    likelihood = restricted_likelihood(replace(model, weight=weight), state)
    centre, prior = log_prior(assumed, settings.noise)
    away = torch.where(free_components(model.measured, free), log_levels(model.noise) - centre, 0.0)
    return likelihood - 0.5 * prior * away.square().sum(-1)
