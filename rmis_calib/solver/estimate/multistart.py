"""Which start the joint estimate sets out from: minima of the axis planes and closed forms from contours race on a
sample of the motions."""

from dataclasses import dataclass, replace

import torch
from jaxtyping import Bool, Float
from torch import Tensor

from rmis_calib.solver.estimate.gauss_newton import levenberg_marquardt
from rmis_calib.solver.estimate.outliers import anneal, chi2_quantile, truncated_cost
from rmis_calib.solver.model.measurement_rows import MeasurementRows
from rmis_calib.solver.model.motion_covariance import NoiseModel, camera_distance2
from rmis_calib.solver.model.parameters import NuisancePriors, initial_state, make_layout
from rmis_calib.solver.model.predicted_shaft import predict_shaft
from rmis_calib.solver.model.residuals import predicted_s_end
from rmis_calib.solver.model.state import State
from rmis_calib.solver.model.weighted_model import WeightedModel
from rmis_calib.solver.problem import Problem
from rmis_calib.solver.settings import SolverSettings
from rmis_calib.solver.start.candidates import contour_starts, find_candidates
from rmis_calib.solver.start.from_points import point_starts
from rmis_calib.solver.start.line_statistics import LineStatistics
from rmis_calib.solver.start.robust import robust_candidates
from rmis_calib.solver.tensors import spans

START_ITERATIONS = 12
START_TOLERANCE = 0.1
"""Starts are compared, not reported: a tenth of a standard error of the sample is enough."""
COMPETING_MINIMA = 4
ROBUST_SAMPLES = 3
"""Times as many motions where there are outliers: with 40 per cent of wrong axis lines 4 of 150 trials were lost from
96 motions, 1 from 288."""
SETTLED_FIT = 1.5
"""Chi^2 per row up to which the first start needs no competition..."""
SURE_RAD = 0.02
"""...if its own sample fixes the rotation this well (1.1 degrees)."""


def cheirality(measured: MeasurementRows, state: State, used: Bool[Tensor, "c b n"]) -> Float[Tensor, " b"]:
    """Part of the used lines with the visible shaft in front of the camera and running to the tip as in the picture;
    used head points, and ends where no line was measured, count when they are in front."""
    shaft = predict_shaft(measured, state)
    x0, y0 = measured.line_xy[:, 0]
    x1, y1 = measured.line_xy[:, 1]
    turn = (y0 - y1) * shaft.m[0] + (x1 - x0) * shaft.m[1] + (x0 * y1 - y0 * x1) * shaft.m[2]
    depth = (x0 + x1) * shaft.u[0] + (y0 + y1) * shaft.u[1] + 2.0 * shaft.u[2]
    ok = measured.line_ok[0] & used
    kinds = [((turn > 0) & (depth > 0), ok)]
    if measured.has_heads:
        kinds.append((shaft.p[2] + shaft.head[2] > 0, measured.head_ok & used))
    if measured.has_ends and not bool(measured.line_ok.any()):
        s_end = predicted_s_end(measured, state)
        kinds.append((shaft.p[2] + s_end * shaft.d[2] > 0, measured.end_ok & used))
    good = torch.stack([(front & ok).sum((0, 2)) for front, ok in kinds]).sum(0)
    return good / torch.stack([ok.sum((0, 2)) for _, ok in kinds]).sum(0).clamp_min(1)


def multistart(
    problem: Problem,
    measured: MeasurementRows,
    order: Tensor,
    assumed: NoiseModel,
    free: dict[str, Tensor],
    settings: SolverSettings,
) -> tuple[State, NoiseModel, Bool[Tensor, " b"]]:
    """The best start after a short refinement on a sample, noise inflated to what it explains, and which trials have
    outliers. Every trial on its own: those that a first start settles compete no further."""
    index = order[: settings.start_motions]
    sample = measured.take_motions(index)
    starts = None if measured.has_contours else _starts(problem, measured, settings)
    if starts is None:  # a closed form from the sample; the search over all motions only where it does not settle
        R, t = contour_starts(sample, torch.nan_to_num(problem.radius_mm), all_kinds=False)
    else:
        R, t = starts[0][:, :1], starts[1][:, :1]
    first = race(problem, sample, R, t, assumed, free, settings, robust=False)
    state, noise, contaminated = first.state, first.noise, torch.zeros_like(first.settled)
    open_ = torch.nonzero(~first.settled)[:, 0]
    if len(open_):
        if starts is not None:
            starts = starts[0][open_], starts[1][open_]
        free_open = {name: value[open_] for name, value in free.items()}
        part = problem.take_trials(open_), measured.take_trials(open_), order, assumed.take(open_), free_open, settings
        best = _compete(*part, starts)
        state, noise = state.put(open_, best.state), noise.put(open_, best.noise)
        contaminated[open_] = best.outliers
    return state, noise, contaminated


