"""Where to begin when nobody states the set-up: starts (start/setup.py) compete on a sample by all measurements."""

from dataclasses import replace

import torch
from jaxtyping import Bool, Float
from torch import Tensor

from rmis_calib.errors import InsufficientDataError
from rmis_calib.geometry.rigid import rigid_exp
from rmis_calib.solver.estimate.multistart import race
from rmis_calib.solver.estimate.noise_levels import assumed_noise
from rmis_calib.solver.model.packing import pack
from rmis_calib.solver.problem import Problem
from rmis_calib.solver.settings import SolverSettings
from rmis_calib.solver.start.candidates import contour_starts
from rmis_calib.solver.start.setup import setup_starts

MINIMA = 4
"""Starts that compete; in 2,000 trials at realistic noise and at c = 1 the right one was among the first two."""
ROUNDS = 2
"""Refinements of each: a start may be off by a few degrees, beyond what one linearisation carries."""
ENOUGH_IN_FRONT = 0.9


def at_best_setup(problem: Problem, settings: SolverSettings) -> Problem:
    """The problem (one trial axis) at the set-up from which the joint estimate sets out.

    Raises:
        InsufficientDataError: nothing tells where a shaft is in space.
    """
    if settings.unknowns.setup != "free" or problem.laparoscope_base_T_arm is None:
        return problem
    b, like = problem.n_trials, problem.radius_mm
    generator = torch.Generator().manual_seed(settings.seed)
    index = torch.randperm(problem.n_motions, generator=generator)[: settings.start_motions].to(like.device)
    eye = torch.eye(4, dtype=like.dtype, device=like.device)
    sample = problem.detach().select_motions(index).at_setup(eye.expand(b, 4, 4))
    sample = replace(sample, joint_derivative=None, clock_derivative=None)  # evaluated at another set-up
    measured = pack(sample, settings.noise)
    if not measured.has_contours:
        raise InsufficientDataError(
            "state where the arms' bases are (base_T_arm_base) and set solver.unknowns.setup to prior",
            where="the set-up without a prior",
            expected="contours, and the shaft's radius",
            found="none",
        )
    setup = setup_starts(measured, sample.chains[0], torch.nan_to_num(problem.radius_mm), settings.grid, MINIMA)
    setup, outliers = _compete(sample, setup, settings, robust=settings.robust == "on")
    at = torch.nonzero(outliers & (settings.robust == "auto"))[:, 0]
    if len(at):
        setup[at], _ = _compete(sample.take_trials(at), setup[at], settings, robust=True)
    return problem.at_setup(setup[:, 0])


def _compete(
    sample: Problem, setup: Float[Tensor, "b m 4 4"], settings: SolverSettings, robust: bool
) -> tuple[Float[Tensor, "b m 4 4"], Bool[Tensor, " b"]]:
    """Every start refined, the best one first; and where that one does not fit everything."""
    b, minima = setup.shape[:2]
    trial = torch.arange(b, device=setup.device)
    repeated = sample.take_trials(trial.repeat_interleave(minima))
    assumed, free = assumed_noise(repeated, settings.noise)
    flat, best = setup.flatten(0, 1), None
    for _ in range(ROUNDS):
        many = repeated.at_setup(flat)
        rows = pack(many, settings.noise)
        R, t = contour_starts(rows, torch.nan_to_num(many.radius_mm), reweightings=10 if robust else 0, all_kinds=False)
        best = race(many, rows, R, t, assumed, free, settings, robust)
        flat = flat @ rigid_exp(best.state.setup)
    assert best is not None
    front, cost = best.front.view(b, minima), torch.nan_to_num(best.cost.view(b, minima), nan=1e29)
    enough = front >= ENOUGH_IN_FRONT * front.amax(1, keepdim=True)
    order = (cost + torch.where(enough, 0.0, 1e30)).argsort(1)
    ordered = torch.take_along_dim(flat.view(b, minima, 4, 4), order[..., None, None], dim=1)
    return ordered, best.outliers.view(b, minima)[trial, order[:, 0]]
