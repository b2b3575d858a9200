"""The joint estimate: starts compete on a sample, outliers leave, noise levels settle, all motions refine, the bias is subtracted."""

from dataclasses import dataclass, replace

import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor

from rmis_calib.errors import InsufficientDataError
from rmis_calib.solver.bias import expected_score
from rmis_calib.solver.initialise import contour_starts, find_candidates
from rmis_calib.solver.measurements import Packed, pack
from rmis_calib.solver.normal import NoiseModel, camera_distance2, with_prior
from rmis_calib.solver.problem import Problem
from rmis_calib.solver.refine import Refined, levenberg_marquardt, polish
from rmis_calib.solver.residuals import State, predict_shaft
from rmis_calib.solver.robust import anneal, chi2_quantile, inlier_weight, truncated_cost
from rmis_calib.solver.robust_start import robust_candidates
from rmis_calib.solver.settings import SolverSettings
from rmis_calib.solver.statistics import LineStatistics
from rmis_calib.solver.systematic import systematic_covariance
from rmis_calib.solver.unknowns import Layout, Nominal, initial_state, make_layout
from rmis_calib.solver.variance import assumed_noise, estimate_components

START_ITERATIONS = 12
START_TOLERANCE = 0.1
"""Starts are compared, not reported: a tenth of a standard error of the sample is enough."""
COMPETING_MINIMA = 4
SETTLED_FIT = 1.5
"""Chi^2 per row up to which the first start needs no competition..."""
SURE_RAD = 0.02
"""...if its own sample fixes the rotation this well (1.1 degrees)."""
SAMPLE_MOTIONS = 512
"""Motions on which outliers are annealed and noise levels estimated; all motions are classified afterwards."""
NOISE_ROUNDS = 2
MAX_PASSES = 12
MOSTLY_PRIOR = 0.9
"""Share of a direction's information from which it is the prior's: a bias there is not corrected."""
INFORMATION_FLOOR = 0.05
"""Least part of the raw information that the bias correction leaves in any direction. Where it would leave less, nearly all the information is noise in
the Jacobian; sigma is then reported at least 4.5 times the raw one, which no verdict accepts."""


@dataclass(frozen=True)
class JointFit:
    """Estimate of a flat batch, before it is put into words."""

    problem: Problem
    packed: Packed
    state: State
    layout: Layout
    noise: NoiseModel
    covariance: Float[Tensor, "b p p"]
    chi2: Float[Tensor, " b"]
    rows: Float[Tensor, " b"]
    weight: Float[Tensor, "c b n"]
    distance2: Float[Tensor, "c b n"]
    status: Int[Tensor, " b"]
    steps: Int[Tensor, " b"]
    cheirality: Float[Tensor, " b"]
    bias: Float[Tensor, "b p"]
    history: tuple[Tensor, ...]


def solve_joint(problem: Problem, settings: SolverSettings, start: "JointFit | None" = None) -> JointFit:
    """Joint estimate of a problem with one trial axis.

    Args:
        problem: motions and measurements.
        settings: everything else.
        start: an estimate nearby, which takes the place of the competition of starts.

    Raises:
        InsufficientDataError: fewer measured rows than unknowns in some trial.
    """
    packed = pack(problem, settings.noise)
    assumed, free = assumed_noise(problem, settings.noise)
    generator = torch.Generator().manual_seed(settings.seed)
    order = torch.randperm(packed.motions, generator=generator).to(packed.p.device)
    if start is None:
        state, noise, contaminated = _compete(problem, packed, order, assumed, free, settings)
    else:
        state, noise, contaminated = start.state, start.noise, False
    nominal = Nominal.of(problem)
    fresh = initial_state(nominal, state.R, state.t)
    layout = make_layout(nominal, packed, fresh, settings.unknowns, settings.noise)
    state = fresh if start is not None else state
    _check_rows(packed, layout)
    sample = packed.take_motions(order[:SAMPLE_MOTIONS]) if packed.motions > SAMPLE_MOTIONS else packed
    weight = None
    if contaminated:
        state, sample_weight = anneal(sample, state, layout, noise, settings.outlier_probability)
    for _ in range(NOISE_ROUNDS if _any(free) else 0):
        sample_weight = _classify(sample, state, noise, settings.outlier_probability) if contaminated else None
        noise = estimate_components(sample, state, layout, noise, assumed, free, settings.noise, sample_weight)
        state = polish(sample, state, layout, noise, 0.1, 4, settings.chunk, sample_weight).state
    if contaminated or settings.robust == "on":
        weight = _classify(packed, state, noise, settings.outlier_probability)
    refined = polish(packed, state, layout, noise, settings.tolerance_sigma, MAX_PASSES, settings.chunk, weight)
    distance2, rows = _distances(packed, refined.state, noise, settings.chunk)
    if settings.robust != "off" and bool((distance2 > chi2_quantile(rows, settings.outlier_probability)).any()):
        weight = inlier_weight(distance2, rows, settings.outlier_probability)
        refined = polish(packed, refined.state, layout, noise, settings.tolerance_sigma, MAX_PASSES, settings.chunk, weight)
    return _finish(problem, packed, refined, layout, noise, weight, distance2, settings)


