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


def with_sigma(value: Any, sigma: Any) -> tuple[str, str]:
    """A value and its sigma, the value with no more decimals than two digits of the sigma tell."""
    number, spread = finite(value), finite(sigma)
    if number is None or spread is None or spread <= 0.0:
        return tiny_as_zero(number), significant(spread, 2)
    decimals = max(0, 1 - math.floor(math.log10(spread)))
    if decimals > 7:
        return significant(number, 3), significant(spread, 2)
    return fixed(number, decimals).replace("-", "−"), significant(spread, 2)


def tiny_as_zero(number: float | None, digits: int = 3) -> str:
    """A number whose scale is unknown; what only rounding made is 0."""
    return significant(0.0 if number is not None and abs(number) < 1e-12 else number, digits)
