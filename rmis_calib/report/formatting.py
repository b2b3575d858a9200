"""Numbers as a reader wants them: significant digits, real minus signs, and a word for what is not known."""

import math
from typing import Any

UNKNOWN = "unknown"


def finite(value: Any) -> float | None:
    """The value as a finite float, or None for anything that is not one (None, NaN, infinity, text, a list)."""
    try:
        number = float(value)
    except (TypeError, ValueError):
        return None
    return number if math.isfinite(number) else None


def significant(value: Any, digits: int = 3) -> str:
    """`value` with `digits` significant digits, without exponent from 1e-4 to 1e6; "unknown" if it is not finite."""
    number = finite(value)
    if number is None:
        return UNKNOWN
    if number == 0.0:
        return "0"
    exponent = math.floor(math.log10(abs(number)))
    style = f".{max(digits - 1 - exponent, 0)}f" if -4 <= exponent < 6 else f".{digits - 1}e"
    return f"{number:{style}}".replace("-", "−")


def fixed(value: Any, decimals: int) -> str:
    """`value` with a fixed number of decimals and an ASCII minus, for copying; "unknown" if it is not finite."""
    number = finite(value)
    if number is None:
        return UNKNOWN
    text = f"{number:.{decimals}f}"
    return f"{0.0:.{decimals}f}" if float(text) == 0.0 else text
