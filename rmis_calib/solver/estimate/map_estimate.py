"""The joint estimate: starts compete on a sample, outliers leave, noise levels settle, all motions refine, and the bias
is subtracted."""

from dataclasses import dataclass, replace

import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor

from rmis_calib.errors import InsufficientDataError
from rmis_calib.solver.estimate.bias import expected_score
from rmis_calib.solver.estimate.end_places import with_places
from rmis_calib.solver.estimate.gauss_newton import Refined, gauss_newton
from rmis_calib.solver.estimate.multistart import cheirality, multistart
from rmis_calib.solver.estimate.noise_levels import assumed_noise
from rmis_calib.solver.estimate.one_step_update import one_step_update
from rmis_calib.solver.estimate.outliers import REJECTED, classify, classify_contaminated
from rmis_calib.solver.estimate.use_of_ends import Settled, Settling
from rmis_calib.solver.model.batched_linalg import rescaled, unit_diagonal
from rmis_calib.solver.model.measurement_rows import MeasurementRows
from rmis_calib.solver.model.motion_covariance import NoiseModel
from rmis_calib.solver.model.normal_equations import Normal, with_prior
from rmis_calib.solver.model.packing import pack
from rmis_calib.solver.model.parameters import NuisancePriors, initial_state
from rmis_calib.solver.model.state import State
from rmis_calib.solver.model.weighted_model import WeightedModel
from rmis_calib.solver.problem import Problem
from rmis_calib.solver.settings import SolverSettings

LONG = 32768
"""Motions of a single recording from which a sample is solved to the end and all motions then give one step..."""
LONG_SAMPLE = 8192
"""...from this many: the step is a few of its standard errors, and what is left after it is below a thousandth of
one."""
MAX_PASSES = 12
MOSTLY_PRIOR = 0.9
"""Share of a direction's information from which it is the prior's: a bias there is not corrected."""
INFORMATION_FLOOR = 0.05
"""Least part of the raw information that the bias correction leaves in any direction. Where it would leave less, nearly
all the information is noise in the Jacobian; sigma is then reported at least 4.5 times the raw one, which no verdict
accepts."""


@dataclass(frozen=True)
class MapEstimate:
    """Estimate of a flat batch, before it is put into words.

    Attributes:
        problem: what was solved.
        model: measurements, parameters, noise levels and weights (1, or nearly 0 for what was rejected).
        state: every unknown.
        covariance, information: of every parameter, priors included.
        chi2, rows: weighted squared residuals with priors, and the number of measured rows.
        distance2: r^T S^-1 r of each motion.
        status, steps: of the refinement.
        cheirality: part of the measurements that lie in front of their camera, with the tip on the imaged side.
        bias: what was subtracted from every parameter.
        history: cost of accepted iterates.
    """

    problem: Problem
    model: WeightedModel
    state: State
    covariance: Float[Tensor, "b p p"]
    information: Float[Tensor, "b p p"]
    chi2: Float[Tensor, " b"]
    rows: Float[Tensor, " b"]
    distance2: Float[Tensor, "b n"]
    status: Int[Tensor, " b"]
    steps: Int[Tensor, " b"]
    cheirality: Float[Tensor, " b"]
    bias: Float[Tensor, "b p"]
    history: tuple[Tensor, ...]

    @property
    def weight(self) -> Float[Tensor, "c b n"]:
        """Of each camera's measurements of a motion."""
        return _weights(self.model)


