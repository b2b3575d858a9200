"""Noise levels and outliers settle together, and may settle in more than one way.

"The joints are noisy and the pictures exact" and "the pictures are noisy and the joints exact" can both be maxima of
the restricted likelihood, and outliers that one of them rejects are noise to the other. Where the levels settle far
from what robots and cameras have, the rivals are tried too, and the one of the greatest posterior is taken.
"""

from dataclasses import dataclass, replace

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
from rmis_calib.solver.model.motion_covariance import NoiseModel
from rmis_calib.solver.model.state import State
from rmis_calib.solver.model.weighted_model import WeightedModel
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
    search = _Search(sample, contaminated, assumed, free, settings)
    if not any_free(free):
        return search.annealed(state), sample.noise
    settled, noise = search.settled(state)
    at = torch.nonzero(search.unusual(noise))[:, 0]
    if not compete or not len(at):
        return settled, noise
    best_state, best_noise = search.best_of_rivals(at, state.take(at), settled.take(at), noise.take(at))
    return settled.put(at, best_state), noise.put(at, best_noise)


def log_posterior(
    model: WeightedModel,
    state: State,
    contaminated: Bool[Tensor, " b"],
    assumed: NoiseModel,
    free: dict[str, Tensor],
    settings: SolverSettings,
) -> Float[Tensor, " b"]:
    """Log of the posterior of the model's noise levels, up to a constant; the other arguments as of `settle_noise`."""
    return _Search(model, contaminated, assumed, free, settings).log_posterior(state, model.noise)


@dataclass(frozen=True)
class _Search:
    """What the noise levels of some trials are found from: the arguments of `settle_noise`."""

    sample: WeightedModel
    contaminated: Bool[Tensor, " b"]
    assumed: NoiseModel
    free: dict[str, Tensor]
    settings: SolverSettings

    def take(self, at: Tensor) -> "_Search":
        """The search of the trials `at`."""
        free = {name: value[at] for name, value in self.free.items()}
        return _Search(self.sample.take_trials(at), self.contaminated[at], self.assumed.take(at), free, self.settings)

    def annealed(self, state: State) -> State:
        """The state with outliers annealed away in contaminated trials."""
        at = torch.nonzero(self.contaminated)[:, 0]
        if not len(at):
            return state
        probability = self.settings.outlier_probability
        return state.put(at, anneal(self.sample.take_trials(at), state.take(at), probability)[0])

    def settled(self, state: State, noise: NoiseModel | None = None) -> tuple[State, NoiseModel]:
        """Outliers annealed away at the levels to set out from (None: the sample's), then levels and state in turn."""
        search = self if noise is None else replace(self, sample=replace(self.sample, noise=noise))
        sample, state = search.sample, search.annealed(state)
        for _ in range(NOISE_ROUNDS):
            sample = replace(sample, weight=search.weight(sample, state))
            levels = estimate_components(sample, state, self.assumed, self.free, self.settings.noise)
            sample = replace(sample, noise=levels)
            state = gauss_newton(sample, state, 0.1, 4).state
        return state, sample.noise

    def best_of_rivals(self, at: Tensor, start: State, state: State, noise: NoiseModel) -> tuple[State, NoiseModel]:
        """State and levels of the greatest posterior of the trials `at`, among those given and where rivals settle."""
        search = self.take(at)
        best = search.log_posterior(state, noise)
        for factor in RIVALS:
            rival_state, rival = search.settled(start, search.kinematics_times(factor))
            value = search.log_posterior(rival_state, rival)
            better = torch.nonzero(value > best + CLEARLY)[:, 0]
            state = state.put(better, rival_state.take(better))
            noise = noise.put(better, rival.take(better))
            best = torch.where(value > best + CLEARLY, value, best)
        return state, noise

    def weight(self, model: WeightedModel, state: State) -> Float[Tensor, "c b n"] | None:
        """Of the measurements, nearly 0 for outliers."""
        return classify_contaminated(model, state, self.contaminated, self.settings.outlier_probability)

    def unusual(self, noise: NoiseModel) -> Bool[Tensor, " b"]:
        """Trials of which some estimated level is far from the assumed one."""
        centre, weight = log_prior(self.assumed, self.settings.noise)
        away = (log_levels(noise) - centre).abs() * weight**0.5
        return (free_components(self.sample.measured, self.free) & (away > USUAL)).any(-1)

    def kinematics_times(self, factor: float) -> NoiseModel:
        """The sample's levels with the kinematic ones, where they are free, `factor` times the assumed ones."""
        noise = self.sample.noise
        changed = {
            name: torch.where(self.free[name], factor**2 * getattr(self.assumed, name), getattr(noise, name))
            for name in ("kinematics_mm", "kinematics_rad")
        }
        return replace(noise, **changed)

    def log_posterior(self, state: State, noise: NoiseModel) -> Float[Tensor, " b"]:
        """Of the levels. A rejected measurement counts as one of a distribution a thousand times as wide (its weight),
        so that modes that reject more do not win by that."""
        model = replace(self.sample, noise=noise)
        likelihood = restricted_likelihood(replace(model, weight=self.weight(model, state)), state)
        centre, prior = log_prior(self.assumed, self.settings.noise)
        away = torch.where(free_components(model.measured, self.free), log_levels(noise) - centre, 0.0)
        return likelihood - 0.5 * prior * away.square().sum(-1)
