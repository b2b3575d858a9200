"""Pictures of more than 8 bits made into 8, by the range that they really use."""

import numpy as np

from rmis_calib.errors import VideoError

_DEPTHS = (8, 10, 12, 14, 16)
"""Bits that sensors have; files hold all but the first in numbers of 16 bits."""


def bits_of(highest: int) -> int:
    """Least of the usual depths that holds a value."""
    return next((bits for bits in _DEPTHS if highest < 1 << bits), _DEPTHS[-1])


def eight_bits(values: np.ndarray, bits: int, where: str) -> np.ndarray:
    """(h, w, 3) uint8 of (h, w) or (h, w, 3) values of `bits` bits.

    Raises:
        VideoError: a value needs more bits.
    """
    highest = int(values.max(initial=0))
    if highest >> bits:
        expected = f"values up to {(1 << bits) - 1} ({bits} bits) as in the other pictures"
        raise VideoError(where=where, expected=expected, found=highest)
    image = (values >> (bits - 8)).astype(np.uint8) if bits > 8 else values.astype(np.uint8)
    return np.repeat(image[..., None], 3, axis=-1) if image.ndim == 2 else image