def _compete(
    problem: Problem,
    measured: MeasurementRows,
    order: Tensor,
    assumed: NoiseModel,
    free: dict[str, Tensor],
    settings: SolverSettings,
    starts: tuple[Tensor, Tensor] | None,
) -> "Race":
    """All starts, and where there are outliers robust ones too; `outliers` says where these were needed."""
    sample = measured.take_motions(order[: settings.start_motions])
    R, t = _starts(problem, measured, settings) if starts is None else starts
    best = race(problem, sample, R, t, assumed, free, settings, robust=False)
    # A poor fit hides outliers where the noise levels are to be estimated: they are raised until it looks good.
    suspect = best.outliers | (settings.robust == "on") | (_any_free_by_trial(free) & ~best.settled)
    at = torch.nonzero(suspect & (settings.robust != "off"))[:, 0]
    best = replace(best, outliers=torch.zeros_like(suspect))
    if not len(at):
        return best
    index = order[: ROBUST_SAMPLES * settings.start_motions]
    problem, measured = problem.take_trials(at), measured.take_trials(at)
    assumed, free = assumed.take(at), {name: value[at] for name, value in free.items()}
    sample = measured.take_motions(index)
    candidates = robust_candidates(problem.select_motions(index), settings.grid, COMPETING_MINIMA)
    state = best.state.take(at)
    starts_R, starts_t = [state.R[:, None], candidates.R], [state.t[:, None], candidates.t]
    if measured.has_contours:
        R, t = contour_starts(sample, torch.nan_to_num(problem.radius_mm), reweightings=10)
        starts_R, starts_t = [*starts_R, R], [*starts_t, t]
    if _points_matter(measured):
        R, t = point_starts(sample, settings.grid, COMPETING_MINIMA, reweightings=4)
        starts_R, starts_t = [*starts_R, R], [*starts_t, t]
    robust = race(problem, sample, torch.cat(starts_R, 1), torch.cat(starts_t, 1), assumed, free, settings, robust=True)
    contaminated = torch.zeros_like(suspect)
    contaminated[at] = True
    state, noise = best.state.put(at, robust.state), best.noise.put(at, robust.noise)
    return replace(best, state=state, noise=noise, outliers=contaminated)


@dataclass(frozen=True)
class Race:
    """Winner of a race of starts, its noise levels, truncated cost and cheirality; which trials have outliers, and
    which need no other start."""

    state: State
    noise: NoiseModel
    cost: Float[Tensor, " b"]
    front: Float[Tensor, " b"]
    outliers: Bool[Tensor, " b"]
    settled: Bool[Tensor, " b"]


def _starts(
    problem: Problem, measured: MeasurementRows, settings: SolverSettings
) -> tuple[Float[Tensor, "b s 3 3"], Float[Tensor, "b s 3"]]:
    """Minima of the axis planes, and starts from contours and ends."""
    candidates = find_candidates(LineStatistics.from_problem(problem), settings.grid, settings.minima)
    chosen = candidates.order()[:, :COMPETING_MINIMA]
    rows = torch.arange(chosen.shape[0], device=chosen.device)[:, None]
    R, t = candidates.R[rows, chosen], candidates.t[rows, chosen]
    if measured.has_contours:
        more_R, more_t = contour_starts(measured, torch.nan_to_num(problem.radius_mm))
        R, t = torch.cat((R, more_R), dim=1), torch.cat((t, more_t), dim=1)
    if _points_matter(measured):
        more_R, more_t = point_starts(measured, settings.grid, COMPETING_MINIMA)
        R, t = torch.cat((more_R, R), dim=1), torch.cat((more_t, t), dim=1)
    return R, t


def _points_matter(measured: MeasurementRows) -> bool:
    """Whether to start from points: head points always, the shaft's ends where contours do not tell their places."""
    return measured.has_heads or (measured.has_ends and not measured.has_contours)


