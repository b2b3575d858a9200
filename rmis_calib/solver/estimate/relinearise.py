"""Joint offsets, the clock and the set-up: unknowns that act through the kinematics.

The caller hands in `kinematics(joint_offset, clock)`: the problem with both arms' poses evaluated at these offsets,
their derivatives with it. The solver estimates increments from the derivatives, has the kinematics evaluated again
there, and repeats until the increments vanish. The set-up (the pose of one arm's base in the other's) needs no such
function: a problem with the laparoscope's own kinematics is put to another one exactly (`Problem.at_setup`).

**Clock start.** Offsets of seconds are far outside of any linearisation. They are found without knowing the
transform: for every candidate offset the axis lines give a 9x9 Gram matrix and the least rotation cost over all of
SO(3) (start/candidates.py). Only the right offset makes the pictures and the joints agree. All candidates are one
batch. It is the cross-correlation of the two motions, with the unknown rotation between them eliminated.
"""

from collections.abc import Callable

import torch
from jaxtyping import Float
from torch import Tensor

from rmis_calib.geometry.rigid import rigid_exp
from rmis_calib.solver.estimate.map_estimate import MapEstimate, map_estimate
from rmis_calib.solver.estimate.setup_start import at_best_setup
from rmis_calib.solver.problem import Problem
from rmis_calib.solver.settings import SolverSettings
from rmis_calib.solver.start.candidates import find_candidates
from rmis_calib.solver.start.line_statistics import LineStatistics

Kinematics = Callable[..., Problem]
"""(joint offsets (b, j), clock offset in s and rate (b, 2)) -> problem with that trial axis, `joint_offset_at` and
`clock_at` set. Where the set-up is an unknown too, the `laparoscope_base_T_instrument_base` to evaluate at is a third
argument, (b, 4, 4)."""

ROUNDS = 5
SETTLED_SIGMA = 0.05
"""Rounds end when every increment is below this part of its own sigma."""
SCAN_GRID = 240
"""Rotations of the covering grid during the scan of clock offsets; the motion, not the basin, is looked for."""


def scan_clock(
    kinematics: Kinematics, joints: int, clocks: Float[Tensor, "k 2"]
) -> tuple[Float[Tensor, " 2"], Float[Tensor, " k"]]:
    """The candidate clock (offset and rate) at which lines and joints agree best, and the score of each (mean squared
    sine).

    Candidates at which fewer than half as many motions are valid as at the best covered one do not compete. Motions
    that a candidate loses count as if they agreed as well as they do at the typical one: a few always agree.
    """
    problem = kinematics(clocks.new_zeros(clocks.shape[0], joints), clocks)
    statistics = LineStatistics.from_problem(problem)
    count = statistics.count.sum(-1)
    score = find_candidates(statistics, SCAN_GRID, 2).score.amin(-1)
    share = count / count.amax().clamp_min(1.0)
    competes = share >= 0.5
    score = share * score + (1.0 - share) * score[competes].median()
    score = torch.where(competes, score, torch.inf)
    return clocks[score.argmin()], score


def solve_relinearised(problem: Problem, settings: SolverSettings, kinematics: Kinematics | None) -> MapEstimate:
    """Joint estimate with the kinematics evaluated anew at the estimated offsets and set-up, until they settle.

    Args:
        problem: one trial axis, at the offsets and the set-up to start from (`joint_offset_at`, `clock_at`,
            `laparoscope_base_T_instrument_base`).
        kinematics: of the same trials; None where the set-up alone is unknown.
    """
    fit = map_estimate(problem, settings)
    for _ in range(ROUNDS - 1):
        if _settled(fit):
            break
        joint_offset = _at(problem.joint_offset_at, fit.state.joint_offset) + fit.state.joint_offset
        clock = _at(problem.clock_at, fit.state.clock) + fit.state.clock
        setup = None
        if "setup" in fit.model.layout.blocks:
            setup = problem.chains[1] @ rigid_exp(fit.state.setup)
        problem = evaluated(problem, kinematics, joint_offset, clock, setup)
        fit = map_estimate(problem, settings, fit)
    return fit


def evaluated(
    problem: Problem,
    kinematics: Kinematics | None,
    joint_offset: Float[Tensor, "b j"],
    clock: Float[Tensor, "b 2"],
    setup: Float[Tensor, "b 4 4"] | None,
) -> Problem:
    """The problem at these offsets and this set-up; None: as it is stated."""
    if kinematics is not None:
        return kinematics(joint_offset, clock) if setup is None else kinematics(joint_offset, clock, setup)
    return problem if setup is None else problem.at_setup(setup)


def start_of(problem: Problem, settings: SolverSettings, kinematics: Kinematics | None) -> Problem:
    """The problem at the set-up to start from, its own offsets kept."""
    begin = at_best_setup(problem, settings)
    if kinematics is None or begin is problem or problem.joint_offset_at is None or problem.clock_at is None:
        return begin
    return evaluated(begin, kinematics, problem.joint_offset_at, problem.clock_at, begin.chains[1])


def _at(value: Tensor | None, like: Tensor) -> Tensor:
    return torch.zeros_like(like) if value is None else value


def _settled(fit: MapEstimate) -> bool:
    sigma = fit.covariance.diagonal(dim1=-2, dim2=-1).clamp_min(0.0).sqrt()
    moves = {"joint_offset": fit.state.joint_offset, "setup": fit.state.setup}
    moves |= {"clock": fit.state.clock[:, :1], "clock_rate": fit.state.clock[:, 1:]}
    for name, moved in moves.items():
        part = fit.model.layout.blocks.get(name)
        if part is not None and bool((moved.abs() > SETTLED_SIGMA * sigma[:, part]).any()):
            return False
    return True
