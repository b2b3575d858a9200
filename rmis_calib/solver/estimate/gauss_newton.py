"""Two loops that drive the weighted score to zero: Levenberg-Marquardt from far away, Gauss-Newton passes over all
motions at the end.

Neither knows what the residuals are. Both keep, trial by trial, the best accepted iterate, and both end with a named
status.
"""

from dataclasses import dataclass, replace

import torch
from jaxtyping import Float, Int
from torch import Tensor

from rmis_calib.solver.model.batched_linalg import unit_diagonal
from rmis_calib.solver.model.motion_covariance import frozen_chi2
from rmis_calib.solver.model.normal_equations import Normal, accumulate, normal_equations, with_prior
from rmis_calib.solver.model.parameters import ParameterLayout
from rmis_calib.solver.model.residuals import residual_rows
from rmis_calib.solver.model.state import State
from rmis_calib.solver.model.weighted_model import WeightedModel
from rmis_calib.solver.status import SolveStatus

INITIAL_DAMPING = 1e-4
"""Relative to the diagonal of H; starts are near a minimum, so nearly Gauss-Newton."""
NULL_RIDGE = 1e-13
"""Added to the unit diagonal of a scaled system: a direction that the data do not see at all would else take its step
from rounding."""
PREDICTION_MARGIN = 0.25
"""A pass is saved only where the step after it is predicted to be this part of the tolerance."""
MAX_DAMPING = 1e8
"""Past this no step goes downhill to the working precision: the loop has stalled."""


@dataclass(frozen=True)
class Refined:
    """Outcome of a loop: state, its normal equations, status codes (`SolveStatus`) and accepted steps, per trial."""

    state: State
    normal: Normal
    status: Int[Tensor, " b"]
    steps: Int[Tensor, " b"]
    history: tuple[Float[Tensor, " b"], ...] = ()

    def where(self, chosen: Tensor, other: "Refined") -> "Refined":
        """This outcome in the chosen trials, `other` elsewhere."""
        return Refined(
            state=self.state.where(chosen, other.state),
            normal=_where(chosen, self.normal, other.normal),
            status=torch.where(chosen, self.status, other.status),
            steps=torch.where(chosen, self.steps, other.steps),
            history=self.history,
        )


def solve_system(
    H: Float[Tensor, "b p p"], g: Float[Tensor, "b p"], damping: Tensor | None = None
) -> tuple[Tensor, Tensor]:
    """(-(H + damping diag H)^-1 g, solvable): Cholesky after scaling to a unit diagonal, so that radians and
    millimetres mix.

    The step is zero where the system is not positive definite, and `solvable` says so.
    """
    scaled, scale = unit_diagonal(H)
    if damping is not None:
        scaled = scaled + torch.diag_embed(damping[:, None].expand_as(scale))
    identity = torch.eye(H.shape[-1], dtype=H.dtype, device=H.device)
    factor, info = torch.linalg.cholesky_ex(torch.nan_to_num(scaled, nan=0.0) + NULL_RIDGE * identity)
    solvable = (info == 0) & torch.isfinite(H).all(-1).all(-1) & torch.isfinite(g).all(-1)
    factor = torch.where(solvable[:, None, None], factor, identity)
    step = -scale * torch.cholesky_solve((g * scale)[..., None], factor)[..., 0]
    return torch.where(solvable[:, None], step, 0.0), solvable


def levenberg_marquardt(model: WeightedModel, state: State, tolerance: float, max_iterations: int) -> Refined:
    """Minimises r^T S^-1 r + priors with S held at each accepted iterate; a step counts only if this frozen cost falls.

    Converged when the undamped step d has d^T H d < tolerance^2: smaller than that part of the standard error in
    every direction.
    """
    layout, b, device = model.layout, state.t.shape[0], state.t.device
    damping = torch.full((b,), INITIAL_DAMPING, dtype=state.t.dtype, device=device)
    status = torch.full((b,), SolveStatus.MAX_ITERATIONS, dtype=torch.int64, device=device)
    steps, running = torch.zeros_like(status), torch.ones_like(status, dtype=torch.bool)
    normal = with_prior(normal_equations(model, state, keep=True), layout, state)
    history = [normal.chi2]
    for _ in range(max_iterations):
        newton, solvable = solve_system(normal.H, normal.g)
        decrement = -(newton * normal.g).sum(-1)
        done = running & solvable & (decrement < tolerance**2)
        status = torch.where(done, SolveStatus.CONVERGED, status)
        status = torch.where(running & ~torch.isfinite(normal.chi2), SolveStatus.NON_FINITE, status)
        running = running & ~done & torch.isfinite(normal.chi2)
        if not bool(running.any()):
            break
        delta, possible = solve_system(normal.H, normal.g, damping)
        proposal = state.moved(layout.step(delta))
        deviation, prior_weight = layout.prior(proposal)
        chi2 = frozen_chi2(normal.kept_factor, residual_rows(model.measured, proposal)).sum(-1) + (
            prior_weight * deviation.square()
        ).sum(-1)
        predicted = -(delta * normal.g).sum(-1)
        accepted = running & possible & (chi2 < normal.chi2) & torch.isfinite(chi2)
        ratio = (normal.chi2 - chi2) / predicted.clamp_min(1e-300)
        damping = torch.where(accepted, damping * torch.where(ratio > 0.5, 0.1, 1.0), damping * 8.0).clamp_min(1e-12)
        stalled = running & (damping > MAX_DAMPING)
        status = torch.where(stalled, torch.where(solvable, SolveStatus.STALLED, SolveStatus.SINGULAR), status)
        running = running & ~stalled
        steps = steps + accepted
        if bool(accepted.any()):
            state = proposal.where(accepted, state)
            normal = with_prior(normal_equations(model, state, keep=True), layout, state)
            history.append(normal.chi2)
    return Refined(state, normal, status, steps, tuple(history))


