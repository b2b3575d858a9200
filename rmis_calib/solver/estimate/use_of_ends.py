"""What the shaft's ends are used for, by evidence: at the places where a first estimate has them, or another one; or
not at all.

An estimate that many wrong ends took along puts even the right ones at wrong places. So where ends are at more than
one place, or scatter far more than they should, rival estimates are made: one with the ends at the places where the
settled estimate has them, one from all other measurements alone, and one with the ends at the places where that has
them. The one under which all measurements together are most probable is kept; an end that is not used counts as one
that could be anywhere along RANGE_MM of the shaft. So ends are not kept where they spoil the fit of everything else by
more than they tell, and not left out because another answer leaves less of them to explain.
"""

import math
from collections.abc import Iterator
from dataclasses import dataclass, replace

import torch
from jaxtyping import Bool, Float
from torch import Tensor

from rmis_calib.solver.estimate.end_places import RANGE_MM, with_places
from rmis_calib.solver.estimate.gauss_newton import gauss_newton
from rmis_calib.solver.estimate.multistart import any_free
from rmis_calib.solver.estimate.noise_levels import COMPONENTS, free_components, log_levels, log_prior
from rmis_calib.solver.estimate.noise_modes import CLEARLY, SAMPLE_MOTIONS, USUAL, log_posterior, settle_noise
from rmis_calib.solver.estimate.outliers import classify_contaminated
from rmis_calib.solver.model.measurement_rows import END, MeasurementRows
from rmis_calib.solver.model.motion_covariance import NoiseModel
from rmis_calib.solver.model.parameters import NuisancePriors, initial_state, make_layout
from rmis_calib.solver.model.residuals import linearise
from rmis_calib.solver.model.state import State
from rmis_calib.solver.model.weighted_model import WeightedModel
from rmis_calib.solver.problem import Problem
from rmis_calib.solver.settings import SolverSettings

MAX_STEPS = 8
_LEVEL = COMPONENTS.index("end")
FEWEST_ROWS = 12
"""Other measurements from which an estimate without ends is tried: twice the unknowns."""


@dataclass(frozen=True)
class Settled:
    """A state with its noise levels, and the measurements of which it is the estimate."""

    measured: MeasurementRows
    state: State
    noise: NoiseModel

    def take(self, index: Tensor) -> "Settled":
        """Of the trials `index`."""
        return Settled(self.measured.take_trials(index), self.state.take(index), self.noise.take(index))

    def put(self, index: Tensor, part: "Settled") -> "Settled":
        """These with those of the trials `index` replaced."""
        measured = self.measured.put_ends(index, part.measured)
        return Settled(measured, self.state.put(index, part.state), self.noise.put(index, part.noise))


