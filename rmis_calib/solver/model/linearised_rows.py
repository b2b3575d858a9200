"""Rows of measurements to first order: what every unknown and every source of noise is made of."""

from dataclasses import dataclass

from jaxtyping import Float
from torch import Tensor


@dataclass(frozen=True)
class LinearisedRows:
    """Residuals and first-order effects of a rigid motion of the shaft, in `camera_right`; rows of absent
    measurements are zero.

    Attributes:
        r: residuals, normalised image units.
        w: effect of a translation of the shaft.
        a: effect of a rotation of the shaft about the RCM.
        radius: effect of the radius.
        end: effect of the end offset.
    """

    r: Float[Tensor, "k b n"]
    w: Float[Tensor, "3 k b n"]
    a: Float[Tensor, "3 k b n"]
    radius: Float[Tensor, "k b n"]
    end: Float[Tensor, "k b n"]
