"""What the data can and cannot see of the transform, in print."""

import math
from dataclasses import dataclass

from rmis_calib.report.words.formatting import significant
from rmis_calib.solver.observability import Direction, Observability, Verdict

_TONES = {Verdict.TRUSTWORTHY: "ok", Verdict.WEAK: "weak", Verdict.UNOBSERVABLE: "bad", None: "open"}


@dataclass(frozen=True)
class DirectionRow:
    """One eigen-direction of the uncertainty: words, sigma, and length of its bar in per cent."""

    words: str
    sigma_mm: str
    bar_percent: float


@dataclass(frozen=True)
class ObservabilityPart:
    """What the data can and cannot see; `ticks` are (place in per cent, label) of the bars' logarithmic axis."""

    tone: str
    verdict: str
    sentences: tuple[str, ...]
    named_cases: tuple[str, ...]
    advice: tuple[str, ...]
    directions: tuple[DirectionRow, ...]
    ticks: tuple[tuple[float, str], ...]


def observability(seen: Observability) -> ObservabilityPart:
    """Observability in print; weakest direction first."""
    found = sorted(seen.directions, key=_size, reverse=True)
    known = [sigma for item in found if (sigma := item.sigma_at_working_point_mm)]
    low = math.floor(math.log10(min(known))) if known else -2
    high = min(max(math.ceil(math.log10(max(known))), low + 1), low + 9) if known else 2
    return ObservabilityPart(
        tone=_TONES[seen.verdict],
        verdict=seen.verdict or "not assessed",
        sentences=seen.sentences,
        named_cases=tuple(name.replace("_", " ").lower() for name in seen.named_cases),
        advice=seen.advice,
        directions=tuple(_direction(item, low, high) for item in found),
        ticks=tuple((100.0 * (power - low) / (high - low), f"{10.0**power:g}") for power in _decades(low, high)),
    )


def _size(direction: Direction) -> float:
    sigma = direction.sigma_at_working_point_mm
    return math.inf if sigma is None else sigma


def _direction(item: Direction, low: int, high: int) -> DirectionRow:
    sigma, percent = item.sigma_at_working_point_mm, 100.0
    if sigma is not None:
        percent = 0.0 if sigma <= 0.0 else 100.0 * (math.log10(sigma) - low) / (high - low)
    return DirectionRow(
        words=item.words,
        sigma_mm="not bounded" if sigma is None else f"{significant(sigma, 2)} mm",
        bar_percent=round(min(max(percent, 0.5), 100.0), 2),
    )


def _decades(low: int, high: int) -> range:
    return range(low, high + 1, 1 if high - low <= 5 else 2)
