"""Motions that somebody could make next, to choose from."""

from dataclasses import dataclass

import numpy as np
from jaxtyping import Int
from torch import Tensor

from rmis_calib.results import INSTRUMENT_BASE
from rmis_calib.solver import Problem, Solution


@dataclass(frozen=True, eq=False)
class Candidates:
    """Motions to choose from.

    Attributes:
        problem: their poses, and what the cameras would measure (`measured_alike`).
        effort: number of things that move.
        words: what to do for each.
        joints: (m, j) readings, where the joints are known.
        columns: their names.
    """

    problem: Problem
    effort: Int[Tensor, " m"]
    words: tuple[str, ...]
    joints: np.ndarray | None = None
    columns: tuple[str, ...] = ()


def at_found_setup(problem: Problem, solution: Solution) -> Problem:
    """The problem, with one trial axis, at the set-up of its answer."""
    if solution.frame == INSTRUMENT_BASE and problem.laparoscope_base_T_arm is not None:
        return problem.in_instrument_base()
    if solution.setup is None:
        return problem
    return problem.at_setup(solution.setup.laparoscope_base_T_instrument_base.reshape(1, 4, 4))
