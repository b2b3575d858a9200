"""Joint offsets and the clock as unknowns: what the solver asks of them, and their effect as an observations file tells
it (kinematic_unknowns.py: as the kinematics do).

An observations file knows the effect to first order only: where the shaft is at one set of offsets, and how a unit of
each displaces it. Further away the displacement is taken as proportional: within half a degree and a millimetre a joint
that is wrong by micrometres.
"""

from abc import ABC, abstractmethod
from copy import copy
from dataclasses import replace

import numpy as np
import torch
from jaxtyping import Bool, Float
from torch import Tensor

from rmis_calib.errors import ObservationsError
from rmis_calib.geometry.rigid import rigid_exp
from rmis_calib.io import ShaftObservations
from rmis_calib.io.observations import CLOCK, CLOCK_RATE, CLOCKS
from rmis_calib.robot import split_joint_column
from rmis_calib.solver import Problem, Solution
from rmis_calib.solver.settings import SolverSettings, UnknownSettings

_MOVES = {"rad": 1e-4, "mm": 1e-6}
"""Displacement (rad and mm) per unit up to which a joint does not move the shaft. Those of the wrist do not, and so
have no offset that could be seen."""

NO_CLOCK = (0.0, 0.0)
"""Offset, s, and rate of a clock that is right."""


class OffsetUnknowns(ABC):
    """Both arms as a function of constant joint offsets and a clock offset, for one list of M motions.

    A joint offset is added to the readings of its joint (rad or mm). A `clock` is an offset (s) and a rate: what is
    added to the times at which the joints are read in the middle of the recording, and how much more a second later.
    The displacement of the shaft, [rotation vector, translation] in `rcm`, is that of
    `Problem.joint_derivative`.

    Attributes:
        columns: `<arm>.<joint>_rad` or `_mm` of each joint offset, laparoscope first.
        laparoscope_joints: how many of them are the laparoscope's.
        has_clock: whether a clock offset means anything.
        clock_at: the clock to start from; None: it must be searched for.
        stated_sigma: (J,) 1 sigma of each joint offset, rad or mm, where somebody states it; NaN elsewhere.
        motions: M.
        half_s: time from the middle of the recording to the motion that is furthest from it.
    """

    columns: tuple[str, ...]
    laparoscope_joints: int
    has_clock: bool
    clock_at: tuple[float, float] | None
    stated_sigma: Float[Tensor, " j"]
    motions: int
    half_s: float

    @abstractmethod
    def every(self, step: int) -> "OffsetUnknowns":
        """Of every so many-th motion alone."""

    @abstractmethod
    def at(self, base: Problem, joint_offset: Float[Tensor, "b j"], clock: Float[Tensor, "b 2"]) -> Problem:
        """The measurements of `base` with the shaft where `b` sets of offsets put it; `base` has one trial."""

    @abstractmethod
    def joint_derivative(
        self, joint_offset: Float[Tensor, "b j"], clock: Float[Tensor, "b 2"]
    ) -> Float[Tensor, "b m 6 j"]:
        """Displacement of the shaft per unit of each joint, at `b` sets of offsets."""

    @abstractmethod
    def clock_derivative(
        self, joint_derivative: Float[Tensor, "b m 6 j"], clock: Float[Tensor, "b 2"]
    ) -> Float[Tensor, "b m 6 2"]:
        """Displacement of the shaft per second of the clock's offset and per unit of its rate, where `joint_derivative`
        is that of the joints."""

    def linearised(
        self,
        base: Problem,
        joint_offset: Float[Tensor, "b j"],
        clock: Float[Tensor, "b 2"],
        sigma: Float[Tensor, " j"],
        setup: Float[Tensor, "b 4 4"] | None = None,
    ) -> Problem:
        """`at` with the derivatives that make the offsets unknowns; `sigma` is the prior of each joint's, `setup` the
        set-up to evaluate at (None: as stated)."""
        problem = replace(
            self.at(base, joint_offset, clock),
            joint_derivative=self.joint_derivative(joint_offset, clock),
            joint_offset_sigma=sigma.expand(len(clock), -1),
            laparoscope_joints=self.laparoscope_joints,
        )
        if setup is not None:
            problem = problem.at_setup(setup)
        if not self.has_clock or problem.joint_derivative is None:
            return problem
        return replace(problem, clock_derivative=self.clock_derivative(problem.joint_derivative, clock))

    def moves_shaft(self) -> Bool[Tensor, " j"]:
        """Which joints move the shaft as the camera sees it, at the nominal offsets."""
        nominal = torch.zeros(1, len(self.columns), dtype=torch.float64)
        derivative = self.joint_derivative(nominal, torch.zeros(1, 2, dtype=torch.float64))
        least = derivative.new_tensor([_MOVES[split_joint_column(column)[1]] for column in self.columns])
        return derivative.abs().amax(dim=(0, 1, 2)) > least

    def prior_sigma(self, settings: UnknownSettings) -> Float[Tensor, " j"]:
        """Prior of each offset, rad or mm: what is stated, else the settings'; zero for a joint that does not move the
        shaft."""
        sigma = {"rad": np.deg2rad(settings.joint_offset_sigma_deg), "mm": settings.joint_offset_sigma_mm}
        values = [sigma[split_joint_column(column)[1]] for column in self.columns]
        moves = self.moves_shaft()
        assumed = torch.tensor(values, dtype=torch.float64, device=moves.device)
        stated = self.stated_sigma.to(assumed)
        return torch.where(moves, torch.where(stated.isnan(), assumed, stated), 0.0)

    def displacements(
        self, joint_offset: Float[Tensor, " j"], clock: tuple[float, float] = NO_CLOCK
    ) -> dict[str, np.ndarray]:
        """What an observations file says about the offsets, at one set of them: the `unknown_*` arrays."""
        at_clock = torch.tensor([clock], dtype=torch.float64)
        derivative = self.joint_derivative(joint_offset[None], at_clock)
        names, at = list(self.columns), [*joint_offset.tolist()]
        if self.has_clock:
            derivative = torch.cat((derivative, self.clock_derivative(derivative, at_clock)), dim=-1)
            names, at = [*names, CLOCK, CLOCK_RATE], [*at, *clock]
        displacement = derivative[0].mT.cpu().numpy()
        told = {"unknown_names": np.array(names), "unknown_displacement": displacement, "unknown_at": np.array(at)}
        if bool(self.stated_sigma.isnan().all()):
            return told
        clocks = len(names) - len(self.columns)
        return told | {"unknown_sigma": np.append(self.stated_sigma.cpu().numpy(), np.full(clocks, np.nan))}


