"""Which motions matter: the information of each motion, and long recordings thinned to the informative ones."""

import torch
from jaxtyping import Float, Int
from torch import Tensor

from rmis_calib.solver.model.batched_linalg import eliminate, rescaled, unit_diagonal
from rmis_calib.solver.model.jacobian import columns
from rmis_calib.solver.model.motion_covariance import covariance, image_variance
from rmis_calib.solver.model.residuals import linearise
from rmis_calib.solver.model.state import State
from rmis_calib.solver.model.weighted_model import WeightedModel

THINNING_ROUNDS = 16
"""Motions are picked in this many rounds, the information updated between; one by one keeps under 1 per cent more."""
LEAST_SCALED = 1e-13
"""Least eigenvalue of the information, scaled to a unit diagonal, that is more than rounding."""


def motion_information(model: WeightedModel, state: State) -> Float[Tensor, "b n p p"]:
    """Information J^T S^-1 J of each motion on its own; weights do not count."""
    measured, layout = model.measured, model.layout
    linear, shaft = linearise(measured, state)
    k, b, n = linear.r.shape
    system = torch.empty((k, k + layout.size, b, n), dtype=linear.r.dtype, device=linear.r.device)
    image = image_variance(measured, model.noise)
    covariance(linear.w, linear.a, image, measured.cameras, model.noise, system[:, :k])
    system[:, k:] = columns(layout, linear, shaft, measured, state)
    eliminate(system)
    white = system[:, k:] * system.diagonal(dim1=0, dim2=1).permute(2, 0, 1).rsqrt()[:, None]
    return torch.einsum("kpbn,kqbn->bnpq", white, white)


def inverse(information: Float[Tensor, "*b p p"]) -> Float[Tensor, "*b p p"]:
    """Covariance of all unknowns; huge in directions without information."""
    scaled, scale = unit_diagonal(information)
    values, vectors = torch.linalg.eigh(scaled)
    return rescaled(vectors @ (vectors / values.clamp_min(LEAST_SCALED)[..., None, :]).mT, scale)


def select_d_optimal(
    information: Float[Tensor, "n p p"], prior: Float[Tensor, "p p"], count: int
) -> tuple[Int[Tensor, " k"], float]:
    """Indices of `count` motions that keep most of det(information) (D-optimal, greedy in rounds), and the part kept:
    the geometric mean over the six parameters of the transform of how much of the information is left."""
    n, p = information.shape[:2]
    _, scale = unit_diagonal(information.sum(0) + prior)
    flat = rescaled(information, scale).flatten(1)
    base = rescaled(prior, scale)
    ridge = 1e-6 * torch.eye(p, dtype=flat.dtype, device=flat.device)
    chosen = torch.zeros(n, dtype=torch.bool, device=flat.device)
    for round_ in range(THINNING_ROUNDS):
        target = count * (round_ + 1) // THINNING_ROUNDS
        wanted = target - int(chosen.sum())
        if wanted <= 0:
            continue
        now = base + flat[chosen].sum(0).view(p, p) + ridge * max(1.0, float(chosen.sum()) / n)
        gain = flat @ torch.linalg.inv(now).flatten()
        chosen[torch.where(chosen, -torch.inf, gain).topk(wanted).indices] = True
    index = torch.nonzero(chosen)[:, 0]
    full, part = (inverse(each.sum(0) + prior)[:6, :6] for each in (information, information[index]))
    kept = torch.exp((torch.logdet(full) - torch.logdet(part)) / 6.0)
    return index, float(kept)
