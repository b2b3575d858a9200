"""The unknowns that were estimated beside the transform, and which of them the data do not tell."""

import torch
from jaxtyping import Float
from torch import Tensor

from rmis_calib.solver.estimate.map_estimate import MapEstimate
from rmis_calib.solver.model.parameters import UNITS
from rmis_calib.solver.settings import SolverSettings
from rmis_calib.solver.solution import Nuisance


def nuisances_of(fit: MapEstimate, settings: SolverSettings) -> dict[str, Nuisance]:
    """Every estimated unknown beside the transform."""
    deviation, _ = fit.model.layout.prior(fit.state)
    sigma = fit.covariance.diagonal(dim1=-2, dim2=-1).clamp_min(0.0).sqrt()
    out = {}
    for name, part in fit.model.layout.blocks.items():
        if name in ("rotation", "translation"):
            continue
        value = fit.state.radius[:, None] if name == "radius" else deviation[:, part]
        held = sigma[:, part] > settings.unknowns.held_ratio * fit.model.layout.sigma[:, part]
        out[name] = Nuisance(
            value=value,
            sigma=sigma[:, part],
            unit=UNITS[name],
            held=held,
            unseen=_unseen(
                fit.covariance[:, part, part], fit.model.layout.sigma[:, part], settings.unknowns.held_ratio
            ),
            pull=deviation[:, part] / fit.model.layout.sigma[:, part],
        )
    return out


def _unseen(
    covariance: Float[Tensor, "b k k"], prior_sigma: Float[Tensor, "b k"], ratio: float
) -> Float[Tensor, "b k k"]:
    """Projection onto the combinations whose sigma the data do not bring below `ratio` of the prior.

    Decided along the principal directions, in units of the prior: two offsets of which only the sum shows are each
    known to 0.7 of their prior, and their difference not at all.
    """
    values, vectors = torch.linalg.eigh(torch.nan_to_num(_in_prior_units(covariance, prior_sigma)))
    chosen = (values > ratio**2).to(values.dtype)
    return vectors * chosen[:, None] @ vectors.mT


def _in_prior_units(covariance: Float[Tensor, "b k k"], prior_sigma: Float[Tensor, "b k"]) -> Float[Tensor, "b k k"]:
    return covariance / (prior_sigma[:, :, None] * prior_sigma[:, None])