def _finish(
    problem: Problem, packed: Packed, refined: Refined, layout: Layout, noise: NoiseModel, weight: Tensor | None, distance2: Tensor, settings: SolverSettings
) -> JointFit:
    """Bias correction, covariance, and what every motion contributed."""
    state, normal = refined.state, refined.normal
    bias = torch.zeros_like(normal.g)
    information = normal.H
    if settings.bias_correction:
        expected = expected_score(packed, state, layout, noise, settings.bias_motions, settings.chunk, settings.seed, weight)
        prior = with_prior(replace(normal, H=torch.zeros_like(normal.H)), layout, state).H
        delta = _seen_step(normal.H, prior, normal.g - expected.g)
        state, bias = state.moved(layout.step(delta)), -delta
        information = floored_information(normal.H - prior, expected.H) + prior
    weight_all = torch.ones_like(packed.line_ok[0], dtype=packed.p.dtype) if weight is None else weight
    scale = information.diagonal(dim1=-2, dim2=-1).clamp_min(1e-300).rsqrt()
    scaled = torch.nan_to_num(information * scale[:, :, None] * scale[:, None], posinf=0.0, neginf=0.0)
    inverse = torch.linalg.pinv(scaled, hermitian=True, rtol=1e-15)
    covariance = inverse * scale[:, :, None] * scale[:, None]
    if bool((problem.noise.edge_bias > 0).any()):
        covariance = covariance + systematic_covariance(
            packed, state, layout, noise, covariance, problem.noise.edge_bias, settings.chunk, weight
        )
    return JointFit(
        problem=problem,
        packed=packed,
        state=state,
        layout=layout,
        noise=noise,
        covariance=covariance,
        chi2=normal.chi2,
        rows=normal.rows,
        weight=weight_all,
        distance2=distance2,
        status=refined.status,
        steps=refined.steps,
        cheirality=cheirality(packed, state, weight_all > 0.5),
        bias=bias,
        history=refined.history,
    )


def _seen_step(H: Float[Tensor, "b p p"], prior: Float[Tensor, "b p p"], g: Float[Tensor, "b p"]) -> Float[Tensor, "b p"]:
    """-H^-1 g without the directions in which the data add nothing to the prior: there a simulated score is rounding."""
    scale = H.diagonal(dim1=-2, dim2=-1).clamp_min(1e-300).rsqrt()
    both = scale[:, :, None] * scale[:, None]
    values, vectors = torch.linalg.eigh(torch.nan_to_num(H * both))
    from_prior = ((vectors.mT @ (prior * both)) * vectors.mT).sum(-1)
    along = (vectors.mT @ (torch.nan_to_num(g) * scale)[..., None])[..., 0]
    along = torch.where(from_prior < MOSTLY_PRIOR * values, along / values, 0.0)
    return -scale * (vectors @ along[..., None])[..., 0]


