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

from dataclasses import dataclass, replace

import torch
from jaxtyping import Float
from scipy.special import fdtrc
from torch import Tensor

from rmis_calib.solver.assess.doubt import belief_in, considered, doubt_of, doubt_of_centres
from rmis_calib.solver.assess.groups import RIDGE, groups_of, leave_groups_out, sums_of
from rmis_calib.solver.assess.left_out import Candidates, Freed
from rmis_calib.solver.estimate.bias import expected_score
from rmis_calib.solver.estimate.map_estimate import MapEstimate
from rmis_calib.solver.model.normal_equations import membership
from rmis_calib.solver.model.state import State
from rmis_calib.solver.model.weighted_model import WeightedModel
from rmis_calib.solver.settings import SolverSettings

CHANCE = {"clock_rate": 0.005, "readout": 0.005, "setup": 0.02, "rcm_offset": 0.02, "compliance": 1e-4}
"""Probability, with everything nominal, from which an unknown is freed: less for what costs more."""
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


def weigh(fit: MapEstimate, settings: SolverSettings) -> Evidence:
    """Evidence on the unknowns that are left out and may be estimated (`clock_rate`; `setup`, where the laparoscope's
    own kinematics are told; `rcm_offset`; `compliance`; `readout`), doubt of all but the first, and of the cameras'
    principal points, which may all be off alike (`centre`)."""
    asked, chance, doubt = settings.unknowns, {}, {}
    if "intrinsics" in fit.model.layout.blocks and asked.doubt > 0.0:
        doubt["centre"] = doubt_of_centres(fit)
    left_out = {
        "clock_rate": asked.clock_rate == "auto" and "clock" in fit.model.layout.blocks,
        "readout": asked.readout == "auto" and _may_be_read_later(fit),
        "setup": asked.setup == "known" and fit.problem.laparoscope_base_T_arm is not None,
        "rcm_offset": asked.rcm_offset == "auto",
        "compliance": asked.compliance == "auto",
    }
    names = [name for name, is_left_out in left_out.items() if is_left_out]
    if not names:
        return Evidence(chance, doubt)
    candidates = Candidates.of(fit, settings, names)
    for name in names:
        block, tail, inflation = _tested(candidates, name)
        chance[name] = tail
        if name == "clock_rate":
            continue
        # A camera that stands still cannot tell a bend of the shaft from an error of the picture, nor see the set-up.
        if name != "readout":
            chance[name] = torch.where(candidates.still, 1.0, tail)
        if name == "setup":
            seen = (~candidates.still).to(block.A.dtype)
            block = replace(block, A=block.A * seen[:, None, None], u=block.u * seen[:, None])
        sigma = candidates.sigma(name)
        size = considered(candidates.nominal, asked, name, sigma)
        doubt[name] = doubt_of(block, sigma, size, inflation, belief_in(name, asked))
    return Evidence(chance, doubt)


def _may_be_read_later(fit: MapEstimate) -> bool:
    return fit.model.measured.clock is not None and bool((fit.problem.noise.readout > 0).any())


def _tested(candidates: Candidates, name: str) -> tuple[Freed, Float[Tensor, " b"], Float[Tensor, " b"]]:
    """A candidate, the chance of its score if it were nominal, and by how much neighbours inflate its variance."""
    block, settings = candidates.block(name), candidates.settings
    chance, inflation = _chance(block), torch.ones_like(block.u[:, 0])
    at = torch.nonzero(chance < CHANCE[name])[:, 0]
    if not len(at):
        return block, chance, inflation
    few, there = candidates.with_freed(name, at)
    # Noise in the Jacobian alone makes a score.
    score = candidates.score(name)[at] - expected_score(few, there, settings.bias_motions, settings.seed).g
    corrected = candidates.block(name, score, at)
    grown, groups = _inflation(few, there, score, few.layout.blocks[name], settings.groups)
    block = Freed(block.A, block.u.index_copy(0, at, corrected.u), block.effect)
    chance = chance.index_copy(0, at, _chance(corrected, grown, groups))
    return block, chance, inflation.index_copy(0, at, grown)


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
    model: WeightedModel, state: State, g: Float[Tensor, "b p"], part: slice, asked: int
) -> tuple[Float[Tensor, " b"], int]:
    """By how much the freed unknown scatters when groups of neighbours are left out, over what noise would make: the
    mean factor on the variance over its seen directions, 1 or more; and the number of groups.

    Args:
        g: score with priors, of the unknown freed, where it is nominal.
        part: the unknown.
        asked: groups wanted.
    """
    group, count, enough = groups_of(model, asked)
    if count == 0:
        return torch.ones_like(g[:, 0]), 0
    H_k, s_k = sums_of(model, state, membership(group, count, g.dtype))
    left = leave_groups_out(model.layout, state, H_k, s_k, g)
    sigma = model.layout.sigma[:, part]
    shift = left.shift[..., part] / sigma[:, None]  # (b, k, q)
    own, own_k = (
        C[..., part, part] / (sigma[:, :, None] * sigma[:, None])[:, *[None] * (C.ndim - 3)]
        for C in (left.covariance, left.covariance_k)
    )
    values, vectors = torch.linalg.eigh(own)
    seen = values < 1.0 / (1.0 + SEEN)
    scale = torch.where(seen, values.clamp_min(1e-12).rsqrt(), 0.0)
    white = vectors * scale[:, None]
    moved = shift @ white
    expected = (white.mT @ (own_k.sum(1) - count * own) @ white) + RIDGE * torch.eye(moved.shape[-1]).to(moved)
    factor = (torch.linalg.solve(expected, moved.mT) * moved.mT).sum((-2, -1)) / seen.sum(-1).clamp_min(1)
    return torch.where(enough, torch.nan_to_num(factor).clamp_min(1.0), 1.0), count