def map_estimate(problem: Problem, settings: SolverSettings, start: "MapEstimate | None" = None) -> MapEstimate:
    """Joint estimate of a problem with one trial axis: the maximum of the posterior of all unknowns.

    Args:
        problem: motions and measurements.
        settings: everything else.
        start: an estimate nearby, which takes the place of the competition of starts.

    Raises:
        InsufficientDataError: fewer measured rows than unknowns in some trial.
    """
    measured = replace(pack(problem, settings.noise), autograd=settings.derivatives == "autograd")
    assumed, free = assumed_noise(problem, settings.noise)
    order = motion_order(measured, settings.seed)
    if measured.trials == 1 and measured.motions > LONG and start is None:
        first = map_estimate(problem.select_motions(order[:LONG_SAMPLE]), replace(settings, bias_correction=False))
        model = replace(first.model, measured=_with_same_places(measured, first, assumed), weight=None)
        refined, weight = one_step_update(model, first.state, settings, first.covariance)
        if refined is not None:
            return _finish(problem, replace(model, weight=weight), refined, settings)
    if start is None:
        state, noise, contaminated = multistart(problem, measured, order, assumed, free, settings)
        used = with_places(measured, state, assumed)
    else:
        state, noise, contaminated = start.state, start.model.noise, (start.weight < REJECTED).any(-1).any(0)
        used = measured.with_ends_of(start.model.measured)
        fresh = initial_state(NuisancePriors.of(problem), state.R, state.t)
        # What the kinematics were evaluated at anew starts from zero, all else from where it was.
        state = replace(state, joint_offset=fresh.joint_offset, clock=fresh.clock, setup=fresh.setup)
    _check_rows(used)
    settling = Settling(problem, measured, order, contaminated, assumed, free, settings)
    fit = settling.settled(used, state, noise, start is None)
    if start is None:
        fit = settling.best_use_of_ends(Settled(used, state, noise), fit)
    model, state = settling.model(fit.measured, fit.noise), fit.state
    refined, weight = _refine_all(model, state, contaminated | (settings.robust == "on"), settings)
    return _finish(problem, replace(model, weight=weight), refined, settings)


def _with_same_places(measured: MeasurementRows, sample: MapEstimate, assumed: NoiseModel) -> MeasurementRows:
    """All motions with their ends at the places that the estimate of a sample knows."""
    if not sample.model.measured.has_ends:
        return measured.without_ends()
    found = with_places(measured, sample.state, assumed)
    if "end_gap" in sample.model.layout.blocks:
        return found
    second = found.end_second > 0
    return replace(found, end_ok=found.end_ok & ~second, end_second=torch.zeros_like(found.end_second))


def motion_order(measured: MeasurementRows, seed: int) -> Int[Tensor, " n"]:
    """Order in which motions are drawn into samples."""
    generator = torch.Generator().manual_seed(seed)
    return torch.randperm(measured.motions, generator=generator).to(measured.p.device)


def _refine_all(
    model: WeightedModel, state: State, contaminated: Bool[Tensor, " b"], settings: SolverSettings
) -> tuple[Refined, Float[Tensor, "c b n"] | None]:
    """Estimate from all motions, and the weights where something was rejected."""
    probability, tolerance = settings.outlier_probability, settings.tolerance_sigma
    weight = classify_contaminated(model, state, contaminated, probability)
    refined = gauss_newton(replace(model, weight=weight), state, tolerance, MAX_PASSES)
    if settings.robust == "off":
        return refined, None
    suspicious = refined.normal.distance2 if weight is None else None
    again = classify(model, refined.state, probability, suspicious)
    changed = (again < REJECTED if weight is None else again != weight).any(-1).any(0)
    if bool(changed.any()):
        weight = again
        second = gauss_newton(replace(model, weight=weight), refined.state, tolerance, MAX_PASSES)
        refined = second.where(changed, refined)
    return refined, weight


