"""Whether joint offsets and the clock are among the unknowns: searched for, estimated, or allowed for by evidence."""

from collections.abc import Sequence
from dataclasses import replace

import numpy as np
import torch
from jaxtyping import Float
from torch import Tensor

from rmis_calib.config import CalibrationConfig
from rmis_calib.io import ShaftObservations
from rmis_calib.pipeline.observations import problem_of
from rmis_calib.pipeline.offset_unknowns import OffsetUnknowns
from rmis_calib.robot import split_joint_column
from rmis_calib.solver import Problem, Solution
from rmis_calib.solver import solve as solve_problem
from rmis_calib.solver.estimate.relinearise import scan_clock
from rmis_calib.solver.own_measurement import Measurement
from rmis_calib.solver.solution import AlternativeModel, Nuisance

COARSE_CLOCK_STEP_S, CLOCK_STEP_S = 0.1, 0.02
"""Spacing of the clock offsets that are tried, first everywhere, then near the best: motion hardly turns within
0.1 s, and motion within 0.02 s stays inside one linearisation."""
CLEARLY_BETTER = 0.5
"""Part of the disagreement at the recording's own clock below which another clock offset is believed. A camera that
looks only when the arms rest sees no clock, and its scan has a flat minimum."""
STRONG_EVIDENCE = 3.0
"""Log of the odds, 20 to 1, that the data must give for joint offsets to be estimated (Kass & Raftery 1995: strong)."""
MIXED_SHARE = 0.1
"""Part of a joint's offset that must lie in the unseen combinations for the joint to be named with them."""


def estimate_with_kinematics(
    observations: ShaftObservations,
    config: CalibrationConfig,
    unknowns: OffsetUnknowns,
    clock_s: float | None = None,
    measurements: Sequence[Measurement] = (),
) -> tuple[Solution, tuple[str, ...]]:
    """The solve with constant joint offsets, and the clock offset, among the unknowns of `joint`; and what was decided
    about the offsets, in sentences.

    A combination of offsets that the data cannot tell from the transform (its sigma stays at its prior) is held at
    zero: its prior would else be counted as uncertainty of a transform that absorbs it anyway. With `auto` all offsets
    are left out unless there is strong evidence of them; the covariance then allows for the other possibility.

    Args:
        observations: N motions.
        config: method, measurements to use, noise, unknowns.
        unknowns: the kinematics as a function of the offsets.
        clock_s: clock offset found before, to start from; None: that of the unknowns, else it is searched for.
        measurements: of the user's own.
    """
    base = problem_of(observations, config).with_own(measurements).flatten_batch()
    asked = config.solver.unknowns
    sigma = unknowns.prior_sigma(asked)
    if asked.joint_offsets == "never":
        sigma = sigma * 0.0
    if clock_s is None:
        clock_s = _clock_start(observations, config, unknowns, sigma)
    clock_at = sigma.new_full((1,), clock_s)

    def solve_with(
        sigma: torch.Tensor, alternative: AlternativeModel | None = None, seen: torch.Tensor | None = None
    ) -> Solution:
        def kinematics(joint_offset: torch.Tensor, clock_s: torch.Tensor, setup: torch.Tensor | None = None) -> Problem:
            problem = unknowns.linearised(base, joint_offset, clock_s, sigma, setup)
            if seen is None or problem.joint_derivative is None:
                return problem
            return replace(problem, joint_derivative=problem.joint_derivative @ seen)

        start = kinematics(torch.zeros_like(sigma)[None], clock_at)
        return solve_problem(start.take_trials(0), config.solver, kinematics=kinematics, alternative=alternative)

    solution = solve_with(sigma)
    if "joint_offset" not in solution.nuisances:
        return solution, ()
    offsets, moves = solution.nuisances["joint_offset"], sigma > 0
    unseen = offsets.unseen
    if bool(offsets.held.all()):
        return solve_with(sigma * 0.0), (_about_offsets(offsets, unseen, moves, unknowns.columns, 0.0),)
    if bool((unseen[moves][:, moves] != 0).any()):
        solution = solve_with(sigma, seen=_without_directions(unseen, sigma))
        offsets = solution.nuisances["joint_offset"]
    belief = offsets.log_odds_nominal.new_tensor(asked.joint_offset_belief)
    probability = torch.sigmoid(torch.logit(belief) - offsets.log_odds_nominal)
    note = _about_offsets(offsets, unseen, moves, unknowns.columns, float(probability))
    if asked.joint_offsets == "always" or bool(offsets.log_odds_nominal < -STRONG_EVIDENCE):
        return solution, (note,)
    return solve_with(sigma * 0.0, AlternativeModel(solution.camera_right_T_arm, solution.covariance, probability)), (
        note,
    )


