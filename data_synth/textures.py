"""Textures of the tissue: colour, relief and gloss as periodic random fields. float64 NumPy."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import scipy.fft

from data_synth.kinematics import Array
from data_synth.settings_picture import LookSettings

PALETTES = {
    "mixed": ((0.46, 0.11, 0.085), (0.66, 0.29, 0.23)),
    "liver": ((0.23, 0.040, 0.035), (0.34, 0.070, 0.055)),
    "bowel": ((0.66, 0.29, 0.24), (0.84, 0.50, 0.43)),
}
"""Two linear reflectances between which each kind of tissue varies."""
FAT, VESSEL, BLOOD, PALE = (0.86, 0.50, 0.11), (0.26, 0.03, 0.035), (0.16, 0.006, 0.006), (0.70, 0.46, 0.32)


def filtered_noise(generator: np.random.Generator, size: int, low: float, high: float, slope: float = 1.0) -> Array:
    """Periodic noise (size, size) of unit variance, wave numbers `low` to `high` per side, amplitude ~ k^-slope.

    Drawn as a spectrum, only where the band lets anything through: one inverse transform, and few random numbers.
    """
    reach = min(size // 2, int(3.0 * high) + 1)
    rows, columns = np.arange(-reach, reach), np.arange(reach + 1)
    k = np.hypot(rows[:, None], columns[None])
    band = np.maximum(k, 1e-9) ** -slope * np.exp(-((k / high) ** 2)) * (1.0 - np.exp(-((k / low) ** 2)))
    waves = generator.standard_normal((*k.shape, 2), dtype=np.float32) @ np.array([1.0, 1.0j], dtype=np.complex64)
    spectrum = np.zeros((size, size // 2 + 1), dtype=np.complex64)
    spectrum[rows[:, None] % size, columns[None]] = band * waves
    spectrum[0, 0] = 0.0
    field = np.asarray(scipy.fft.irfft2(spectrum, s=(size, size)))
    return field / field.std()


def smooth_step(x: Array, low: float, high: float) -> Array:
    """0 below `low`, 1 above `high`, smooth between."""
    u = np.clip((x - low) / (high - low), 0.0, 1.0)
    return u * u * (3.0 - 2.0 * u)


def upper_share(field: Array, share: float, softness: float) -> Array:
    """Soft mask of the `share` of a field that is largest."""
    if share <= 0.0:
        return np.zeros_like(field)
    level = np.quantile(field, 1.0 - share)
    return smooth_step(field, level - softness, level + softness)


@dataclass(frozen=True)
class Texture:
    """Linear reflectance (S, S, 3), height (S, S) mm, coarse height (S, S) mm without the fine grain, and gloss (S,
    S)."""

    colour: Array
    height: Array
    relief: Array
    gloss: Array


def make_texture(generator: np.random.Generator, size: int, look: LookSettings) -> Texture:
    """Tissue as `look` describes it."""

    def noise(low: float, high: float, slope: float = 1.0) -> Array:
        return filtered_noise(generator, size, low, high, slope)

    crease = np.exp(-((np.abs(noise(2.0, 7.0, 1.5)) / 0.12) ** 2))
    relief = 3.0 * noise(2.0, 9.0) - 3.0 * look.folds * np.sqrt(crease)
    first, second = (np.array(c) for c in PALETTES[look.tissue])
    colour = _mix(np.broadcast_to(first, (size, size, 3)), second, smooth_step(noise(2.0, 14.0), -1.0, 1.2))
    colour = _mix(colour, PALE, 0.5 * upper_share(noise(3.0, 12.0), 0.12, 0.4))
    fat = upper_share(noise(2.0, 10.0) + 1.5 * look.folds * crease + 0.12 * noise(20.0, 60.0), look.fat, 0.3)
    lobes = noise(30.0, 70.0, 0.5)
    colour = _mix(colour, FAT, 0.9 * fat) * (1.0 + 0.06 * fat * lobes)[..., None]
    for low, high, width, strength in ((4.0, 14.0, 0.035, 0.8), (12.0, 45.0, 0.04, 0.55)):
        ridge = np.abs(noise(low, high, 1.5))
        present = smooth_step(noise(2.0, 8.0), 0.0, 0.8) * (1.0 - 0.7 * fat)
        colour = _mix(
            colour, VESSEL, look.vessels * strength * present * (1.0 - smooth_step(ridge, width, 2.5 * width))
        )
    blood = upper_share(noise(2.0, 16.0), 0.35 * look.blood, 0.1)
    colour = _mix(colour, BLOOD, 0.92 * blood)
    colour = colour * (1.0 + 0.05 * noise(40.0, 400.0, 0.3) * (1.0 - 0.6 * blood))[..., None]
    cavity = upper_share(noise(2.0, 6.0), look.cavities, 0.12)
    colour = colour * ((1.0 - 0.45 * look.folds * crease) * (1.0 - 0.965 * cavity))[..., None]
    bumps = 0.2 * noise(15.0, 60.0, 1.5) * (1.0 - 0.6 * blood) + 0.10 * fat * lobes
    height = relief + bumps + 0.03 * noise(60.0, 250.0) * (1.0 - 0.8 * blood)
    gloss = look.gloss * np.clip(0.7 + 0.35 * noise(3.0, 30.0) + 0.5 * blood, 0.0, 1.5) * (1.0 - cavity)
    return Texture(np.clip(colour, 0.002, 0.95), height, relief, gloss)


def _mix(colour: Array, other: tuple[float, float, float] | Array, weight: Array) -> Array:
    return colour + weight[..., None] * (np.asarray(other) - colour)