def gauss_newton(model: WeightedModel, state: State, tolerance: float, max_passes: int) -> Refined:
    """Gauss-Newton passes over all motions, streaming, from a start within a few standard errors.

    A step is kept if the next pass finds the Newton decrement g^T H^-1 g smaller; else it is undone and a quarter of
    it is tried. Steps shrink at least by the same ratio each time; one after which the next is predicted to be below
    the tolerance is taken as the last, and saves the pass that would confirm it.
    """
    b, device = state.t.shape[0], state.t.device
    status = torch.full((b,), SolveStatus.MAX_ITERATIONS, dtype=torch.int64, device=device)
    steps = torch.zeros_like(status)

    def evaluate(at: State) -> tuple[Normal, Tensor, Tensor, Tensor]:
        normal = accumulate(model, at)
        delta, solvable = solve_system(normal.H, normal.g)
        return normal, delta, solvable, -(delta * normal.g).sum(-1)

    normal, delta, solvable, decrement = evaluate(state)
    running, previous = torch.ones_like(status, dtype=torch.bool), torch.zeros_like(decrement)
    for _ in range(max_passes):
        bad = ~torch.isfinite(normal.chi2)
        status = torch.where(
            running & bad, SolveStatus.NON_FINITE, torch.where(running & ~solvable, SolveStatus.SINGULAR, status)
        )
        done = running & solvable & ~bad & (decrement < tolerance**2)
        status = torch.where(done, SolveStatus.CONVERGED, status)
        running = running & solvable & ~bad & ~done
        last = running & (decrement.square() < (PREDICTION_MARGIN * tolerance) ** 2 * previous)
        if bool(last.any()):
            state, normal = _settled(state, normal, model.layout, delta, last)
            status, steps, running = torch.where(last, SolveStatus.CONVERGED, status), steps + last, running & ~last
        if not bool(running.any()):
            break
        proposal = state.moved(model.layout.step(torch.where(running[:, None], delta, 0.0)))
        new_normal, new_delta, new_solvable, new_decrement = evaluate(proposal)
        better = running & new_solvable & (new_decrement < decrement)
        state = proposal.where(better, state)
        steps = steps + better
        normal = _where(better, new_normal, normal)
        delta = torch.where(better[:, None], new_delta, delta / 4.0)
        previous = torch.where(better, decrement, 0.0)
        decrement = torch.where(better, new_decrement, decrement)
    else:
        status = torch.where(running & (decrement < tolerance**2), SolveStatus.CONVERGED, status)
    return Refined(state, normal, status, steps)


def _settled(
    state: State, normal: Normal, layout: ParameterLayout, delta: Tensor, chosen: Tensor
) -> tuple[State, Normal]:
    """The chosen trials after their last step, by the quadratic model: no score is left, and chi^2 has fallen by the
    decrement."""
    step = torch.where(chosen[:, None], delta, 0.0)
    g = torch.where(chosen[:, None], 0.0, normal.g)
    return state.moved(layout.step(step)), replace(normal, g=g, chi2=normal.chi2 + (normal.g * step).sum(-1))


def _where(chosen: Tensor, a: Normal, b: Normal) -> Normal:
    def pick(x: Tensor, y: Tensor) -> Tensor:
        return torch.where(chosen.reshape(-1, *(1,) * (x.ndim - 1)), x, y)

    return replace(
        b, **{name: pick(getattr(a, name), getattr(b, name)) for name in ("H", "g", "chi2", "rows", "distance2")}
    )