def floored_information(H: Float[Tensor, "b p p"], expected: Float[Tensor, "b p p"]) -> Float[Tensor, "b p p"]:
    """2 H - E[H], at least INFORMATION_FLOOR of H in every direction.

    Noise in the Jacobian inflates H; simulating at the estimate inflates it once more by the same amount (bias.py).
    """
    scale = H.diagonal(dim1=-2, dim2=-1).clamp_min(1e-300).rsqrt()
    unit = H * scale[:, :, None] * scale[:, None]
    values, vectors = torch.linalg.eigh(torch.nan_to_num(unit))
    root = vectors * values.clamp_min(1e-14).rsqrt()[:, None] @ vectors.mT
    excess = root @ ((expected - H) * scale[:, :, None] * scale[:, None]) @ root
    part, turn = torch.linalg.eigh(torch.nan_to_num(0.5 * (excess + excess.mT)))
    kept = (1.0 - part).clamp(INFORMATION_FLOOR, 1.0 / INFORMATION_FLOOR)
    half = vectors * values.clamp_min(0.0).sqrt()[:, None] @ vectors.mT
    corrected = half @ (turn * kept[:, None] @ turn.mT) @ half
    return corrected / (scale[:, :, None] * scale[:, None])


def cheirality(packed: Packed, state: State, used: Bool[Tensor, "c b n"]) -> Float[Tensor, " b"]:
    """Part of the used lines with the visible shaft in front of the camera and running to the tip as in the picture."""
    shaft = predict_shaft(packed, state)
    x0, y0 = packed.line_xy[:, 0]
    x1, y1 = packed.line_xy[:, 1]
    turn = (y0 - y1) * shaft.m[0] + (x1 - x0) * shaft.m[1] + (x0 * y1 - y0 * x1) * shaft.m[2]
    depth = (x0 + x1) * shaft.u[0] + (y0 + y1) * shaft.u[1] + 2.0 * shaft.u[2]
    ok = packed.line_ok[0] & used
    return ((turn > 0) & (depth > 0) & ok).sum((0, 2)) / ok.sum((0, 2)).clamp_min(1)


def _compete(
    problem: Problem, packed: Packed, order: Tensor, assumed: NoiseModel, free: dict[str, Tensor], settings: SolverSettings
) -> tuple[State, NoiseModel, bool]:
    """The best start after a short refinement on a sample, noise inflated to what it explains, and whether there are outliers."""
    index = order[: settings.start_motions]
    sample = packed.take_motions(index)
    R, t = _starts(problem, packed, settings)
    first = _race(problem, sample, R[:, :1], t[:, :1], assumed, free, settings, robust=False)
    if first.settled:
        return first.state, first.noise, False
    race = _race(problem, sample, R, t, assumed, free, settings, robust=False)
    state, noise = race.state, race.noise
    # A poor fit hides outliers where the noise levels are to be estimated: they are raised until it looks good.
    suspect = race.outliers or settings.robust == "on" or (_any(free) and not race.settled)
    if settings.robust == "off" or not suspect:
        return state, noise, False
    sub = problem.select_motions(index)
    candidates = robust_candidates(sub, settings.grid, COMPETING_MINIMA)
    starts_R, starts_t = [state.R[:, None], candidates.R], [state.t[:, None], candidates.t]
    if packed.has_contours:
        R, t = contour_starts(sample, torch.nan_to_num(problem.radius_mm), reweightings=10)
        starts_R, starts_t = [*starts_R, R], [*starts_t, t]
    race = _race(problem, sample, torch.cat(starts_R, 1), torch.cat(starts_t, 1), assumed, free, settings, robust=True)
    return race.state, race.noise, True


@dataclass(frozen=True)
class _Race:
    """Winner of a race of starts: state and noise levels per trial; whether any trial has outliers; whether no other start needs to be tried."""

    state: State
    noise: NoiseModel
    outliers: bool
    settled: bool


def _starts(problem: Problem, packed: Packed, settings: SolverSettings) -> tuple[Float[Tensor, "b s 3 3"], Float[Tensor, "b s 3"]]:
    """Minima of the axis planes, and starts from contours and ends."""
    candidates = find_candidates(LineStatistics.from_problem(problem), settings.grid, settings.minima)
    chosen = candidates.order()[:, :COMPETING_MINIMA]
    rows = torch.arange(chosen.shape[0], device=chosen.device)[:, None]
    R, t = candidates.R[rows, chosen], candidates.t[rows, chosen]
    if packed.has_contours:
        more_R, more_t = contour_starts(packed, torch.nan_to_num(problem.radius_mm))
        R, t = torch.cat((R, more_R), dim=1), torch.cat((t, more_t), dim=1)
    return R, t


