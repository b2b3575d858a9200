"""Do the data ask for an unknown that was left out, and what if they cannot tell? One linearised step for each.

**Test.** With u the score of the unknowns that were left out and A their information, both with the other unknowns
eliminated, u^T A^-1 u is chi^2 where all of them are nominal (Rao 1948): no problem is solved again to know. Only
directions that the data see better than the prior count. That takes motions as independent; errors that neighbours
share (an arm that rests, a lens model, an edge detector) make a score too. So where the score is large, groups of
neighbouring motions are left out in turn with the unknown freed, and the score counts in the scatter that these show
(a cluster-robust score test: Cameron & Miller 2015), with the F distribution of its degrees of freedom.

**Doubt.** A test that finds nothing proves little where the data see little: a laparoscope that stands still says
nothing of the set-up at all. There the unknown is considered: it is off by about its prior with a probability that the
data change as far as they see it (Bayesian model averaging: Hoeting et al. 1999), and the covariance allows for that.

Freeing an unknown that is nominal costs sigma, and believing in one that is not costs the truth, so the tests are loose
ones, and the candidate of least chance is freed first.
"""

import math
from dataclasses import dataclass, replace

import torch
from jaxtyping import Float
from scipy.special import fdtrc
from torch import Tensor

from rmis_calib.solver.assess.groups import RIDGE, groups_of
from rmis_calib.solver.assess.information import inverse
from rmis_calib.solver.estimate.bias import expected_score
from rmis_calib.solver.estimate.map_estimate import MapEstimate
from rmis_calib.solver.model.normal_equations import WeightedModel, accumulate, group_sums
from rmis_calib.solver.model.parameters import NuisancePriors, ParameterLayout, make_layout
from rmis_calib.solver.model.state import State
from rmis_calib.solver.problem import stands_still
from rmis_calib.solver.settings import SolverSettings, UnknownSettings

CHANCE = {"clock_rate": 0.005, "setup": 0.02, "compliance": 1e-4}
"""Probability, with everything nominal, from which an unknown is freed: less for what costs more."""
TESTED_MOTIONS = 2048
"""Long recordings are tested on a sample: what needs more motions to show is below the sigmas that matter."""
SCALES = (0.5, 1.0, 2.0)
"""Of how far an unknown may be off, in what is assumed; each as likely."""
SHARED_CENTRE = 2.0
"""How far the principal points of all cameras may be off alike, in the prior of each."""
CENTRE_DOUBT = 0.8
"""Probability, before the data speak, that they are. With one half, 88 % of trials with centres 10 px off (3.3 sigmas
of each) and a still laparoscope are within the 95 % ellipsoid, with this 92 %."""
SEEN = 2.0
"""Information on a direction, in that of the prior, from which it counts."""


@dataclass(frozen=True)
class Evidence:
    """What the data say of unknowns that were left out.

    Attributes:
        chance: by name, the probability of what the data say if it were nominal.
        doubt: by name, what the covariance of the transform, and of the set-up where it is estimated, gains as it may
            not be; as parameters of the estimate.
    """

    chance: dict[str, Float[Tensor, " b"]]
    doubt: dict[str, Float[Tensor, "b m m"]]


@dataclass(frozen=True)
class Freed:
    """An unknown freed in one step: its block of the normal equations, the other unknowns eliminated.

    Attributes:
        A: information of the data.
        u: score.
        effect: of the block on the transform, and on the set-up where it is estimated.
    """

    A: Float[Tensor, "b q q"]
    u: Float[Tensor, "b q"]
    effect: Float[Tensor, "b m q"]


def freed(unknowns: UnknownSettings, name: str) -> UnknownSettings:
    """The settings with a candidate estimated."""
    return replace(unknowns, **{name: "prior" if name == "setup" else "always"})


