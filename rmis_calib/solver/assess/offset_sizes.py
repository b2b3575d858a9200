"""How large are constant joint offsets? Nobody knows before; the offsets that the data see tell it of all of them.

Given a size, the offsets are independent with that 1 sigma, and everything is Gaussian: with A the information of the
data on the offsets and u the score, both with the other unknowns eliminated and in units of the offsets' priors,

    posterior of size s:   N(C u, C),  C = (A + 1/s^2)^-1
    likelihood of size s:  log p(data | s) = (u^T C u - log det(1 + s^2 A)) / 2 + constant

so that one eigendecomposition of A serves all sizes. The answer is the mixture over sizes (a hierarchical model). The
prior of the size is uniform up to LARGEST (Gelman 2006, Bayesian Analysis 1: the uniform prior of a scale is the one
that keeps coverage when it is learned from a handful of offsets). One that favours small sizes states a smaller sigma
where there are no offsets, and is wrong where there are small ones (`tests/benchmarks/bench_solver_offset_sizes.py`,
with `--belief 0.8`).
"""

from dataclasses import dataclass

import torch
from jaxtyping import Bool, Float
from torch import Tensor

from rmis_calib.geometry.rigid import rigid_from_rotation_translation
from rmis_calib.geometry.rotations import rotvec_to_matrix
from rmis_calib.solver.assess.information import inverse
from rmis_calib.solver.assess.left_out import eliminated, places
from rmis_calib.solver.solution import AlternativeModel, Solution

SMALLEST, LARGEST, COUNT = 0.05, 2.0, 9
"""Sizes, in the offsets' priors: 0.025 to 1 deg and 0.05 to 2 mm with the priors of the settings."""

STRONG_EVIDENCE = 3.0
"""Log of the odds, 20 to 1, that the data must give for offsets to be part of the answer, and not of its covariance
alone (Kass & Raftery 1995: strong)."""


@dataclass(frozen=True)
class OffsetSizes:
    """The answer for each size that the offsets may have.

    Attributes:
        size: in the offsets' priors; the first is zero: no offsets.
        probability: of each, in the light of the data.
        shift: of the transform from the solution, rotation vector and translation; rad and mm.
        covariance: of the transform.
        camera_right_T_arm: the solution's.
        log_odds: of offsets of any size against none, in the light of the data alone.
    """

    size: Float[Tensor, " s"]
    probability: Float[Tensor, " s"]
    shift: Float[Tensor, "s 6"]
    covariance: Float[Tensor, "s 6 6"]
    camera_right_T_arm: Float[Tensor, "4 4"]
    log_odds: float

    @property
    def chosen(self) -> int:
        """Number of the size to answer with: without strong evidence of offsets none, so that what the data hardly see
        does not move the answer; else the one whose answer is nearest to the mean over all sizes."""
        if self.log_odds < STRONG_EVIDENCE:
            return 0
        mean, covariance = _mixture(self.probability, self.shift, self.covariance)
        gap = self.shift - mean
        distance2 = (gap * torch.linalg.solve(covariance, gap.mT).mT).sum(-1)
        return int(torch.where(self.probability > 0, distance2, torch.inf).argmin())

    def quantile(self, probability: float) -> float:
        """Size that offsets exceed with no more than the rest of the probability."""
        enough = self.probability.cumsum(0) >= probability - 1e-9
        return float(self.size[int(enough.long().argmax())])

    def besides(self, chosen: int) -> AlternativeModel:
        """The mixture of all sizes but one."""
        weight = self.probability.clone()
        weight[chosen] = 0.0
        rest = weight.sum()
        mean, covariance = _mixture(weight / rest.clamp_min(1e-300), self.shift, self.covariance)
        R, t = self.camera_right_T_arm[:3, :3], self.camera_right_T_arm[:3, 3]
        shifted = rigid_from_rotation_translation(rotvec_to_matrix(mean[:3]) @ R, t + mean[3:])
        return AlternativeModel(shifted, covariance, rest)


def offset_sizes(solution: Solution, belief: float, unstated: Bool[Tensor, " j"]) -> OffsetSizes:
    """Every size, from the estimate with the offsets' priors.

    Args:
        solution: of one trial, with joint offsets among its unknowns.
        belief: probability, before the data speak, that there are offsets.
        unstated: joints of whose offsets nobody states the size; the others keep their priors.
    """
    posterior, found = solution.posterior, solution.nuisances["joint_offset"].value.reshape(-1)
    assert posterior is not None  # `joint` always has one
    excess = solution.chi2_per_dof.reshape(()).clamp_min(1.0)
    growth, inflation = torch.eye(6).to(solution.covariance), excess
    if solution.groups is not None:
        growth, inflation = solution.groups.growth[0], excess * solution.groups.inflation[0].square()
    information = posterior.information * excess
    joints = torch.nonzero(unstated)[:, 0].tolist()
    part = [places(posterior.layout, "joint_offset")[joint] for joint in joints]
    others = [place for place in range(posterior.layout.size) if place not in part]
    sigma, none = posterior.layout.sigma[:, part], torch.zeros_like(posterior.layout.sigma)
    block = eliminated(information, none, sigma, part, others, [*range(6)])
    A, effect, offset = block.A[0], block.effect[0], found[joints] / sigma[0]
    u = A @ offset + offset
    values, vectors = torch.linalg.eigh(A / inflation)
    values, along = values.clamp_min(0.0), vectors.mT @ u / inflation

    sizes = torch.logspace(0.0, 1.0, COUNT, base=LARGEST / SMALLEST, dtype=A.dtype, device=A.device) * SMALLEST
    size = torch.cat((torch.zeros_like(sizes[:1]), sizes))
    spread = size.square()[:, None] / (1.0 + size.square()[:, None] * values)  # (s, q)
    uniform = sizes / sizes.sum()
    log_likelihood = 0.5 * (along.square() * spread - torch.log1p(size.square()[:, None] * values)).sum(-1)
    prior = torch.cat((torch.full_like(sizes[:1], 1.0 - belief), belief * uniform))
    probability = torch.softmax(log_likelihood + prior.log(), dim=0)
    log_odds = torch.logsumexp(log_likelihood[1:] + uniform.log(), dim=0) if belief else log_likelihood[0]

    by_direction = effect @ vectors
    shift = (spread * along) @ by_direction.mT - effect @ offset
    # What else the covariance counts (doubts) stays; the groups' growth acts on A where the offsets are concerned.
    of_all, of_others = (inverse(H)[0, :6, :6] for H in (information, information[:, others][:, :, others]))
    fixed = solution.covariance.reshape(6, 6) + excess * growth @ (of_others - of_all) @ growth.mT
    covariance = fixed + (by_direction * spread[:, None]) @ by_direction.mT
    return OffsetSizes(size, probability, shift, covariance, solution.camera_right_T_arm.reshape(4, 4), float(log_odds))


def _mixture(
    weight: Float[Tensor, " s"], shift: Float[Tensor, "s 6"], covariance: Float[Tensor, "s 6 6"]
) -> tuple[Float[Tensor, " 6"], Float[Tensor, "6 6"]]:
    """Mean and covariance."""
    mean = weight @ shift
    gap = shift - mean
    return mean, torch.einsum("s,sij->ij", weight, covariance + gap[:, :, None] * gap[:, None])
