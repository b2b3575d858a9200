"""Whether joint offsets and the clock are among the unknowns: searched for, estimated, or allowed for by evidence."""

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
import torch
from jaxtyping import Float
from torch import Tensor

from rmis_calib.config import CalibrationConfig
from rmis_calib.io import ShaftObservations
from rmis_calib.pipeline.arms.offset_unknowns import NO_CLOCK, OffsetUnknowns, estimated_offsets
from rmis_calib.pipeline.motions.observations import problem_of
from rmis_calib.robot import split_joint_column
from rmis_calib.solver import Problem, Solution
from rmis_calib.solver import solve as solve_problem
from rmis_calib.solver.assess.evidence import CHANCE
from rmis_calib.solver.assess.left_out import freed
from rmis_calib.solver.assess.offset_sizes import OffsetSizes, offset_sizes
from rmis_calib.solver.estimate.relinearise import scan_clock
from rmis_calib.solver.own_measurement import Measurement
from rmis_calib.solver.settings import SolverSettings, UnknownSettings
from rmis_calib.solver.solution import AlternativeModel, Nuisance

COARSE_CLOCK_STEP_S, CLOCK_STEP_S = 0.1, 0.02
"""Spacing of the clock offsets that are tried, first everywhere, then near the best: motion hardly turns within
0.1 s, and motion within 0.02 s stays inside one linearisation."""
CLEARLY_BETTER = 0.5
"""Part of the disagreement at the recording's own clock below which another clock offset is believed. A camera that
looks only when the arms rest sees no clock, and its scan has a flat minimum."""
RATE_SEARCH = 0.05
"""Rates of the clock that are tried: a video of 24 frames a second written as one of 25 is 0.04 off."""
SCANNED_MOTIONS = 64
"""Motions on which they are tried, at most twice as many."""
MIXED_SHARE = 0.1
"""Part of a joint's offset that must lie in the unseen combinations for the joint to be named with them."""


def estimate_with_kinematics(
    observations: ShaftObservations,
    config: CalibrationConfig,
    unknowns: OffsetUnknowns,
    clock: tuple[float, float] | None = None,
    measurements: Sequence[Measurement] = (),
) -> tuple[Solution, tuple[str, ...]]:
    """The solve with constant joint offsets, and the clock, among the unknowns of `joint`; and what was decided about
    them, in sentences.

    A combination of offsets that the data cannot tell from the transform (its sigma stays at its prior) is held at
    zero: its prior would else be counted as uncertainty of a transform that absorbs it anyway. With `auto` the data say
    how large the offsets are of which nobody states it, and the covariance counts all sizes (`offset_sizes`).

    Args:
        observations: N motions.
        config: method, measurements to use, noise, unknowns.
        unknowns: the kinematics as a function of the offsets.
        clock: offset (s) and rate found before, to start from; None: those of the unknowns, else they are searched for.
        measurements: of the user's own.
    """
    base = problem_of(observations, config).with_own(measurements).flatten_batch()
    asked = config.solver.unknowns
    sigma = unknowns.prior_sigma(asked)
    if asked.joint_offsets == "never":
        sigma = sigma * 0.0
    start = clock or _clock_start(observations, config, unknowns, sigma)
    moving = _MovingArms(base, config.solver, unknowns, start)
    solution = moving.solve(sigma)
    if clock is None and float(solution.evidence.get("clock_rate", torch.ones(()))) < CHANCE["clock_rate"]:
        found = estimated_offsets(solution, unknowns.columns, sigma)[1]
        better = _clock_with_rate(observations, config, unknowns, found)
        if better is not None:
            moving = replace(moving, clock=better)
            solution = moving.solve(sigma)
    about_clock = _about_clock(solution)
    if "joint_offset" not in solution.nuisances:
        return solution, about_clock
    offsets, moves = solution.nuisances["joint_offset"], sigma > 0
    unseen = offsets.unseen
    if bool(offsets.held.all()):
        about = _about_offsets(offsets, unseen, moves, unknowns.columns, "")
        return moving.solve(sigma * 0.0), (*about_clock, about)
    if bool((unseen[moves][:, moves] != 0).any()):
        solution = moving.solve(sigma, seen=_without_directions(unseen, sigma))
        offsets = solution.nuisances["joint_offset"]
    unstated = moves & unknowns.stated_sigma.isnan()
    if asked.joint_offsets == "always" or not bool(unstated.any()):
        return solution, (*about_clock, _about_offsets(offsets, unseen, moves, unknowns.columns, ""))
    kept = solution
    if "setup" in solution.doubt:  # the last solve allows for it itself
        kept = replace(solution, covariance=solution.covariance - solution.doubt["setup"])
    sizes = offset_sizes(kept, asked.joint_offset_belief, unstated)
    chosen = sizes.chosen
    notes = (*about_clock, _about_offsets(offsets, unseen, moves, unknowns.columns, _about_size(sizes, asked)))
    seen = _without_directions(unseen, sigma)
    sized = torch.where(unstated, sigma * sizes.size[chosen], sigma)
    return moving.solve(sized, sizes.besides(chosen), seen), notes