def weigh(fit: MapEstimate, settings: SolverSettings) -> Evidence:
    """Evidence on the unknowns that are left out and may be estimated (`clock_rate`; `setup`, where the laparoscope's
    own kinematics are told; `compliance`), doubt of the latter two, and of the cameras' principal points, which may all
    be off alike (`centre`)."""
    asked, chance, doubt = settings.unknowns, {}, {}
    if "intrinsics" in fit.model.layout.blocks and asked.doubt > 0.0:
        doubt["centre"] = _doubt_of_centres(fit, CENTRE_DOUBT)
    told = fit.problem.laparoscope_base_T_arm is not None
    if asked.clock_rate == "auto" and "clock" in fit.model.layout.blocks:
        chance["clock_rate"], _ = _weigh(fit, settings, "clock_rate")
    left_out = {"setup": told and asked.setup == "known", "compliance": asked.compliance == "auto"}
    for name in (name for name, is_left_out in left_out.items() if is_left_out):
        chance[name], doubt[name] = _weigh(fit, settings, name)
    return Evidence(chance, doubt)


def reported(layout: ParameterLayout) -> list[int]:
    """Places of the transform, and of the set-up where it is estimated, among the parameters."""
    part = layout.blocks.get("setup", slice(0))
    return [*range(6), *range(part.stop)[part]]


def _doubt_of_centres(fit: MapEstimate, belief: float) -> Float[Tensor, "b m m"]:
    """Doubt of a shift of the principal point that all cameras share (a crop or a zoom that nobody wrote down): as a
    correction of each camera for itself it is priced twice, and to the data it is nearly a turn of the transform."""
    part, H = fit.model.layout.blocks["intrinsics"], fit.information
    sigma = SHARED_CENTRE * fit.problem.noise.centre[:, None].expand(-1, 2).clamp_min(1e-9)
    deviation, weight = fit.model.layout.prior(fit.state)
    shared = torch.zeros_like(H[0, :, :2])
    for axis in (0, 1):
        shared[part.start + 1 + axis : part.stop : 4, axis] = 1.0  # focal length, x, y, lens of each camera
    data = (H - torch.diag_embed(weight)) @ shared
    within = shared.mT @ data + torch.diag_embed(sigma.square().reciprocal())
    freed = torch.cat((torch.cat((H, data), dim=-1), torch.cat((data.mT, within), dim=-1)), dim=-2)
    # At the estimate the score of everything vanishes, so that of the data is the priors' pull.
    g = torch.cat((torch.zeros_like(deviation), -(weight * deviation) @ shared), dim=-1)
    last, rows = slice(H.shape[-1], H.shape[-1] + 2), reported(fit.model.layout)
    block = _eliminated(torch.nan_to_num(freed), torch.nan_to_num(g), sigma, last, rows)
    return _doubt(block, sigma, sigma, torch.ones_like(g[:, 0]), belief)


