"""Unknowns that were left out of an estimate: their information and score, the estimate's own unknowns eliminated.

All candidates share one pass over the motions: the normal equations of the estimate with every one of them freed, of
which each candidate takes its rows.
"""

from dataclasses import dataclass, replace

import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor

from rmis_calib.solver.estimate.map_estimate import MapEstimate
from rmis_calib.solver.model.normal_equations import accumulate
from rmis_calib.solver.model.parameters import NuisancePriors, ParameterLayout, make_layout
from rmis_calib.solver.model.state import State
from rmis_calib.solver.model.weighted_model import WeightedModel
from rmis_calib.solver.problem import stands_still
from rmis_calib.solver.settings import SolverSettings, UnknownSettings

TESTED_MOTIONS = 2048
"""Long recordings are tested on a sample: what needs more motions to show is below the sigmas that matter."""


@dataclass(frozen=True)
class Freed:
    """An unknown freed in one step: its block of the normal equations, the other unknowns eliminated.

    Attributes:
        A: information of the data.
        u: score.
        effect: of the block on the transform, and on the set-up where it is estimated.
    """

    A: Float[Tensor, "b q q"]
    u: Float[Tensor, "b q"]
    effect: Float[Tensor, "b m q"]


@dataclass(frozen=True)
class Candidates:
    """Unknowns that were left out of an estimate, at their nominal values.

    Attributes:
        model: of the estimate; a sample of the motions where they are many.
        state: the estimate.
        nominal: values and priors of what may be left out.
        settings: of the estimate.
        layout: of the estimate's unknowns and all candidates.
        H, g: their normal equations, priors included.
        own: places of the estimate's unknowns among them.
        still: whether the laparoscope stands still.
    """

    model: WeightedModel
    state: State
    nominal: NuisancePriors
    settings: SolverSettings
    layout: ParameterLayout
    H: Float[Tensor, "b p p"]
    g: Float[Tensor, "b p"]
    own: list[int]
    still: Bool[Tensor, " b"]

    @classmethod
    def of(cls, fit: MapEstimate, settings: SolverSettings, names: list[str]) -> "Candidates":
        """The candidates of these names."""
        nominal, model, asked = NuisancePriors.of(fit.problem), fit.model, settings.unknowns
        for name in names:
            asked = freed(asked, name)
        layout = make_layout(nominal, model.measured, model.layout.origin, asked, settings.noise)
        model, _ = model.sample(TESTED_MOTIONS)
        normal = accumulate(replace(model, layout=layout), fit.state)
        H, g = torch.nan_to_num(normal.H), torch.nan_to_num(normal.g)
        left_out = {place for name in names for place in places(layout, name)}
        own = [place for place in range(layout.size) if place not in left_out]
        laparoscope = fit.problem.laparoscope_base_T_arm
        still = torch.ones_like(g[:, 0], dtype=torch.bool) if laparoscope is None else stands_still(laparoscope)
        return cls(model, fit.state, nominal, settings, layout, H, g, own, still)

    def sigma(self, name: str) -> Float[Tensor, "b q"]:
        """Prior of a candidate."""
        return self.layout.sigma[:, self.layout.blocks[name]]

    def score(self, name: str) -> Float[Tensor, "b r"]:
        """Of the estimate's unknowns and this candidate, in the order of `with_freed`."""
        return self.g[:, sorted(self.own + places(self.layout, name))]

    def block(self, name: str, g: Float[Tensor, "b r"] | None = None, at: Int[Tensor, " k"] | None = None) -> Freed:
        """A candidate without its prior, in units of it.

        Args:
            name: of the candidate.
            g: takes the place of `score`, in the trials `at`.
            at: trials; None: all.
        """
        part = places(self.layout, name)
        index = sorted(self.own + part)
        inside, others = ([index.index(place) for place in which] for which in (part, self.own))
        H, g = self.H[:, index][:, :, index], self.score(name) if g is None else g
        H, sigma = (x if at is None else x[at] for x in (H, self.sigma(name)))
        return eliminated(H, g, sigma, inside, others, reported(self.model.layout))

    def with_freed(self, name: str, at: Int[Tensor, " k"]) -> tuple[WeightedModel, State]:
        """The model of some trials with this candidate among the unknowns, and where it is nominal."""
        unknowns, like = freed(self.settings.unknowns, name), self.model.layout.origin
        layout = make_layout(self.nominal, self.model.measured, like, unknowns, self.settings.noise)
        return replace(self.model, layout=layout).take_trials(at), self.state.take(at)


def freed(unknowns: UnknownSettings, name: str) -> UnknownSettings:
    """The settings with a candidate estimated."""
    return replace(unknowns, **{name: "prior" if name == "setup" else "always"})


def places(layout: ParameterLayout, name: str) -> list[int]:
    """Of a block among the parameters; empty where there is none."""
    return [*range(layout.size)[layout.blocks.get(name, slice(0))]]


def reported(layout: ParameterLayout) -> list[int]:
    """Places of the transform, and of the set-up where it is estimated, among the parameters."""
    return [*range(6), *places(layout, "setup")]


def eliminated(
    H: Float[Tensor, "b p p"],
    g: Float[Tensor, "b p"],
    sigma: Float[Tensor, "b q"],
    inside: list[int],
    others: list[int],
    rows: list[int],
) -> Freed:
    """The block `inside` in units of `sigma`, its prior, which is in H and at zero; without that prior. Effects are on
    the parameters `rows` of the others."""
    own = H[:, others][:, :, others]
    size = own.diagonal(dim1=-2, dim2=-1).clamp_min(1e-300).rsqrt()
    eye = torch.eye(H.shape[-1], dtype=H.dtype, device=H.device)
    cross = H[:, others][:, :, inside] * sigma[:, None] * size[..., None]
    right = torch.cat((cross, (g[:, others] * size)[..., None]), dim=-1)
    unit = own * size[:, :, None] * size[:, None] + 1e-12 * eye[others][:, others]
    solved = torch.linalg.solve_ex(unit, right).result
    A = H[:, inside][:, :, inside] * sigma[:, :, None] * sigma[:, None] - cross.mT @ solved[..., :-1]
    u = g[:, inside] * sigma - (cross.mT @ solved[..., -1:])[..., 0]
    A = torch.nan_to_num(0.5 * (A + A.mT)) - eye[inside][:, inside]
    return Freed(A, torch.nan_to_num(u), torch.nan_to_num(-(size[..., None] * solved)[:, rows, :-1]))
