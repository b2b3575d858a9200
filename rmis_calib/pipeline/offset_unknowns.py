"""Joint offsets and the clock as unknowns: what the solver asks of them, wherever their effect is known from."""

from abc import ABC, abstractmethod
from dataclasses import replace

import numpy as np
import torch
from jaxtyping import Bool, Float
from torch import Tensor

from rmis_calib.io.observations import CLOCK
from rmis_calib.robot import split_joint_column
from rmis_calib.solver import Problem, Solution
from rmis_calib.solver.settings import UnknownSettings

_MOVES = {"rad": 1e-4, "mm": 1e-6}
"""Displacement (rad and mm) per unit up to which a joint does not move the shaft. Those of the wrist do not, and so
have no offset that could be seen."""


class OffsetUnknowns(ABC):
    """Both arms as a function of constant joint offsets and a clock offset, for one list of M motions.

    A joint offset is added to the readings of its joint (rad or mm), the clock offset to the times at which the joints
    are read (s). The displacement of the shaft, [rotation vector, translation] in `rcm`, is that of
    `Problem.joint_derivative`.

    Attributes:
        columns: `<arm>.<joint>_rad` or `_mm` of each joint offset, laparoscope first.
        has_clock: whether a clock offset means anything.
        clock_at_s: the clock offset to start from; None: it must be searched for.
    """

    columns: tuple[str, ...]
    has_clock: bool
    clock_at_s: float | None

    @abstractmethod
    def at(self, base: Problem, joint_offset: Float[Tensor, "b j"], clock_s: Float[Tensor, " b"]) -> Problem:
        """The measurements of `base` with the shaft where `b` sets of offsets put it; `base` has one trial."""

    @abstractmethod
    def joint_derivative(
        self, joint_offset: Float[Tensor, "b j"], clock_s: Float[Tensor, " b"]
    ) -> Float[Tensor, "b m 6 j"]:
        """Displacement of the shaft per unit of each joint, at `b` sets of offsets."""

    @abstractmethod
    def clock_derivative(
        self, joint_derivative: Float[Tensor, "b m 6 j"], clock_s: Float[Tensor, " b"]
    ) -> Float[Tensor, "b m 6"]:
        """Displacement of the shaft per second of clock offset, where `joint_derivative` is that of the joints."""

    def linearised(
        self,
        base: Problem,
        joint_offset: Float[Tensor, "b j"],
        clock_s: Float[Tensor, " b"],
        sigma: Float[Tensor, " j"],
    ) -> Problem:
        """`at` with the derivatives that make the offsets unknowns; `sigma` is the prior of each joint's."""
        derivative = self.joint_derivative(joint_offset, clock_s)
        return replace(
            self.at(base, joint_offset, clock_s),
            joint_derivative=derivative,
            joint_offset_sigma=sigma.expand(len(clock_s), -1),
            clock_derivative=self.clock_derivative(derivative, clock_s) if self.has_clock else None,
        )

    def moves_shaft(self) -> Bool[Tensor, " j"]:
        """Which joints move the shaft as the camera sees it, at the nominal offsets."""
        nominal = torch.zeros(1, len(self.columns), dtype=torch.float64)
        derivative = self.joint_derivative(nominal, torch.zeros(1, dtype=torch.float64))
        least = derivative.new_tensor([_MOVES[split_joint_column(column)[1]] for column in self.columns])
        return derivative.abs().amax(dim=(0, 1, 2)) > least

    def prior_sigma(self, settings: UnknownSettings) -> Float[Tensor, " j"]:
        """Prior of each offset, rad or mm; zero for a joint that does not move the shaft."""
        sigma = {"rad": np.deg2rad(settings.joint_offset_sigma_deg), "mm": settings.joint_offset_sigma_mm}
        values = [sigma[split_joint_column(column)[1]] for column in self.columns]
        moves = self.moves_shaft()
        return torch.where(moves, torch.tensor(values, dtype=torch.float64, device=moves.device), 0.0)

    def displacements(self, joint_offset: Float[Tensor, " j"], clock_s: float) -> dict[str, np.ndarray]:
        """What an observations file says about the offsets, at one set of them: the `unknown_*` arrays."""
        clock = torch.tensor([clock_s], dtype=torch.float64)
        derivative = self.joint_derivative(joint_offset[None], clock)
        names, at = list(self.columns), [*joint_offset.tolist()]
        if self.has_clock:
            derivative = torch.cat((derivative, self.clock_derivative(derivative, clock)[..., None]), dim=-1)
            names, at = [*names, CLOCK], [*at, clock_s]
        displacement = derivative[0].mT.cpu().numpy()
        return {"unknown_names": np.array(names), "unknown_displacement": displacement, "unknown_at": np.array(at)}


def estimated_offsets(solution: Solution, columns: tuple[str, ...], like: Tensor) -> tuple[Float[Tensor, " j"], float]:
    """Joint offsets (rad or mm) and clock offset (s) of a solution; zero where they were not estimated."""
    found = {name: nuisance.value.reshape(-1) for name, nuisance in solution.nuisances.items()}
    joint_offset = found.get("joint_offset", like.new_zeros(len(columns)))
    return joint_offset, float(found["clock"]) if "clock" in found else 0.0