class FileUnknowns(OffsetUnknowns):
    """The effect of the offsets as an observations file tells it: the same derivatives at every set of offsets."""

    def __init__(self, observations: ShaftObservations, device: str) -> None:
        """Keep the displacements.

        Raises:
            ObservationsError: the observations tell none.
        """
        if observations.unknown_names is None or observations.unknown_displacement is None:
            raise ObservationsError(where="unknown_displacement", expected="effects of offsets", found="none")
        names = observations.unknown_names.tolist()
        joints = [index for index, name in enumerate(names) if name not in CLOCKS]
        # Motions without kinematics are not valid (Problem.from_arrays); they must not spoil the sums either.
        effect = torch.as_tensor(observations.unknown_displacement, device=device).nan_to_num(nan=0.0).mT  # (m, 6, u)
        at = torch.as_tensor(observations.unknown_at, device=device)
        self.columns = tuple(names[index] for index in joints)
        # The laparoscope's come first; an observations file tells its kinematics only where it has such joints.
        arms = [column.partition(".")[0] for column in self.columns]
        both = observations.laparoscope_base_T_arm is not None and len(set(arms)) == 2
        self.laparoscope_joints = arms.count(arms[0]) if both else 0
        self.has_clock = CLOCK in names
        self._joint, self._joint_at = effect[..., joints], at[joints]
        sigma = torch.full_like(at, torch.nan) if observations.unknown_sigma is None else observations.unknown_sigma
        self.stated_sigma = torch.as_tensor(sigma, device=device)[joints]
        self._clock_at, self._clock = at.new_zeros(2), torch.zeros_like(effect[..., :1]).repeat(1, 1, 2)
        for index, name in enumerate(CLOCKS):  # files of before tell no rate
            if name in names:
                self._clock_at[index] = at[names.index(name)]
                self._clock[..., index] = effect[..., names.index(name)]
        self.clock_at = (float(self._clock_at[0]), float(self._clock_at[1]))
        self.motions, self.half_s = len(effect), 0.0  # times are not told

    def every(self, step: int) -> "OffsetUnknowns":
        few = copy(self)
        few._joint, few._clock = self._joint[::step], self._clock[::step]
        few.motions = len(few._joint)
        return few

    def at(self, base: Problem, joint_offset: Float[Tensor, "b j"], clock: Float[Tensor, "b 2"]) -> Problem:
        change = joint_offset - self._joint_at
        displacement = torch.einsum("muj,bj->bmu", self._joint, change)
        displacement = displacement + torch.einsum("muc,bc->bmu", self._clock, clock - self._clock_at)
        repeated = base.take_trials(torch.zeros(len(clock), dtype=torch.int64, device=joint_offset.device))
        return replace(
            repeated,
            arm_T_rcm=repeated.arm_T_rcm @ rigid_exp(displacement),
            joint_offset_at=joint_offset,
            clock_at=clock,
        )

    def joint_derivative(
        self, joint_offset: Float[Tensor, "b j"], clock: Float[Tensor, "b 2"]
    ) -> Float[Tensor, "b m 6 j"]:
        return self._joint.expand(len(clock), *self._joint.shape)

    def clock_derivative(
        self, joint_derivative: Float[Tensor, "b m 6 j"], clock: Float[Tensor, "b 2"]
    ) -> Float[Tensor, "b m 6 2"]:
        return self._clock.expand(len(clock), *self._clock.shape)


def file_unknowns(observations: ShaftObservations, settings: SolverSettings, device: str) -> FileUnknowns | None:
    """The offsets that are asked for and that the file can tell; None where there are none.

    Raises:
        ObservationsError: joint offsets are asked for, and the file does not tell their effect.
    """
    asked = settings.unknowns
    names = [] if observations.unknown_names is None else observations.unknown_names.tolist()
    joints = any(name not in CLOCKS for name in names)
    if asked.joint_offsets == "always" and not joints:
        expected = "unknown_names, unknown_displacement and unknown_at with joints, since joint_offsets is always"
        raise ObservationsError(where="observations", expected=expected, found=f"{np.array(names).tolist() or 'none'}")
    wanted = (joints and asked.joint_offsets != "never") or (CLOCK in names and asked.clock)
    return FileUnknowns(observations, device) if wanted and settings.method == "joint" else None


def estimated_offsets(
    solution: Solution, columns: tuple[str, ...], like: Tensor
) -> tuple[Float[Tensor, " j"], tuple[float, float]]:
    """Joint offsets (rad or mm) and clock (offset, s, and rate) of a solution; zero where they were not estimated."""
    found = {name: nuisance.value.reshape(-1) for name, nuisance in solution.nuisances.items()}
    joint_offset = found.get("joint_offset", like.new_zeros(len(columns)))
    offset_s, rate = (float(found[name]) if name in found else 0.0 for name in ("clock", "clock_rate"))
    return joint_offset, (offset_s, rate)