def _without_directions(unseen: Float[Tensor, "j j"], sigma: Float[Tensor, " j"]) -> Float[Tensor, "j j"]:
    """Matrix that, multiplied to the derivatives of the kinematics, leaves the unseen combinations without effect."""
    eye = torch.eye(len(sigma), dtype=sigma.dtype, device=sigma.device)
    return sigma[:, None] * (eye - unseen) / torch.where(sigma > 0, sigma, 1.0)


def _about_offsets(
    offsets: Nuisance, unseen: torch.Tensor, moves: torch.Tensor, columns: tuple[str, ...], probability: float
) -> str:
    """Whether the encoders have offsets, what would not show, and what is part of the transform.

    Args:
        offsets: the estimated ones.
        unseen: projection onto the combinations that the data do not see, in units of the priors.
        moves: which joints move the shaft; the others (the wrist's) are no part of anything.
        columns: name of each joint, with its unit.
        probability: that there are offsets at all.
    """
    names = [split_joint_column(column)[0] for column in columns]
    sigmas, held, shares = offsets.sigma.tolist(), offsets.held.tolist(), unseen.diagonal().tolist()
    joints = zip(names, columns, sigmas, held, shares, moves.tolist(), strict=True)
    visible = [joint for *joint, moved in joints if moved]
    hidden = ", ".join(name for name, _, _, is_held, _ in visible if is_held)
    if all(is_held for _, _, _, is_held, _ in visible):
        return f"Constant joint offsets cannot be told from the transform here, and are part of it ({hidden})."
    mixed = [name for name, _, _, is_held, share in visible if not is_held and share > MIXED_SHARE]
    seen = ", ".join(f"{name} {_shown(sigma, column)}" for name, column, sigma, is_held, _ in visible if not is_held)
    note = (
        f"Estimated probability of constant encoder offsets: {100.0 * probability:.0f} %. If present, this recording "
        f"would measure them to (1 sigma): {seen}"
    )
    if hidden:
        note += f"; those of {hidden} cannot be told from the transform and are part of it"
    if len(mixed) > 1:
        note += f"; a combination of those of {', '.join(mixed)} cannot be told from the transform and is part of it"
    return f"{note}."


def _shown(sigma: float, column: str) -> str:
    return f"{np.rad2deg(sigma):.2g} deg" if split_joint_column(column)[1] == "rad" else f"{sigma:.2g} mm"


def _clock_start(
    observations: ShaftObservations, config: CalibrationConfig, unknowns: OffsetUnknowns, like: Float[Tensor, " j"]
) -> float:
    """Clock offset to start from: that of the unknowns; else the one at which axis lines and joints agree best, where
    it is clearly better than 0."""
    if unknowns.clock_at_s is not None:
        return unknowns.clock_at_s
    unstated = observations.laparoscope_base_T_arm is not None
    unstated = unstated and observations.laparoscope_base_T_instrument_base is None
    if not (config.solver.unknowns.clock and unknowns.has_clock) or unstated:  # lines and joints never agree then
        return 0.0
    # Whatever is measured: the axis lines tell the clock even where the answer does not use them.
    base = Problem.from_observations(observations, device=config.device).only("axis").flatten_batch()

    def scan(centre_s: float, half_s: float, step_s: float) -> tuple[float, torch.Tensor]:
        count = 2 * round(half_s / step_s) + 1
        offsets = centre_s + torch.linspace(-half_s, half_s, count).to(like)
        return scan_clock(lambda joint, clock: unknowns.at(base, joint, clock), len(like), offsets)

    coarse_s, coarse = scan(0.0, config.clock_search_s, COARSE_CLOCK_STEP_S)
    best_s, fine = scan(coarse_s, COARSE_CLOCK_STEP_S, CLOCK_STEP_S)
    better = min(float(coarse.min()), float(fine.min())) < CLEARLY_BETTER * float(coarse[len(coarse) // 2])
    return best_s if better else 0.0
