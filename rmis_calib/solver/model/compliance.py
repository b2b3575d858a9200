"""What the instrument's arm gives way with its pose: a smooth bend and shift of the shaft, as a low-order function of
where it points and how far it is in.

Cannulas flex, joints wind up under gravity, a remote centre moves with the wall: the shaft is then off its kinematics
by a rotation across its axis and a translation that neighbouring poses share. Each component is a sum of Legendre
polynomials up to the fourth order in each of the two angles, to the second in the insertion, and products of two of the
three; the constant too: what gives way has no reason to be zero in the middle.
"""

import torch
from jaxtyping import Float
from torch import Tensor

from rmis_calib.solver.problem import Problem

FUNCTIONS = 14
"""Of the pose, for each component of the displacement."""
TURNS, SHIFTS = 2, 3
"""Components: rotations about, and translations along two directions across the shaft; and the translation along it."""
MEAN_SQUARES = (1.0, *(1 / 3,) * 3, *(1 / 5,) * 3, *(1 / 7,) * 2, *(1 / 9,) * 5)
"""Of each function over its range."""
PRIORS = (1.0, *(1.0,) * 3, *(1 / 2,) * 3, *(1 / 4,) * 2, *(1 / 8,) * 2, *(1 / 2,) * 3)
"""Prior sigma of each function's coefficient, in that of the constant: what is smooth has little of the high orders."""
COUNT = FUNCTIONS * (TURNS + SHIFTS)
LEAST_REACH_RAD, LEAST_REACH_MM = 5e-3, 2.0
"""Half of the range of an angle, and of the insertion, below which nothing depends on it."""


def coordinates(problem: Problem) -> Float[Tensor, "3 b n"]:
    """Two angles of the shaft and its insertion, each from -1 to 1 over the motions; 0 where it hardly changes.

    Angles are those of the instrument's own joints, in `instrument_base`, where the laparoscope's kinematics are told
    too; else they are those in `arm`.
    """
    T = problem.arm_T_rcm if problem.laparoscope_base_T_arm is None else problem.instrument_base_T_rcm
    v = (T[..., :3, :3] @ problem.rcm_v_axis[..., None])[..., 0]
    mean = torch.nn.functional.normalize(v.mean(-2), dim=-1)
    axes = torch.linalg.svd(mean[:, None]).Vh[:, 1:]  # across the mean direction, (b, 2, 3)
    angles = (v @ axes.mT).unbind(-1)
    reach = torch.nan_to_num(problem.rcm_s_end_mm)
    scaled = [_scaled(angle, LEAST_REACH_RAD) for angle in angles] + [_scaled(reach, LEAST_REACH_MM)]
    return torch.stack(scaled)


def _scaled(x: Float[Tensor, "b n"], least: float) -> Float[Tensor, "b n"]:
    low, high = x.amin(-1, keepdim=True), x.amax(-1, keepdim=True)
    half = 0.5 * (high - low)
    return torch.where(half > least, (x - 0.5 * (low + high)) / half.clamp_min(least), 0.0)


def basis(coordinates: Float[Tensor, "3 b n"]) -> Float[Tensor, "f b n"]:
    """Every function of the pose."""
    a, b, s = coordinates.unbind()
    second = [torch.where(x == 0, 0.0, 1.5 * x * x - 0.5) for x in (a, b, s)]
    third = [0.5 * x * (5.0 * x * x - 3.0) for x in (a, b)]
    fourth = [torch.where(x == 0, 0.0, ((35.0 * x * x - 30.0) * x * x + 3.0) / 8.0) for x in (a, b)]
    return torch.stack((torch.ones_like(a), a, b, s, *second, *third, *fourth, a * b, a * s, b * s))
