"""Which motions matter: the information of each motion, and long recordings thinned to the informative ones."""

import torch
from jaxtyping import Float, Int
from torch import Tensor

from rmis_calib.solver.model.batched_linalg import eliminate
from rmis_calib.solver.model.measurement_rows import MeasurementRows
from rmis_calib.solver.model.normal_equations import NoiseModel, covariance, image_variance
from rmis_calib.solver.model.parameters import ParameterLayout, columns
from rmis_calib.solver.model.residuals import State, linearise

THINNING_ROUNDS = 16
"""Motions are picked in this many rounds, the information updated between; one by one keeps under 1 per cent more."""
LEAST_SCALED = 1e-13
"""Least eigenvalue of the information, scaled to a unit diagonal, that is more than rounding."""


def motion_information(
    packed: MeasurementRows, state: State, layout: ParameterLayout, noise: NoiseModel
) -> Float[Tensor, "b n p p"]:
    """Information J^T S^-1 J of each motion on its own."""
    rows, shaft = linearise(packed, state)
    k, b, n = rows.r.shape
    system = torch.empty((k, k + layout.size, b, n), dtype=rows.r.dtype, device=rows.r.device)
    covariance(rows.w, rows.a, image_variance(packed, noise), packed.cameras, noise, system[:, :k])
    system[:, k:] = columns(layout, rows, shaft, packed, state)
    eliminate(system)
    white = system[:, k:] * system.diagonal(dim1=0, dim2=1).permute(2, 0, 1).rsqrt()[:, None]
    return torch.einsum("kpbn,kqbn->bnpq", white, white)


def inverse(information: Float[Tensor, "*b p p"]) -> Float[Tensor, "*b p p"]:
    """Covariance of all unknowns; huge in directions without information."""
    scale = information.diagonal(dim1=-2, dim2=-1).clamp_min(1e-300).rsqrt()
    values, vectors = torch.linalg.eigh(information * scale[..., :, None] * scale[..., None, :])
    scaled = vectors @ (vectors / values.clamp_min(LEAST_SCALED)[..., None, :]).mT
    return scaled * scale[..., :, None] * scale[..., None, :]


def select_d_optimal(
    information: Float[Tensor, "n p p"], prior: Float[Tensor, "p p"], count: int
) -> tuple[Int[Tensor, " k"], float]:
    """Indices of `count` motions that keep most of det(information) (D-optimal, greedy in rounds), and the part kept:
    the geometric mean over the six parameters of the transform of how much of the information is left."""
    n, p = information.shape[:2]
    scale = (information.sum(0) + prior).diagonal().clamp_min(1e-300).rsqrt()
    flat = (information * scale[:, None] * scale).flatten(1)
    base = prior * scale[:, None] * scale
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
