"""What a laparoscope that stands still tells whatever the set-up is: where the instrument's base is in the camera."""

import torch
from jaxtyping import Float
from torch import Tensor

from rmis_calib.geometry.rigid import rigid_inverse
from rmis_calib.solver.problem import Problem
from rmis_calib.solver.solution import InstrumentBase


def instrument_base(
    problem: Problem, camera_right_T_arm: Float[Tensor, "b 4 4"], covariance: Float[Tensor, "b 6 6"]
) -> InstrumentBase | None:
    """The pose of the instrument's base in the camera; None where a laparoscope moves, or its kinematics are not told.

    Args:
        problem: what was solved.
        camera_right_T_arm: the answer at the stated set-up.
        covariance: of it, as if that set-up were exact.
    """
    if problem.laparoscope_base_T_arm is None or not bool(problem.laparoscope_stands_still.all()):
        return None
    laparoscope, setup = problem.chains
    arm_T_instrument_base = rigid_inverse(laparoscope[:, 0]) @ setup
    camera_right_T_instrument_base = camera_right_T_arm @ arm_T_instrument_base
    # A turn about the origin of `arm` moves the base as far as it lies from there: dt_base = dt + dphi x lever.
    lever = camera_right_T_instrument_base[:, :3, 3] - camera_right_T_arm[:, :3, 3]
    carried = torch.eye(6, dtype=lever.dtype, device=lever.device).repeat(len(lever), 1, 1)
    axes = torch.eye(3, dtype=lever.dtype, device=lever.device).expand(len(lever), 3, 3)
    carried[:, 3:, :3] = torch.linalg.cross(axes, lever[:, None].expand_as(axes), dim=-1).mT
    return InstrumentBase(camera_right_T_instrument_base, carried @ covariance @ carried.mT)
