"""What the result rests on: the motions used and rejected, and the residuals of each kind of measurement."""

from dataclasses import dataclass

import numpy as np

from rmis_calib.report.formatting import finite, significant
from rmis_calib.report.plots import ResidualPlots, plot_residuals
from rmis_calib.results import CalibrationResult, Motions, Residual

# One mark a motion up to here: about 1.5 px each on a phone. Beyond, a mark stands for several consecutive motions.
_MAX_MARKS = 240
_MAX_REJECTED_LISTED = 500

_MEASUREMENTS = {"contour": "Contours", "axis": "Axis line", "end": "Shaft end", "head": "Head point"}
_MEASUREMENT_WORDS = {
    "contour": "distance of the detected edges from the predicted ones",
    "axis": "distance of the detected axis from the predicted one",
    "end": "distance along the axis between the detected and the predicted end of the dark shaft",
    "head": "distance of the marked head point from the predicted one",
}


@dataclass(frozen=True)
class Reason:
    """How many motions were rejected for one reason, and that as a share of all motions in per cent."""

    text: str
    count: int
    percent: float


@dataclass(frozen=True)
class Mark:
    """One place of the strip: the share of its motions that were used, in per cent, and its tooltip."""

    used_percent: float
    tooltip: str


@dataclass(frozen=True)
class Usage:
    """Which motions were used.

    Attributes:
        total: motions in the recording.
        used: motions in the estimate.
        used_percent: their share.
        reasons: why the others were not, most frequent first.
        marks: the recording from its first motion to its last.
        motions_per_mark: how many motions a mark stands for, at most.
        rejected: (motion, time, reason) of rejected motions, as many as the page lists.
        unlisted: rejected motions that are not listed.
    """

    total: int
    used: int
    used_percent: float
    reasons: tuple[Reason, ...]
    marks: tuple[Mark, ...]
    motions_per_mark: int
    rejected: tuple[tuple[int, str, str], ...]
    unlisted: int


@dataclass(frozen=True)
class ResidualPart:
    """Residuals of one kind of measurement; without `plots` when nothing finite was measured."""

    title: str
    meaning: str
    unit: str
    count: int
    median: str
    rms: str
    robust_scale: str
    largest: str
    plots: ResidualPlots | None


def usage(motions: Motions) -> Usage:
    """Counts, reasons and the strip of a recording's motions."""
    used = np.asarray(motions.used, dtype=bool)
    total, count = len(used), int(used.sum())
    reasons = sorted(motions.rejected_by_reason.items(), key=lambda item: (-item[1], item[0]))
    marks = np.array_split(np.arange(total), min(total, _MAX_MARKS)) if total else []
    rejected = np.flatnonzero(~used)
    listed = rejected[:_MAX_REJECTED_LISTED]
    return Usage(
        total=total,
        used=count,
        used_percent=_percent(count, total),
        reasons=tuple(Reason(text or "no reason given", n, _percent(n, total)) for text, n in reasons),
        marks=tuple(_mark(motions, used, members) for members in marks),
        motions_per_mark=max((len(members) for members in marks), default=1),
        rejected=tuple((int(i), _time(motions, int(i)), motions.reasons[i] or "no reason given") for i in listed),
        unlisted=len(rejected) - len(listed),
    )


def _mark(motions: Motions, used: np.ndarray, members: np.ndarray) -> Mark:
    first, last = int(members[0]), int(members[-1])
    share = _percent(int(used[members].sum()), len(members))
    if first != last:
        return Mark(share, f"motions {first} to {last}: {int(used[members].sum())} of {len(members)} used")
    time = _time(motions, first)
    outcome = "used" if used[first] else f"rejected: {motions.reasons[first] or 'no reason given'}"
    return Mark(share, f"motion {first}{', ' + time if time else ''}: {outcome}")


def _time(motions: Motions, index: int) -> str:
    if motions.timestamps_s is None:
        return ""
    seconds = finite(motions.timestamps_s[index])
    return "" if seconds is None else f"{seconds:.3f} s"


def _percent(part: int, whole: int) -> float:
    return round(100.0 * part / whole, 2) if whole else 0.0


def residuals(result: CalibrationResult) -> tuple[ResidualPart, ...]:
    """Each kind of residual, in the order of the result."""
    return tuple(_residual(kind, entry, result.motions) for kind, entry in result.residuals.items())


def _residual(kind: str, entry: Residual, motions: Motions) -> ResidualPart:
    measurement, _, camera = kind.rpartition("_")
    known = measurement in _MEASUREMENTS and camera in ("right", "left")
    title = f"{_MEASUREMENTS[measurement]}, {camera} camera" if known else kind
    unit, values = entry.unit, entry.by_motion
    used = np.asarray(motions.used, dtype=bool)
    used = used if len(used) == len(values) else np.ones(len(values), dtype=bool)
    measured = np.isfinite(values)
    plots = plot_residuals(values, used, unit, camera if known else "other", title) if measured.any() else None
    return ResidualPart(
        title=title,
        meaning=_MEASUREMENT_WORDS[measurement] if known else "",
        unit=unit,
        count=int((measured & used).sum()),
        median=significant(entry.median),
        rms=significant(entry.rms),
        robust_scale=significant(None if plots is None else plots.robust_scale),
        largest=significant(np.abs(values[measured]).max() if measured.any() else None),
        plots=plots,
    )