def _race(
    problem: Problem,
    sample: Packed,
    R: Float[Tensor, "b s 3 3"],
    t: Float[Tensor, "b s 3"],
    assumed: NoiseModel,
    free: dict[str, Tensor],
    settings: SolverSettings,
    robust: bool,
) -> _Race:
    """Refines every start on the sample and keeps, per trial, the one of least truncated cost among those in front of the camera."""
    b, s = R.shape[:2]
    nominal = Nominal.of(problem)
    states, kept = [], []
    step = max(1, settings.chunk // (s * sample.motions))
    for start in range(0, b, step):
        part = slice(start, min(start + step, b))
        many = sample.narrow(part, slice(None)).repeat_trials(s)
        noise = assumed.take(part).repeat(s)
        narrowed = nominal.repeat(part, s)
        state = initial_state(narrowed, R[part].flatten(0, 1), t[part].flatten(0, 1))
        layout = make_layout(narrowed, many, state, settings.unknowns, settings.noise)
        if robust:
            state, weight = anneal(many, state, layout, noise, settings.outlier_probability, steps=12)
            refined = levenberg_marquardt(many, state, layout, noise, START_TOLERANCE, 3, weight)
        else:
            refined = levenberg_marquardt(many, state, layout, noise, START_TOLERANCE, START_ITERATIONS)
        distance2, rows = camera_distance2(many, refined.state, noise)
        cost = truncated_cost(distance2, rows, settings.outlier_probability if robust else 1e-12)
        front = cheirality(many, refined.state, torch.ones_like(distance2, dtype=torch.bool)).view(-1, s)
        enough = front >= 0.9 * front.amax(1, keepdim=True)
        best = (torch.nan_to_num(cost.view(-1, s), nan=1e29) + torch.where(enough, 0.0, 1e30)).argmin(1)
        flat = best + s * torch.arange(best.shape[0], device=best.device)
        states.append(refined.state.take(flat))
        kept.append((distance2[:, flat], rows[:, flat], front.flatten()[flat], _sure(refined.normal.H[flat])))
    state = State(**{name: torch.cat([getattr(part, name) for part in states]) for name in vars(states[0])})
    distance2, rows = (torch.cat([part[i] for part in kept], dim=1) for i in (0, 1))
    front, sure = (torch.cat([part[i] for part in kept]) for i in (2, 3))
    noise = _inflated(assumed, free, distance2, rows)
    limit = chi2_quantile(rows, settings.outlier_probability)
    if _any(free):
        limit = limit * _inflation(distance2, rows)[:, None]
    outliers = bool(((distance2 > 2.0 * limit) & (rows > 0)).any())
    fits = distance2.sum((0, 2)) < SETTLED_FIT * rows.sum((0, 2))
    return _Race(state, noise, outliers, bool((fits & (front > 0.9) & sure).all()) and not outliers)


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
    raised = {name: torch.where(value, getattr(assumed, name) * factor, getattr(assumed, name)) for name, value in free.items()}
    return replace(assumed, **raised)


def _any(free: dict[str, Tensor]) -> bool:
    return any(bool(value.any()) for value in free.values())


def _distances(packed: Packed, state: State, noise: NoiseModel, chunk: int) -> tuple[Tensor, Tensor]:
    """`camera_distance2` of any number of motions, chunk by chunk."""
    step_n = min(packed.motions, chunk)
    step_b = max(1, chunk // step_n)
    by_trial = []
    for b in range(0, packed.trials, step_b):
        bs = slice(b, min(b + step_b, packed.trials))
        parts = [
            camera_distance2(packed.narrow(bs, slice(n, n + step_n)), state.take(bs), noise.take(bs))
            for n in range(0, packed.motions, step_n)
        ]
        by_trial.append([torch.cat([part[i] for part in parts], dim=2) for i in range(2)])
    return torch.cat([part[0] for part in by_trial], dim=1), torch.cat([part[1] for part in by_trial], dim=1)


def _classify(packed: Packed, state: State, noise: NoiseModel, probability: float) -> Tensor:
    return inlier_weight(*_distances(packed, state, noise, 8192), probability)


def _check_rows(packed: Packed, layout: Layout) -> None:
    measured = packed.rows_ok.sum((0, 2))
    if bool((measured < 6).any()):
        raise InsufficientDataError(where="measurements", expected="at least 6 measured rows (3 lines)", found=int(measured.min()))
