"""The joint estimate: starts compete on a sample, outliers leave, noise levels settle, all motions refine, and the bias
is subtracted."""

from dataclasses import dataclass, replace

import torch
from jaxtyping import Float, Int
from torch import Tensor

from rmis_calib.errors import InsufficientDataError
from rmis_calib.solver.estimate.bias import expected_score
from rmis_calib.solver.estimate.gauss_newton import Refined, gauss_newton
from rmis_calib.solver.estimate.multistart import any_free, cheirality, multistart
from rmis_calib.solver.estimate.noise_levels import assumed_noise, estimate_components
from rmis_calib.solver.estimate.one_step_update import one_step_update
from rmis_calib.solver.estimate.outliers import REJECTED, anneal, classify
from rmis_calib.solver.model.measurement_rows import MeasurementRows, pack
from rmis_calib.solver.model.normal_equations import NoiseModel, with_prior
from rmis_calib.solver.model.parameters import NuisancePriors, ParameterLayout, initial_state, make_layout
from rmis_calib.solver.model.residuals import State
from rmis_calib.solver.problem import Problem
from rmis_calib.solver.settings import SolverSettings

SAMPLE_MOTIONS = 512
"""Motions on which outliers are annealed and noise levels estimated; all motions are classified afterwards."""
LONG = 32768
"""Motions of a single recording from which a sample is solved to the end and all motions then give one step..."""
LONG_SAMPLE = 8192
"""...from this many: the step is a few of its standard errors, and what is left after it is below a thousandth of
one."""
NOISE_ROUNDS = 2
MAX_PASSES = 12
MOSTLY_PRIOR = 0.9
"""Share of a direction's information from which it is the prior's: a bias there is not corrected."""
INFORMATION_FLOOR = 0.05
"""Least part of the raw information that the bias correction leaves in any direction. Where it would leave less, nearly
all the information is noise in the Jacobian; sigma is then reported at least 4.5 times the raw one, which no verdict
accepts."""


@dataclass(frozen=True)
class JointFit:
    """Estimate of a flat batch, before it is put into words."""

    problem: Problem
    packed: MeasurementRows
    state: State
    layout: ParameterLayout
    noise: NoiseModel
    covariance: Float[Tensor, "b p p"]
    information: Float[Tensor, "b p p"]
    chi2: Float[Tensor, " b"]
    rows: Float[Tensor, " b"]
    weight: Float[Tensor, "c b n"]
    distance2: Float[Tensor, "b n"]
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
    long = packed.trials == 1 and packed.motions > LONG and start is None
    if long:
        first = solve_joint(problem.select_motions(order[:LONG_SAMPLE]), replace(settings, bias_correction=False))
        state, noise, layout = first.state, first.noise, first.layout
        refined, weight = one_step_update(packed, state, layout, noise, settings, first.covariance)
        if refined is not None:
            return _finish(problem, packed, refined, layout, noise, weight, settings)
    if start is None:
        state, noise, contaminated = multistart(problem, packed, order, assumed, free, settings)
    else:
        state, noise, contaminated = start.state, start.noise, bool((start.weight < REJECTED).any())
    nominal = NuisancePriors.of(problem)
    fresh = initial_state(nominal, state.R, state.t)
    layout = make_layout(nominal, packed, fresh, settings.unknowns, settings.noise)
    state = fresh if start is not None else state
    _check_rows(packed)
    state, noise = _settle_noise(packed, state, layout, noise, order, contaminated, assumed, free, settings)
    refined, weight = _refine_all(packed, state, layout, noise, contaminated or settings.robust == "on", settings)
    return _finish(problem, packed, refined, layout, noise, weight, settings)


def _settle_noise(
    packed: MeasurementRows,
    state: State,
    layout: ParameterLayout,
    noise: NoiseModel,
    order: Tensor,
    contaminated: bool,
    assumed: NoiseModel,
    free: dict[str, Tensor],
    settings: SolverSettings,
) -> tuple[State, NoiseModel]:
    """Outliers annealed away and noise levels estimated on a sample."""
    sample = packed.take_motions(order[:SAMPLE_MOTIONS]) if packed.motions > SAMPLE_MOTIONS else packed
    if contaminated:
        state, _ = anneal(sample, state, layout, noise, settings.outlier_probability)
    for _ in range(NOISE_ROUNDS if any_free(free) else 0):
        weight = classify(sample, state, noise, settings.outlier_probability, settings.chunk) if contaminated else None
        noise = estimate_components(sample, state, layout, noise, assumed, free, settings.noise, weight)
        state = gauss_newton(sample, state, layout, noise, 0.1, 4, settings.chunk, weight).state
    return state, noise