def _weigh(fit: MapEstimate, settings: SolverSettings, name: str) -> tuple[Float[Tensor, " b"], Float[Tensor, "b m m"]]:
    """Chance and doubt of one candidate."""
    nominal, model, state = NuisancePriors.of(fit.problem), fit.model, fit.state
    layout = make_layout(nominal, model.measured, model.layout.origin, freed(settings.unknowns, name), settings.noise)
    model, part, rows = replace(model, layout=layout), layout.blocks[name], reported(fit.model.layout)
    step = -(-model.measured.motions // TESTED_MOTIONS)
    if step > 1:
        model = model.take_motions(torch.arange(0, model.measured.motions, step, device=state.t.device))
    normal, sigma = accumulate(model, state), layout.sigma[:, part]
    H, g = torch.nan_to_num(normal.H), torch.nan_to_num(normal.g)
    block = _eliminated(H, g, sigma, part, rows)
    chance, inflation = _chance(block), torch.ones_like(block.u[:, 0])
    at = torch.nonzero(chance < CHANCE[name])[:, 0]
    if len(at):
        few, there = model.take_trials(at), state.take(at)
        # Noise in the Jacobian alone makes a score.
        expected = expected_score(few, there, settings.bias_motions, settings.seed)
        corrected = _eliminated(H[at], g[at] - expected.g, sigma[at], part, rows)
        grown, groups = _inflation(few, there, H[at], g[at] - expected.g, part, settings.groups)
        block = Freed(block.A, block.u.index_copy(0, at, corrected.u), block.effect)
        inflation = inflation.index_copy(0, at, grown)
        chance = chance.index_copy(0, at, _chance(corrected, grown, groups))
    if name == "clock_rate":
        return chance, torch.zeros_like(block.effect @ block.effect.mT)
    # A camera that stands still cannot tell a bend of the shaft from an error of the picture, nor see the set-up.
    laparoscope = fit.problem.laparoscope_base_T_arm
    still = torch.ones_like(chance, dtype=torch.bool) if laparoscope is None else stands_still(laparoscope)
    if name == "setup":
        seen = (~still).to(block.A.dtype)
        block = replace(block, A=block.A * seen[:, None, None], u=block.u * seen[:, None])
    considered = _considered(nominal, settings.unknowns, name, sigma)
    doubt = _doubt(block, sigma, considered, inflation, settings.unknowns.doubt)
    return torch.where(still, 1.0, chance), doubt


def _considered(
    nominal: NuisancePriors, asked: UnknownSettings, name: str, sigma: Float[Tensor, "b q"]
) -> Float[Tensor, "b q"]:
    """How far the unknown may be off: of a set-up, what the data state, else what is assumed; zero: it is exact."""
    if name != "setup":
        return sigma
    rad = torch.nan_to_num(nominal.setup_rad, nan=math.radians(asked.setup_doubt_deg))
    mm = torch.nan_to_num(nominal.setup_mm, nan=asked.setup_doubt_mm)
    return torch.stack((rad, rad, rad, mm, mm, mm), dim=-1)


def _eliminated(
    H: Float[Tensor, "b p p"], g: Float[Tensor, "b p"], sigma: Float[Tensor, "b q"], part: slice, rows: list[int]
) -> Freed:
    """The block `part` in units of `sigma`, its prior, which is in H and at zero; without that prior. Effects are on
    the parameters `rows`, which come before it."""
    inside = torch.zeros(H.shape[-1], dtype=torch.bool, device=H.device)
    inside[part] = True
    others = H[:, ~inside][:, :, ~inside]
    size = others.diagonal(dim1=-2, dim2=-1).clamp_min(1e-300).rsqrt()
    eye = torch.eye(H.shape[-1], dtype=H.dtype, device=H.device)
    cross = H[:, ~inside][:, :, inside] * sigma[:, None] * size[..., None]
    right = torch.cat((cross, (g[:, ~inside] * size)[..., None]), dim=-1)
    unit = others * size[:, :, None] * size[:, None] + 1e-12 * eye[~inside][:, ~inside]
    solved = torch.linalg.solve_ex(unit, right).result
    A = H[:, inside][:, :, inside] * sigma[:, :, None] * sigma[:, None] - cross.mT @ solved[..., :-1]
    u = g[:, inside] * sigma - (cross.mT @ solved[..., -1:])[..., 0]
    A = torch.nan_to_num(0.5 * (A + A.mT)) - eye[inside][:, inside]
    return Freed(A, torch.nan_to_num(u), torch.nan_to_num(-(size[..., None] * solved)[:, rows, :-1]))


def _chance(block: Freed, inflation: Float[Tensor, " b"] | None = None, groups: int = 0) -> Float[Tensor, " b"]:
    """Probability of a larger score.

    Args:
        inflation: of its variance, where it comes from leaving out this many groups.
    """
    values, vectors = torch.linalg.eigh(block.A)
    along, seen = (vectors.mT @ block.u[..., None])[..., 0], values > SEEN
    chi2 = torch.where(seen, along.square() / values.clamp_min(SEEN), 0.0).sum(-1)
    freedom = seen.sum(-1)
    if inflation is None or groups == 0:
        tail = torch.special.gammaincc(0.5 * freedom.clamp_min(1), 0.5 * chi2)
    else:
        d = freedom.clamp_min(1)
        tail = fdtrc(*(x.cpu().numpy() for x in (d, (groups - 1) * d, chi2 / inflation / d)))
        tail = torch.as_tensor(tail).to(chi2)
    return torch.where(freedom > 0, tail, 1.0)


def _inflation(
    model: WeightedModel, state: State, H: Float[Tensor, "b p p"], g: Float[Tensor, "b p"], part: slice, asked: int
) -> tuple[Float[Tensor, " b"], int]:
    """By how much the freed unknown scatters when groups of neighbours are left out, over what noise would make: the
    mean factor on the variance over its seen directions, 1 or more; and the number of groups.

    Args:
        H, g: normal equations with priors, of the unknown freed, where it is nominal.
        part: the unknown.
        asked: groups wanted.
    """
    group, count, enough = groups_of(model, asked)
    if count == 0:
        return torch.ones_like(g[:, 0]), 0
    covariance, prior = inverse(H), model.layout.sigma.square().reciprocal()
    step = (covariance @ g[..., None])[..., 0]
    H_k, s_k = (torch.nan_to_num(x) for x in group_sums(model, state, group, count))
    s_k = s_k - (H_k @ step[:, None, :, None])[..., 0]
    deviation, _ = model.layout.prior(state)
    s_k = s_k - (s_k.sum(1) + prior * (deviation - step))[:, None] / count  # what the bias correction took
    rest = inverse(H[:, None] - H_k)
    sigma = model.layout.sigma[:, part]
    shift = (rest @ s_k[..., None])[..., part, 0] / sigma[:, None]  # (b, k, q)
    own, own_k = (
        C[..., part, part] / (sigma[:, :, None] * sigma[:, None])[:, *[None] * (C.ndim - 3)] for C in (covariance, rest)
    )
    values, vectors = torch.linalg.eigh(own)
    seen = values < 1.0 / (1.0 + SEEN)
    scale = torch.where(seen, values.clamp_min(1e-12).rsqrt(), 0.0)
    white = vectors * scale[:, None]
    moved = shift @ white
    expected = (white.mT @ (own_k.sum(1) - count * own) @ white) + RIDGE * torch.eye(moved.shape[-1]).to(moved)
    factor = (torch.linalg.solve(expected, moved.mT) * moved.mT).sum((-2, -1)) / seen.sum(-1).clamp_min(1)
    return torch.where(enough, torch.nan_to_num(factor).clamp_min(1.0), 1.0), count


def _doubt(
    block: Freed,
    sigma: Float[Tensor, "b q"],
    considered: Float[Tensor, "b q"],
    inflation: Float[Tensor, " b"],
    belief: float,
) -> Float[Tensor, "b m m"]:
    """Covariance of the transform from not knowing whether the unknown is nominal.

    With information A and score u in units of how far it may be off, its posterior is N(C u, C), C = (1 + A)^-1, and
    the log of the odds for nominal are (log det C^-1 - u^T C u) / 2. How far it may be off is known to a factor only,
    which the data tell as well: all of SCALES share the probability.

    Args:
        block: in units of `sigma`.
        considered: how far the unknown may be off.
        inflation: of the variance of the score.
        belief: probability, before the data speak, that it is.
    """
    unit = considered / sigma
    values, vectors = torch.linalg.eigh(block.A * unit[:, :, None] * unit[:, None] / inflation[:, None, None])
    values, along = values.clamp_min(0.0), (vectors.mT @ (block.u * unit)[..., None])[..., 0] / inflation[:, None]
    variance = values.new_tensor(SCALES).square()[:, None, None]
    spread = variance / (1.0 + variance * values)  # (scale, b, q)
    for_it = 0.5 * (along.square() * spread - (1.0 + variance * values).log()).sum(-1)
    for_it = for_it + torch.logit(for_it.new_tensor(belief)) - math.log(len(SCALES))
    probability = torch.softmax(torch.cat((torch.zeros_like(for_it[:1]), for_it)), dim=0)[1:]
    effect = block.effect * unit[:, None] @ vectors
    off = (effect @ (spread * along)[..., None])[..., 0]
    covariance = effect * spread[..., None, :] @ effect.mT + off[..., :, None] * off[..., None, :]
    return (probability[..., None, None] * covariance).sum(0)
