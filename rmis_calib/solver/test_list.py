"""Outcomes of all tests of a solve, corrected together for their number."""

from dataclasses import dataclass
from typing import NamedTuple

import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor

LEVEL = 0.005
"""Chance that any test of the list fails although the model is right."""
MEAN, TIME, TIME_STEP, HALVES = "mean", "time", "time step", "halves"
NEAR_IN_TIME, NEAR_IN_JOINTS = "neighbours in time", "neighbours in joint space"
PICTURE = ("u", "v", "r2")
"""What tests are over, beside single joints: coordinates of the picture, and the square about its centre."""
ANSWER, CLOCK = "answer", "clock"
"""Kinds that are no residuals: the transform, and the clock between pictures and joints, in parts of the data."""


class TestName(NamedTuple):
    """Which kind of residual is tested, and what over."""

    __test__ = False  # for pytest

    kind: str
    over: str


SHARES = {TestName(ANSWER, HALVES): 0.5, TestName(ANSWER, TIME_STEP): 0.05, TestName(CLOCK, TIME_STEP): 0.05}
"""Part of LEVEL that each comparison of answers has; the tests of residuals share the rest alike. Two halves fail from
4.49 sigmas of 6 unknowns, a change in time from 5.5 (8 blocks), a jump of the clock from 4.5 (32 blocks)."""


@dataclass(frozen=True)
class TestList:
    """Outcomes of `m` tests of `b` trials.

    Attributes:
        names: of the tests.
        statistic: standard normal where the model is right, with its sign; of answers the distance of two of them in
            their sigmas; NaN where the data do not allow the test.
        chance: probability of one at least as large with the right model; NaN likewise.
        at: number of the first motion after a step in time; -1 for other tests.
    """

    __test__ = False  # for pytest

    names: tuple[TestName, ...]
    statistic: Float[Tensor, "b m"]
    chance: Float[Tensor, "b m"]
    at: Int[Tensor, "b m"]

    def joined(self, other: "TestList") -> "TestList":
        """Both lists of the same trials as one."""
        parts = [torch.cat(pair, dim=-1) for pair in zip(self._tensors, other._tensors, strict=True)]
        return TestList(self.names + other.names, *parts)

    def among(self, names: tuple[TestName, ...]) -> "TestList":
        """The tests `names`, NaN where they are not in this list."""
        b, place = len(self.chance), {name: index for index, name in enumerate(self.names)}
        padded = [
            torch.cat((x, torch.full_like(x[:, :1], fill) if x.shape[1] else x.new_full((b, 1), fill)), dim=-1)
            for x, fill in zip(self._tensors, (torch.nan, torch.nan, -1), strict=True)
        ]
        index = torch.tensor([place.get(name, len(self.names)) for name in names], device=self.chance.device)
        return TestList(names, *(x[:, index] for x in padded))

    def put(self, trials: Int[Tensor, " k"], part: "TestList") -> "TestList":
        """This list with that of some trials replaced."""
        pairs = zip(self._tensors, part._tensors, strict=True)
        return TestList(self.names, *(x.index_copy(0, trials, y) for x, y in pairs))

    @property
    def _tensors(self) -> tuple[Tensor, Tensor, Tensor]:
        return self.statistic, self.chance, self.at

    @property
    def corrected(self) -> Float[Tensor, "b m"]:
        """Chance corrected for the number of tests: that any test of the list does as badly with the right model
        (Holm 1979; with weights, Genovese, Roeder & Wasserman 2006). NaN where there was no test."""
        tested = torch.isfinite(self.chance)
        fixed = torch.tensor([SHARES.get(name, 0.0) for name in self.names]).to(self.chance)
        alike = (1.0 - sum(SHARES.values())) / (tested & (fixed == 0)).sum(-1, keepdim=True).clamp_min(1)
        share = torch.where(tested, torch.where(fixed > 0, fixed, alike), 0.0)
        ratio = torch.where(tested, self.chance / share.clamp_min(1e-12), torch.inf)
        order = ratio.argsort(-1)
        ordered = share.gather(-1, order)
        left = ordered.flip(-1).cumsum(-1).flip(-1)  # the shares of this test and of those that do better
        adjusted = (ratio.gather(-1, order) * left).cummax(-1).values.clamp_max(1.0)
        return torch.where(tested, torch.zeros_like(adjusted).scatter(-1, order, adjusted), torch.nan)

    @property
    def failed(self) -> Bool[Tensor, "b m"]:
        """Which tests fail."""
        return self.corrected < LEVEL

    @property
    def against(self) -> Bool[Tensor, "b m"]:
        """Which tests that fail speak against the answer. Neighbours whose errors are alike do not by themselves:
        pictures that follow each other share what misleads the detector, and leaving out groups of neighbours
        (groups.py) measures what that does to the answer."""
        of_neighbours = torch.tensor(
            [name.over in (NEAR_IN_TIME, NEAR_IN_JOINTS) for name in self.names], dtype=torch.bool
        )
        return self.failed & ~of_neighbours.to(self.chance.device)

    def fails(self, kind: str, over: str) -> Bool[Tensor, " b"]:
        """Whether one test fails; False where it is not in the list."""
        place = {name: index for index, name in enumerate(self.names)}.get(TestName(kind, over))
        failed = self.failed
        return failed[:, place] if place is not None else torch.zeros_like(failed[:, :1]).any(-1)