@dataclass(frozen=True)
class _MovingArms:
    """One problem whose kinematics are a function of offsets.

    Attributes:
        base: the measurements, one trial.
        settings: of the solver.
        unknowns: the kinematics.
        clock: to start from.
    """

    base: Problem
    settings: SolverSettings
    unknowns: OffsetUnknowns
    clock: tuple[float, float]

    def solve(
        self,
        sigma: Float[Tensor, " j"],
        alternative: AlternativeModel | None = None,
        seen: Float[Tensor, "j j"] | None = None,
    ) -> Solution:
        """The solution.

        Args:
            sigma: prior of each joint's offset; zero: none.
            alternative: for the covariance to allow for.
            seen: multiplied to the derivatives by joint, to leave combinations out.
        """

        def kinematics(joint_offset: Tensor, clock: Tensor, setup: Tensor | None = None) -> Problem:
            problem = self.unknowns.linearised(self.base, joint_offset, clock, sigma, setup)
            if seen is None or problem.joint_derivative is None:
                return problem
            return replace(problem, joint_derivative=problem.joint_derivative @ seen)

        settings = self.settings
        if self.clock[1]:  # where it is not nominal it is an unknown
            settings = replace(settings, unknowns=freed(settings.unknowns, "clock_rate"))
        start = kinematics(torch.zeros_like(sigma)[None], sigma.new_tensor([self.clock]))
        return solve_problem(start.take_trials(0), settings, kinematics=kinematics, alternative=alternative)


def _about_clock(solution: Solution) -> tuple[str, ...]:
    """The clock's rate where it was estimated, in words."""
    rate = solution.nuisances.get("clock_rate")
    if rate is None or bool(rate.held):
        return ()
    value, sigma = 100.0 * float(rate.value), 100.0 * float(rate.sigma)
    return (
        f"The joints' clock runs faster than the video's by {value:+.2f} % (1 sigma {sigma:.2g} %), and was corrected: "
        "is the frame rate written wrong?",
    )


def _without_directions(unseen: Float[Tensor, "j j"], sigma: Float[Tensor, " j"]) -> Float[Tensor, "j j"]:
    """Matrix that, multiplied to the derivatives of the kinematics, leaves the unseen combinations without effect."""
    eye = torch.eye(len(sigma), dtype=sigma.dtype, device=sigma.device)
    return sigma[:, None] * (eye - unseen) / torch.where(sigma > 0, sigma, 1.0)


def _about_offsets(
    offsets: Nuisance, unseen: torch.Tensor, moves: torch.Tensor, columns: tuple[str, ...], size: str
) -> str:
    """Whether the encoders have offsets, what would not show, and what is part of the transform.

    Args:
        offsets: the estimated ones.
        unseen: projection onto the combinations that the data do not see, in units of the priors.
        moves: which joints move the shaft; the others (the wrist's) are no part of anything.
        columns: name of each joint, with its unit.
        size: how large they probably are, in a sentence; empty where their prior was asked for.
    """
    names = [split_joint_column(column)[0] for column in columns]
    sigmas, held, shares = offsets.sigma.tolist(), offsets.held.tolist(), unseen.diagonal().tolist()
    joints = zip(names, columns, sigmas, held, shares, moves.tolist(), strict=True)
    visible = [joint for *joint, moved in joints if moved]
    hidden = ", ".join(name for name, _, _, is_held, _ in visible if is_held)
    if all(is_held for _, _, _, is_held, _ in visible):
        return f"Constant joint offsets cannot be separated from the transform here, and are part of it ({hidden})."
    mixed = [name for name, _, _, is_held, share in visible if not is_held and share > MIXED_SHARE]
    seen = ", ".join(f"{name} {_shown(sigma, column)}" for name, column, sigma, is_held, _ in visible if not is_held)
    note = f"{size}This recording measures constant encoder offsets to (1 sigma): {seen}"
    if hidden:
        note += f"; those of {hidden} cannot be separated from the transform and are part of it"
    if len(mixed) > 1:
        note += (
            f"; a combination of those of {', '.join(mixed)} cannot be separated from the transform and is part of it"
        )
    return f"{note}."