def _finish(problem: Problem, model: WeightedModel, refined: Refined, settings: SolverSettings) -> MapEstimate:
    """Bias correction, covariance, and what every motion contributed."""
    state, normal = refined.state, refined.normal
    bias = torch.zeros_like(normal.g)
    information = normal.H
    if settings.bias_correction:
        state, information, bias = debias(model, state, normal, settings)
    scaled, scale = unit_diagonal(information)
    scaled = torch.nan_to_num(scaled, posinf=0.0, neginf=0.0)
    sample = slice(None, None, max(1, model.measured.motions // LONG_SAMPLE))
    used = _weights(model)[..., sample] > REJECTED
    return MapEstimate(
        problem=problem,
        model=model,
        state=state,
        covariance=rescaled(torch.linalg.pinv(scaled, hermitian=True, rtol=1e-15), scale),
        information=information,
        chi2=normal.chi2,
        rows=normal.rows,
        distance2=normal.distance2,
        status=refined.status,
        steps=refined.steps,
        cheirality=cheirality(model.measured.narrow(slice(None), sample), state, used),
        bias=bias,
        history=refined.history,
    )


def debias(
    model: WeightedModel, state: State, normal: Normal, settings: SolverSettings
) -> tuple[State, Float[Tensor, "b p p"], Float[Tensor, "b p"]]:
    """State without its bias, information without that of noise in the Jacobian (bias.py), and the bias.

    Args:
        normal: the normal equations of the state, with priors.
    """
    expected = expected_score(model, state, settings.bias_motions, settings.seed)
    prior = with_prior(replace(normal, H=torch.zeros_like(normal.H)), model.layout, state).H
    delta = _seen_step(normal.H, prior, normal.g - expected.g)
    information = floored_information(normal.H - prior, expected.H, prior) + prior
    return state.moved(model.layout.step(delta)), information, -delta


def _weights(model: WeightedModel) -> Float[Tensor, "c b n"]:
    everything = torch.ones_like(model.measured.line_ok[0], dtype=model.measured.p.dtype)
    return everything if model.weight is None else model.weight


def _seen_step(
    H: Float[Tensor, "b p p"], prior: Float[Tensor, "b p p"], g: Float[Tensor, "b p"]
) -> Float[Tensor, "b p"]:
    """-H^-1 g without the directions in which the data add nothing to the prior: there a simulated score is
    rounding. Which these are is held where autograd looks on."""
    with torch.no_grad():
        scaled, scale = unit_diagonal(H)
        values, vectors = torch.linalg.eigh(torch.nan_to_num(scaled))
        from_prior = ((vectors.mT @ rescaled(prior, scale)) * vectors.mT).sum(-1)
        seen = from_prior < MOSTLY_PRIOR * values
    if H.requires_grad:
        solved = torch.linalg.solve_ex(rescaled(H, scale), (g * scale)[..., None]).result
        along = vectors.mT @ solved
        return -scale * (vectors @ torch.where(seen[..., None], along, 0.0))[..., 0]
    along = (vectors.mT @ (torch.nan_to_num(g) * scale)[..., None])[..., 0]
    along = torch.where(seen, along / values, 0.0)
    return -scale * (vectors @ along[..., None])[..., 0]


def floored_information(
    H: Float[Tensor, "b p p"], expected: Float[Tensor, "b p p"], prior: Float[Tensor, "b p p"]
) -> Float[Tensor, "b p p"]:
    """2 H - E[H], at least INFORMATION_FLOOR of H in every direction.

    Noise in the Jacobian inflates H; simulating at the estimate inflates it once more by the same amount (bias.py).

    Args:
        H: of the data.
        expected: E[H] of the data.
        prior: sets the scale of an unknown of which the data know nothing, where H is rounding.
    """
    free = 2.0 * H - expected if H.requires_grad else None  # its derivative is that of what no floor touches
    H, expected, prior = H.detach(), expected.detach(), prior.detach()
    _, scale = unit_diagonal(H + prior)
    values, vectors = torch.linalg.eigh(torch.nan_to_num(rescaled(H, scale)))
    root = vectors * values.clamp_min(1e-14).rsqrt()[:, None] @ vectors.mT
    excess = root @ rescaled(expected - H, scale) @ root
    part, turn = torch.linalg.eigh(torch.nan_to_num(0.5 * (excess + excess.mT)))
    kept = (1.0 - part).clamp(INFORMATION_FLOOR, 1.0 / INFORMATION_FLOOR)
    half = vectors * values.clamp_min(0.0).sqrt()[:, None] @ vectors.mT
    corrected = half @ (turn * kept[:, None] @ turn.mT) @ half
    corrected = rescaled(corrected, scale.reciprocal())
    return corrected if free is None else corrected + (free - free.detach())


def _check_rows(measured: MeasurementRows) -> None:
    count = measured.rows_ok.sum((0, 2))
    if bool((count < 6).any()):
        raise InsufficientDataError(
            where="measurements",
            expected="at least 6 measured rows (3 lines or head points)",
            found=int(count.min()),
        )