def race(
    problem: Problem,
    sample: MeasurementRows,
    R: Float[Tensor, "b s 3 3"],
    t: Float[Tensor, "b s 3"],
    assumed: NoiseModel,
    free: dict[str, Tensor],
    settings: SolverSettings,
    robust: bool,
) -> Race:
    """Refines every start on the sample and keeps, per trial, the one of least truncated cost among those in front of
    the camera."""
    b, s = R.shape[:2]
    nominal = NuisancePriors.of(problem)
    states, kept = [], []
    for part in spans(b, settings.chunk // (s * sample.motions)):
        many = sample.narrow(part, slice(None)).repeat_trials(s)
        noise = assumed.take(part).repeat(s)
        narrowed = nominal.repeat(part, s)
        state = initial_state(narrowed, R[part].flatten(0, 1), t[part].flatten(0, 1))
        layout = make_layout(narrowed, many, state, settings.unknowns, settings.noise)
        model = WeightedModel(many, layout, noise, chunk=settings.chunk)
        if robust:
            state, weight = anneal(model, state, settings.outlier_probability, steps=12)
            refined = levenberg_marquardt(replace(model, weight=weight), state, START_TOLERANCE, 3)
        else:
            refined = levenberg_marquardt(model, state, START_TOLERANCE, START_ITERATIONS)
        distance2, rows = camera_distance2(many, refined.state, noise, refined.normal.linear)
        cost = truncated_cost(distance2, rows, settings.outlier_probability if robust else 1e-12)
        front = cheirality(many, refined.state, torch.ones_like(distance2, dtype=torch.bool)).view(-1, s)
        enough = front >= 0.9 * front.amax(1, keepdim=True)
        best = (torch.nan_to_num(cost.view(-1, s), nan=1e29) + torch.where(enough, 0.0, 1e30)).argmin(1)
        flat = best + s * torch.arange(best.shape[0], device=best.device)
        states.append(refined.state.take(flat))
        least = cost.flatten()[flat]
        kept.append((distance2[:, flat], rows[:, flat], front.flatten()[flat], _sure(refined.normal.H[flat]), least))
    state = State(**{name: torch.cat([getattr(part, name) for part in states]) for name in vars(states[0])})
    distance2, rows = (torch.cat([part[i] for part in kept], dim=1) for i in (0, 1))
    front, sure, cost = (torch.cat([part[i] for part in kept]) for i in (2, 3, 4))
    noise = _inflated(assumed, free, distance2, rows)
    limit = chi2_quantile(rows, settings.outlier_probability)
    limit = limit * torch.where(_any_free_by_trial(free), _inflation(distance2, rows), 1.0)[:, None]
    outliers = ((distance2 > 2.0 * limit) & (rows > 0)).any(-1).any(0)
    fits = distance2.sum((0, 2)) < SETTLED_FIT * rows.sum((0, 2))
    return Race(state, noise, cost, front, outliers, fits & (front > 0.9) & sure & ~outliers)


def _sure(H: Float[Tensor, "b p p"]) -> Bool[Tensor, " b"]:
    """Whether the sample alone fixes the rotation to SURE_RAD: then no second minimum fits as well."""
    covariance = torch.linalg.pinv(torch.nan_to_num(H), hermitian=True)
    return covariance[:, :3, :3].diagonal(dim1=-2, dim2=-1).sum(-1) < SURE_RAD**2


def _inflation(distance2: Tensor, rows: Tensor) -> Float[Tensor, " b"]:
    """How many times larger than assumed the variance must be for the median distance; at least 1."""
    ratio = torch.where(rows > 0, distance2 / chi2_quantile(rows, 0.5), torch.nan)
    return ratio.movedim(1, 0).flatten(1).nanmedian(1).values.clamp_min(1.0).nan_to_num(nan=1.0)


def _inflated(assumed: NoiseModel, free: dict[str, Tensor], distance2: Tensor, rows: Tensor) -> NoiseModel:
    """Noise levels that are to be estimated, raised to explain the median distance."""
    factor = _inflation(distance2, rows)
    raised = {
        name: torch.where(value, getattr(assumed, name) * factor, getattr(assumed, name))
        for name, value in free.items()
    }
    return replace(assumed, **raised)


def any_free(free: dict[str, Tensor]) -> bool:
    """Whether any noise level of any trial is to be estimated."""
    return bool(_any_free_by_trial(free).any())


def _any_free_by_trial(free: dict[str, Tensor]) -> Bool[Tensor, " b"]:
    return torch.stack(list(free.values())).any(0)
