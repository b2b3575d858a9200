"""Lists and codes in words."""

from collections.abc import Sequence

import numpy as np
from torch import Tensor

NAMED_RANGES = 4
"""Ranges that are named; the rest of many is left out."""


def words_of(codes: Tensor, words: Sequence[str]) -> np.ndarray:
    """(N,) the words that each code, a number from 0 on, stands for, as objects."""
    return np.array(words, dtype=object)[codes.cpu().numpy()]


def joined(parts: list[str]) -> str:
    """Parts of a sentence as a list in words."""
    return parts[0] if len(parts) == 1 else ", ".join(parts[:-1]) + " and " + parts[-1]


def ranges_in_words(numbers: Sequence[int]) -> str:
    """Increasing numbers as ranges: `3, 7 to 12`; the rest of many ranges is left out."""
    ranges: list[tuple[int, int]] = []
    for number in numbers:
        if ranges and number == ranges[-1][1] + 1:
            ranges[-1] = (ranges[-1][0], number)
        else:
            ranges.append((number, number))
    words = [f"{a}" if a == b else f"{a} to {b}" for a, b in ranges]
    return ", ".join(words[:NAMED_RANGES]) + (", ..." if len(words) > NAMED_RANGES else "")