def _about_size(sizes: OffsetSizes, asked: UnknownSettings) -> str:
    """How large constant offsets probably are."""
    each = (("rad", np.deg2rad(asked.joint_offset_sigma_deg)), ("mm", asked.joint_offset_sigma_mm))
    middle, most = (
        ", ".join(_shown(sizes.quantile(level) * prior, f"_{unit}") for unit, prior in each) for level in (0.5, 0.95)
    )
    return f"Constant encoder offsets are probably about {middle}, and below {most} with a probability of 95 %. "


def _shown(sigma: float, column: str) -> str:
    return f"{np.rad2deg(sigma):.2g} deg" if split_joint_column(column)[1] == "rad" else f"{sigma:.2g} mm"


def _clock_start(
    observations: ShaftObservations, config: CalibrationConfig, unknowns: OffsetUnknowns, like: Float[Tensor, " j"]
) -> tuple[float, float]:
    """Clock to start from: that of the unknowns; else the offset at which axis lines and joints agree best, where it is
    clearly better than 0."""
    if unknowns.clock_at is not None:
        return unknowns.clock_at
    unstated = observations.laparoscope_base_T_arm is not None
    unstated = unstated and observations.laparoscope_base_T_instrument_base is None
    if not (config.solver.unknowns.clock and unknowns.has_clock) or unstated:  # lines and joints never agree then
        return NO_CLOCK
    base = _axis_lines(observations, config)

    def scan(centre_s: float, half_s: float, step_s: float) -> tuple[float, Tensor]:
        offsets = centre_s + _spread(half_s, step_s).to(like)
        clocks = torch.stack((offsets, torch.zeros_like(offsets)), dim=-1)
        best, score = scan_clock(lambda joint, clock: unknowns.at(base, joint, clock), len(like), clocks)
        return float(best[0]), score

    coarse_s, coarse = scan(0.0, config.clock_search_s, COARSE_CLOCK_STEP_S)
    best_s, fine = scan(coarse_s, COARSE_CLOCK_STEP_S, CLOCK_STEP_S)
    better = min(float(coarse.min()), float(fine.min())) < CLEARLY_BETTER * float(coarse[len(coarse) // 2])
    return (best_s, 0.0) if better else NO_CLOCK


def _clock_with_rate(
    observations: ShaftObservations, config: CalibrationConfig, unknowns: OffsetUnknowns, found: tuple[float, float]
) -> tuple[float, float] | None:
    """The offset and rate at which axis lines and joints agree best, on a sample of the motions; None where that is not
    clearly better than with those `found`.

    The rates tried keep what is added at either end of the recording within `clock_search_s`.
    """
    if unknowns.clock_at is not None:  # a file tells the effect of small offsets only
        return None
    base, step = _axis_lines(observations, config), max(1, unknowns.motions // SCANNED_MOTIONS)
    few, part, joints = unknowns.every(step), base.select_motions(slice(None, None, step)), len(unknowns.columns)
    half_s = max(few.half_s, COARSE_CLOCK_STEP_S)
    reach = min(RATE_SEARCH, config.clock_search_s / half_s)
    at = torch.tensor([found], dtype=torch.float64, device=config.device)

    def scan(centre: Tensor, reach_s: float, reach_rate: float, step_s: float) -> tuple[Tensor, Tensor]:
        rates = _spread(reach_rate, step_s / half_s).to(at)
        away = torch.cartesian_prod(_spread(reach_s, step_s).to(at), rates)
        # At some time of the recording what is added is what was found.
        clocks = centre + away[away[:, 0].abs() <= away[:, 1].abs() * half_s + step_s]
        best, score = scan_clock(lambda joint, clock: few.at(part, joint, clock), joints, torch.cat((at, clocks)))
        return best, score

    best, _ = scan(at, reach * half_s, reach, COARSE_CLOCK_STEP_S)
    best, score = scan(best[None], COARSE_CLOCK_STEP_S, COARSE_CLOCK_STEP_S / half_s, CLOCK_STEP_S)
    offset_s, rate = best.tolist()
    return (offset_s, rate) if float(score.min()) < CLEARLY_BETTER * float(score[0]) and rate else None


def _axis_lines(observations: ShaftObservations, config: CalibrationConfig) -> Problem:
    """Whatever is measured: the axis lines tell the clock even where the answer does not use them."""
    return Problem.from_observations(observations, device=config.device).only("axis").flatten_batch()


def _spread(half: float, step: float) -> Float[Tensor, " k"]:
    """From -half to half, about a step apart, with 0 in the middle."""
    return torch.linspace(-half, half, 2 * max(1, round(half / step)) + 1, dtype=torch.float64)