@dataclass(frozen=True)
class Settling:
    """What noise levels are settled with: see `settle_noise`; `every` are the measurements with all ends."""

    problem: Problem
    every: MeasurementRows
    order: Tensor
    contaminated: Bool[Tensor, " b"]
    assumed: NoiseModel
    free: dict[str, Tensor]
    settings: SolverSettings

    def take(self, index: Tensor) -> "Settling":
        """Of the trials `index`."""
        return replace(
            self,
            problem=self.problem.take_trials(index),
            every=self.every.take_trials(index),
            contaminated=self.contaminated[index],
            assumed=self.assumed.take(index),
            free={name: value[index] for name, value in self.free.items()},
        )

    def model(self, measured: MeasurementRows, noise: NoiseModel) -> WeightedModel:
        """Of these measurements."""
        nominal, rows = NuisancePriors.of(self.problem), measured.without_unused_ends()
        eye = torch.eye(3, dtype=rows.p.dtype, device=rows.p.device).expand(rows.trials, 3, 3)
        origin = initial_state(nominal, eye, torch.zeros_like(eye[..., 0]))
        layout = make_layout(nominal, rows, origin, self.settings.unknowns, self.settings.noise)
        return WeightedModel(rows, layout, noise, chunk=self.settings.chunk)

    def settled(self, measured: MeasurementRows, state: State, noise: NoiseModel, compete: bool = True) -> Settled:
        """The state and the levels that belong to these measurements."""
        model = self.model(measured, noise)
        found = settle_noise(
            model, state, self.order, self.contaminated, self.assumed, self.free, self.settings, compete
        )
        return Settled(measured, *found)

    def best_use_of_ends(self, start: Settled, first: Settled) -> Settled:
        """The estimate under which all measurements are most probable.

        Args:
            start: what was set out from, before noise levels settled.
            first: what came of it.
        """
        index = torch.nonzero(self.doubtful(first))[:, 0]
        if not len(index):
            return first
        of = self.take(index)
        best = of.refined(first.take(index))
        evidence = of.log_evidence(best)
        for rival in of.rivals(start.take(index), best):
            value = of.log_evidence(rival)
            better = value > evidence + CLEARLY
            at = torch.nonzero(better)[:, 0]
            best = best.put(at, rival.take(at))
            evidence = torch.where(better, value, evidence)
        return first.put(index, best)

    def refined(self, fit: Settled) -> Settled:
        """With the state where the sample's measurements are most probable; where levels are estimated it is there."""
        if any_free(self.free):
            return fit
        model, probability = self.model(fit.measured, fit.noise), self.settings.outlier_probability
        sample = model.take_motions(self.order[:SAMPLE_MOTIONS])
        sample = replace(sample, weight=classify_contaminated(sample, fit.state, self.contaminated, probability))
        return replace(fit, state=gauss_newton(sample, fit.state, 0.1, MAX_STEPS).state)

    def doubtful(self, first: Settled) -> Bool[Tensor, " b"]:
        """Trials in which not all ends are at one place, or which scatter more than is usual."""
        measured = first.measured
        if not self.every.has_ends:
            return torch.zeros_like(self.contaminated)
        mixed = ((self.every.end_ok & ~measured.end_ok) | (measured.end_second > 0)).any(-1).any(0)
        centre, weight = log_prior(self.assumed, self.settings.noise)
        above = ((log_levels(first.noise) - centre) * weight**0.5)[:, _LEVEL] > USUAL
        return mixed | (above & free_components(measured, self.free)[:, _LEVEL])

    def rivals(self, start: Settled, first: Settled) -> Iterator[Settled]:
        """Other uses of the ends, each settled."""
        assumed = self.assumed.end
        again = with_places(self.every, first.state, replace(first.noise, end=assumed))
        if not _same_ends(again, first.measured):
            yield self.refined(self.settled(again, first.state, first.noise))
        without = replace(self.every, end_ok=torch.zeros_like(self.every.end_ok))
        if not bool((without.rows_ok.sum((0, 2)) >= FEWEST_ROWS).all()):
            return
        alone = self.refined(self.settled(without, start.state, start.noise))
        yield alone
        there = with_places(self.every, alone.state, replace(alone.noise, end=assumed))
        if not _same_ends(there, first.measured):
            yield self.refined(self.settled(there, alone.state, replace(alone.noise, end=assumed)))

    def log_evidence(self, fit: Settled) -> Float[Tensor, " b"]:
        """Log of the probability of all measurements, of the ends' places and of the noise levels, up to a constant
        that is the same for every use of the ends; on the sample on which levels are settled."""
        index = self.order[:SAMPLE_MOTIONS]
        model = self.model(fit.measured, fit.noise).take_motions(index)
        value = log_posterior(model, fit.state, self.contaminated, self.assumed, self.free, self.settings)
        prior = torch.where(torch.isfinite(model.layout.sigma), model.layout.sigma.log(), 0.0).sum(-1)
        every, ends = self.every.take_motions(index), fit.measured.take_motions(index)
        linear, _ = linearise(every, fit.state)
        rows = [row for row, kind in enumerate(every.row_kind) if kind == END]
        anywhere = -math.log(RANGE_MM) - linear.end[rows].abs().clamp_min(1e-12).log()
        second = ends.end_ok & (ends.end_second > 0)
        groups = (every.end_ok & ~ends.end_ok, ends.end_ok & ~second, second)
        counts = torch.stack([group.sum((0, 2)) for group in groups]).to(value.dtype)
        shares = ((counts + 1.0) / (counts.sum(0) + len(groups))).log()
        unused = torch.where(groups[0], anywhere, 0.0).sum((0, 2))
        used = -0.5 * math.log(2.0 * math.pi) * (counts[1] + counts[2])  # what the likelihood of rows leaves out
        return value - prior + unused + used + (counts * shares).sum(0)


def _same_ends(these: MeasurementRows, others: MeasurementRows) -> bool:
    return torch.equal(these.end_ok, others.end_ok) and torch.equal(these.end_second, others.end_second)
