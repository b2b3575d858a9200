"""Measurements, the parameters that explain them and the noise that weights them, cut to some trials and motions."""

from collections.abc import Iterator
from dataclasses import dataclass, replace

import torch
from jaxtyping import Float
from torch import Tensor

from rmis_calib.solver.model.measurement_rows import MeasurementRows
from rmis_calib.solver.model.motion_covariance import NoiseModel
from rmis_calib.solver.model.parameters import ParameterLayout
from rmis_calib.solver.tensors import chunks


@dataclass(frozen=True)
class WeightedModel:
    """All that turns a state into normal equations: measurements of `b` trials, the parameters that explain them, and
    the noise that weights them.

    Attributes:
        measured: the measurements.
        layout: parameters and their priors.
        noise: variances.
        weight: in (0, 1], of each camera's measurements of a motion; None: all 1.
        chunk: motions (times trials) that are in work at once: bounds memory.
    """

    measured: MeasurementRows
    layout: ParameterLayout
    noise: NoiseModel
    weight: Float[Tensor, "c b n"] | None = None
    chunk: int = 4096

    def narrow(self, trials: slice, motions: slice) -> "WeightedModel":
        """The part of these trials and motions."""
        weight = None if self.weight is None else self.weight[:, trials, motions]
        measured = self.measured.narrow(trials, motions)
        return replace(
            self, measured=measured, layout=self.layout.take(trials), noise=self.noise.take(trials), weight=weight
        )

    def take_motions(self, index: Tensor) -> "WeightedModel":
        """The part of the motions `index`, the same for every trial."""
        weight = None if self.weight is None else self.weight[..., index]
        return replace(self, measured=self.measured.take_motions(index), weight=weight)

    def sample(self, most: int) -> tuple["WeightedModel", int]:
        """Every k-th motion, `most` of them or fewer, and k."""
        motions = self.measured.motions
        step = max(1, -(-motions // most))
        return (
            self if step == 1 else self.take_motions(torch.arange(0, motions, step, device=self.measured.p.device))
        ), step

    def take_trials(self, index: Tensor) -> "WeightedModel":
        """The trials `index`, in this order, repeated where it repeats them."""
        weight = None if self.weight is None else self.weight.index_select(1, index)
        measured = self.measured.take_trials(index)
        return replace(
            self, measured=measured, layout=self.layout.take(index), noise=self.noise.take(index), weight=weight
        )

    def parts(self) -> Iterator[tuple[slice, list[slice]]]:
        """Slices of trials, each with the slices of motions, that hold `chunk` motions or fewer."""
        return chunks(self.measured.trials, self.measured.motions, self.chunk)
