"""Radial profiles of lens models: how far from the centre a direction appears, relative to a pinhole camera.

With s = x^2 + y^2 of the undistorted normalised point, the distorted one is `x * g(s)` plus a tangential part (of the
plumb-bob and rational models). A model is its g, the derivative of it, and the place where x * g stops growing.
"""

import math
from collections.abc import Callable

import numpy as np
import torch
from jaxtyping import Float
from torch import Tensor

from rmis_calib.geometry.lens_models import LensModel

_SERIES_BELOW = 0.01
"""s below which atan(r)/r and its slope come from their series: the closed form of the slope cancels there."""
_SERIES_TERMS = 10
_SHORT_OF_POLE = 1.0 - 1e-6
"""Share of the s of a pole that is still used: the inverse needs a finite place to start from."""

Profile = tuple[Float[Tensor, "*batch"], Float[Tensor, "*batch"]]
"""g and dg/ds."""


def plumb_bob(s: Float[Tensor, "*batch"], distortion: Float[Tensor, " k"]) -> Profile:
    """1 + k1 s + k2 s^2 + k3 s^3."""
    k1, k2, k3 = distortion[0], distortion[1], distortion[4]
    return 1 + s * (k1 + s * (k2 + s * k3)), k1 + s * (2 * k2 + 3 * s * k3)


def rational_polynomial(s: Float[Tensor, "*batch"], distortion: Float[Tensor, " k"]) -> Profile:
    """(1 + k1 s + k2 s^2 + k3 s^3) / (1 + k4 s + k5 s^2 + k6 s^3)."""
    top, top_slope = plumb_bob(s, distortion)
    k4, k5, k6 = distortion[5], distortion[6], distortion[7]
    bottom = 1 + s * (k4 + s * (k5 + s * k6))
    bottom_slope = k4 + s * (2 * k5 + 3 * s * k6)
    profile = top / bottom
    return profile, (top_slope - profile * bottom_slope) / bottom


def equidistant(s: Float[Tensor, "*batch"], distortion: Float[Tensor, " k"]) -> Profile:
    """theta (1 + k1 theta^2 + k2 theta^4 + k3 theta^6 + k4 theta^8) / r, with theta = atan(r) and r^2 = s."""
    k1, k2, k3, k4 = distortion.unbind(-1)
    a, a_slope = _atan_ratio(s)
    q = s * a * a  # theta^2, whose slope in s is a / (1 + s)
    growth = 1 + q * (k1 + q * (k2 + q * (k3 + q * k4)))
    growth_slope = k1 + q * (2 * k2 + q * (3 * k3 + 4 * q * k4))
    return a * growth, a_slope * growth + a * growth_slope * a / (1 + s)


PROFILES: dict[LensModel, Callable[[Tensor, Tensor], Profile]] = {
    "plumb_bob": plumb_bob,
    "rational_polynomial": rational_polynomial,
    "equidistant": equidistant,
}


def fold_radius_squared(model: LensModel, distortion: list[float]) -> float:
    """Smallest s > 0 at which the distorted radius r * g(s) stops growing, or breaks off; infinite where it never does.

    Source: roots of d/dr (r g(r^2)), of which the numerator is a polynomial in s, or in theta^2 for the fisheye.
    """
    if model == "equidistant":
        k1, k2, k3, k4 = distortion
        theta_squared = _least_positive_root([9 * k4, 7 * k3, 5 * k2, 3 * k1, 1.0])
        return math.tan(math.sqrt(theta_squared)) ** 2 if theta_squared < (math.pi / 2) ** 2 else math.inf
    k1, k2, k3 = distortion[0], distortion[1], distortion[4]
    top = np.array([k3, k2, k1, 1.0])
    if model == "plumb_bob":
        return _least_positive_root([7 * k3, 5 * k2, 3 * k1, 1.0])
    k4, k5, k6 = distortion[5:8]
    bottom = np.array([k6, k5, k4, 1.0])
    turn = np.polysub(np.polymul(np.polyder(top), bottom), np.polymul(top, np.polyder(bottom)))
    growth = np.polyadd(np.polymul(top, bottom), np.polymul([2.0, 0.0], turn))  # of g + 2 s dg/ds
    return min(_least_positive_root(growth.tolist()), _SHORT_OF_POLE * _least_positive_root(bottom.tolist()))


def _least_positive_root(polynomial: list[float]) -> float:
    roots = np.roots(polynomial)
    return min((root.real for root in roots if abs(root.imag) < 1e-9 * abs(root) and root.real > 0), default=math.inf)


def _atan_ratio(s: Float[Tensor, "*batch"]) -> Profile:
    """atan(r) / r and its derivative in s = r^2; smooth at 0."""
    is_small = s < _SERIES_BELOW
    small = torch.where(is_small, s, 0.0)
    ratio, slope = torch.zeros_like(s), torch.zeros_like(s)
    for n in reversed(range(_SERIES_TERMS)):  # sum of (-s)^n / (2 n + 1), by Horner's rule
        slope = ratio + small * slope
        ratio = (-1.0) ** n / (2 * n + 1) + small * ratio
    large = torch.where(is_small, 1.0, s)
    r = large.sqrt()
    far = torch.atan(r) / r
    far_slope = (1 / (1 + large) - far) / (2 * large)
    return torch.where(is_small, ratio, far), torch.where(is_small, slope, far_slope)
