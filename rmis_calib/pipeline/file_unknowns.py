"""Joint offsets and the clock as unknowns of an observations file, which knows their effect to first order only.

The file says where the shaft is at one set of offsets and how a unit of each displaces it. Further away the
displacement is taken as proportional: within half a degree and a millimetre a joint that is wrong by micrometres.
"""

from dataclasses import replace

import numpy as np
import torch
from jaxtyping import Float
from torch import Tensor

from rmis_calib.errors import ObservationsError
from rmis_calib.geometry.rigid import rigid_exp
from rmis_calib.io import ShaftObservations
from rmis_calib.io.observations import CLOCK
from rmis_calib.pipeline.offset_unknowns import OffsetUnknowns
from rmis_calib.solver import Problem
from rmis_calib.solver.settings import SolverSettings


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
        joints = [index for index, name in enumerate(names) if name != CLOCK]
        # Motions without kinematics are not valid (Problem.from_arrays); they must not spoil the sums either.
        effect = torch.as_tensor(observations.unknown_displacement, device=device).nan_to_num(nan=0.0).mT  # (m, 6, u)
        at = torch.as_tensor(observations.unknown_at, device=device)
        self.columns = tuple(names[index] for index in joints)
        self.has_clock = CLOCK in names
        self._joint, self._joint_at = effect[..., joints], at[joints]
        self.clock_at_s = self._clock_at_s = float(at[names.index(CLOCK)]) if self.has_clock else 0.0
        self._clock = effect[..., names.index(CLOCK)] if self.has_clock else torch.zeros_like(effect[..., 0])

    def at(self, base: Problem, joint_offset: Float[Tensor, "b j"], clock_s: Float[Tensor, " b"]) -> Problem:
        change = joint_offset - self._joint_at
        displacement = torch.einsum("muj,bj->bmu", self._joint, change)
        displacement = displacement + self._clock * (clock_s - self._clock_at_s)[:, None, None]
        repeated = base.take_trials(torch.zeros(len(clock_s), dtype=torch.int64, device=joint_offset.device))
        return replace(
            repeated,
            arm_T_rcm=repeated.arm_T_rcm @ rigid_exp(displacement),
            joint_offset_at=joint_offset,
            clock_at=clock_s,
        )

    def joint_derivative(
        self, joint_offset: Float[Tensor, "b j"], clock_s: Float[Tensor, " b"]
    ) -> Float[Tensor, "b m 6 j"]:
        return self._joint.expand(len(clock_s), *self._joint.shape)

    def clock_derivative(
        self, joint_derivative: Float[Tensor, "b m 6 j"], clock_s: Float[Tensor, " b"]
    ) -> Float[Tensor, "b m 6"]:
        return self._clock.expand(len(clock_s), *self._clock.shape)


def file_unknowns(observations: ShaftObservations, settings: SolverSettings, device: str) -> FileUnknowns | None:
    """The offsets that are asked for and that the file can tell; None where there are none.

    Raises:
        ObservationsError: joint offsets are asked for, and the file does not tell their effect.
    """
    asked = settings.unknowns
    names = [] if observations.unknown_names is None else observations.unknown_names.tolist()
    joints = any(name != CLOCK for name in names)
    if asked.joint_offsets == "always" and not joints:
        expected = "unknown_names, unknown_displacement and unknown_at with joints, since joint_offsets is always"
        raise ObservationsError(where="observations", expected=expected, found=f"{np.array(names).tolist() or 'none'}")
    wanted = (joints and asked.joint_offsets != "never") or (CLOCK in names and asked.clock)
    return FileUnknowns(observations, device) if wanted and settings.method == "joint" else None
