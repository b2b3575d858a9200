"""What the covariance gains as an unknown that was left out may not be nominal (Bayesian model averaging: Hoeting et
al. 1999)."""

import math

import torch
from jaxtyping import Float
from scipy.special import gammaincinv
from torch import Tensor

from rmis_calib.solver.assess.left_out import Freed, eliminated, reported
from rmis_calib.solver.estimate.map_estimate import MapEstimate
from rmis_calib.solver.model.parameters import NuisancePriors
from rmis_calib.solver.settings import UnknownSettings

SCALES = (0.5, 1.0, 2.0)
"""Of how far an unknown may be off, in what is assumed; each as likely."""
SHARED_CENTRE = 2.0
"""How far the principal points of all cameras may be off alike, in the prior of each."""
CENTRE_DOUBT = 0.8
"""Probability, before the data speak, that they are: of a still laparoscope the data hardly say
(`tests/benchmarks/bench_solver_misspecified.py`, centre 10 px off)."""
OWN_BELIEF = {"rcm_offset": 0.5, "readout": 0.5}
"""Least probability, before the data speak, that the shaft misses the RCM, and that rows are read one after the other,
by about the prior: more than that a set-up is wrong which somebody measured. With 0.2 for the RCM, 5 % of trials with a
still laparoscope and an RCM missed by 1 mm are called trustworthy and wrong, with this none."""
COVERED = 0.95
"""Part of all cases that the ellipsoid of this size is to hold, whether an unknown is nominal or not."""


def belief_in(name: str, asked: UnknownSettings) -> float:
    """Probability, before the data speak, that an unknown is off by about how far it may be; 0: everything is
    trusted."""
    return max(asked.doubt, OWN_BELIEF.get(name, 0.0)) if asked.doubt else 0.0


def considered(
    nominal: NuisancePriors, asked: UnknownSettings, name: str, sigma: Float[Tensor, "b q"]
) -> Float[Tensor, "b q"]:
    """How far the unknown may be off: of a set-up and of the RCM, what the data state, else what is assumed; zero: it
    is exact."""
    if name == "rcm_offset":
        return torch.nan_to_num(nominal.rcm_mm, nan=asked.rcm_offset_sigma_mm)[:, None].expand_as(sigma)
    if name != "setup":
        return sigma
    rad = torch.nan_to_num(nominal.setup_rad, nan=math.radians(asked.setup_doubt_deg))
    mm = torch.nan_to_num(nominal.setup_mm, nan=asked.setup_doubt_mm)
    return torch.stack((rad, rad, rad, mm, mm, mm), dim=-1)


def doubt_of(
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
    of_any = probability.sum(0)
    share = probability / of_any.clamp_min(1e-300) * part_that_covers(of_any)
    return (share[..., None, None] * covariance).sum(0)


def part_that_covers(probability: Float[Tensor, " b"]) -> Float[Tensor, " b"]:
    """Part of what an unknown does to the covariance, if it is off with this probability, that must be allowed for.

    The second moment of both cases together, which is the probability itself, is too small an ellipsoid for the case of
    the unknown being off. With 1 - COVERED of all cases outside, all of which may be of that case, COVERED of all are
    within the ellipsoid where 1 - (1 - COVERED) / probability of that case are: a quantile of chi^2, over that of
    COVERED.
    """
    within = (1.0 - (1.0 - COVERED) / probability.clamp_min(1e-12)).clamp_min(0.0).cpu().numpy()
    part = gammaincinv(3.0, within) / gammaincinv(3.0, COVERED)
    return torch.as_tensor(part).to(probability).maximum(probability)


def doubt_of_centres(fit: MapEstimate) -> Float[Tensor, "b m m"]:
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
    p, rows = H.shape[-1], reported(fit.model.layout)
    last, others = [p, p + 1], list(range(p))
    block = eliminated(torch.nan_to_num(freed), torch.nan_to_num(g), sigma, last, others, rows)
    return doubt_of(block, sigma, sigma, torch.ones_like(g[:, 0]), CENTRE_DOUBT)