def _refine_all(
    packed: MeasurementRows,
    state: State,
    layout: ParameterLayout,
    noise: NoiseModel,
    contaminated: bool,
    settings: SolverSettings,
) -> tuple[Refined, Float[Tensor, "c b n"] | None]:
    """Estimate from all motions, and the weights where something was rejected."""
    probability, chunk = settings.outlier_probability, settings.chunk
    weight = classify(packed, state, noise, probability, chunk) if contaminated else None
    refined = gauss_newton(packed, state, layout, noise, settings.tolerance_sigma, MAX_PASSES, chunk, weight)
    if settings.robust == "off":
        return refined, None
    suspicious = refined.normal.distance2 if weight is None else None
    again = classify(packed, refined.state, noise, probability, chunk, suspicious)
    changed = bool((again < REJECTED).any()) if weight is None else not torch.equal(again, weight)
    if changed:
        weight = again
        refined = gauss_newton(
            packed, refined.state, layout, noise, settings.tolerance_sigma, MAX_PASSES, chunk, weight
        )
    return refined, weight


def _finish(
    problem: Problem,
    packed: MeasurementRows,
    refined: Refined,
    layout: ParameterLayout,
    noise: NoiseModel,
    weight: Float[Tensor, "c b n"] | None,
    settings: SolverSettings,
) -> JointFit:
    """Bias correction, covariance, and what every motion contributed."""
    state, normal = refined.state, refined.normal
    bias = torch.zeros_like(normal.g)
    information = normal.H
    if settings.bias_correction:
        expected = expected_score(
            packed, state, layout, noise, settings.bias_motions, settings.chunk, settings.seed, weight
        )
        prior = with_prior(replace(normal, H=torch.zeros_like(normal.H)), layout, state).H
        delta = _seen_step(normal.H, prior, normal.g - expected.g)
        state, bias = state.moved(layout.step(delta)), -delta
        information = floored_information(normal.H - prior, expected.H, prior) + prior
    sample = slice(None, None, max(1, packed.motions // LONG_SAMPLE))
    weight_all = torch.ones_like(packed.line_ok[0], dtype=packed.p.dtype) if weight is None else weight
    scale = information.diagonal(dim1=-2, dim2=-1).clamp_min(1e-300).rsqrt()
    scaled = torch.nan_to_num(information * scale[:, :, None] * scale[:, None], posinf=0.0, neginf=0.0)
    inverse = torch.linalg.pinv(scaled, hermitian=True, rtol=1e-15)
    covariance = inverse * scale[:, :, None] * scale[:, None]
    return JointFit(
        problem=problem,
        packed=packed,
        state=state,
        layout=layout,
        noise=noise,
        covariance=covariance,
        information=information,
        chi2=normal.chi2,
        rows=normal.rows,
        weight=weight_all,
        distance2=normal.distance2,
        status=refined.status,
        steps=refined.steps,
        cheirality=cheirality(packed.narrow(slice(None), sample), state, weight_all[..., sample] > REJECTED),
        bias=bias,
        history=refined.history,
    )


def _seen_step(
    H: Float[Tensor, "b p p"], prior: Float[Tensor, "b p p"], g: Float[Tensor, "b p"]
) -> Float[Tensor, "b p"]:
    """-H^-1 g without the directions in which the data add nothing to the prior: there a simulated score is
    rounding."""
    scale = H.diagonal(dim1=-2, dim2=-1).clamp_min(1e-300).rsqrt()
    both = scale[:, :, None] * scale[:, None]
    values, vectors = torch.linalg.eigh(torch.nan_to_num(H * both))
    from_prior = ((vectors.mT @ (prior * both)) * vectors.mT).sum(-1)
    along = (vectors.mT @ (torch.nan_to_num(g) * scale)[..., None])[..., 0]
    along = torch.where(from_prior < MOSTLY_PRIOR * values, along / values, 0.0)
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
    scale = (H + prior).diagonal(dim1=-2, dim2=-1).clamp_min(1e-300).rsqrt()
    unit = H * scale[:, :, None] * scale[:, None]
    values, vectors = torch.linalg.eigh(torch.nan_to_num(unit))
    root = vectors * values.clamp_min(1e-14).rsqrt()[:, None] @ vectors.mT
    excess = root @ ((expected - H) * scale[:, :, None] * scale[:, None]) @ root
    part, turn = torch.linalg.eigh(torch.nan_to_num(0.5 * (excess + excess.mT)))
    kept = (1.0 - part).clamp(INFORMATION_FLOOR, 1.0 / INFORMATION_FLOOR)
    half = vectors * values.clamp_min(0.0).sqrt()[:, None] @ vectors.mT
    corrected = half @ (turn * kept[:, None] @ turn.mT) @ half
    return corrected / (scale[:, :, None] * scale[:, None])


def _check_rows(packed: MeasurementRows) -> None:
    measured = packed.rows_ok.sum((0, 2))
    if bool((measured < 6).any()):
        raise InsufficientDataError(
            where="measurements",
            expected="at least 6 measured rows (3 lines or head points)",
            found=int(measured.min()),
        )
