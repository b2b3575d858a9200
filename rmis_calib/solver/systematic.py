"""Errors that all motions share, and that therefore do not average out.

A camera's lens model and its edge detector shift a contour point across its line by nearly the same amount in every
picture. Such a shift is not estimated: it is *considered*. With x the unknowns, b the shifts of prior covariance B, and
J_x, J_b the Jacobians, the estimate moves by G b, G = (J_x^T S^-1 J_x)^-1 J_x^T S^-1 J_b, so its covariance is that of
the noise plus G B G^T.

Source: S. F. Schmidt, "Application of state-space methods to navigation problems" (1966): consider parameters.
"""

from dataclasses import replace

import torch
from jaxtyping import Float
from torch import Tensor

from rmis_calib.solver.measurements import LINE, Packed
from rmis_calib.solver.normal import NoiseModel, accumulate
from rmis_calib.solver.residuals import State
from rmis_calib.solver.unknowns import EDGE_BIAS, Layout


def systematic_covariance(
    packed: Packed,
    state: State,
    layout: Layout,
    noise: NoiseModel,
    covariance: Float[Tensor, "b p p"],
    sigma: Float[Tensor, " b"],
    chunk: int,
    weight: Float[Tensor, "c b n"] | None = None,
) -> Float[Tensor, "b p p"]:
    """G B G^T of a shift of every line point of every camera.

    Args:
        packed, state, layout, noise, weight: of the estimate.
        covariance: of the estimate, from the noise.
        sigma: 1 sigma of each shift, normalised units.
        chunk: motions in work at once.
    """
    shifts = packed.row_kind.count(LINE)
    own = slice(layout.size, layout.size + shifts)
    unbounded = torch.full_like(covariance[:, 0, :1], torch.inf).expand(-1, shifts)
    extended = replace(
        layout, blocks=layout.blocks | {EDGE_BIAS: own}, sigma=torch.cat([layout.sigma, unbounded], dim=-1)
    )
    cross = accumulate(packed, state, extended, noise, chunk, weight).H[:, : layout.size, own]
    gain = covariance @ cross
    return sigma.square()[:, None, None] * (gain @ gain.mT)
