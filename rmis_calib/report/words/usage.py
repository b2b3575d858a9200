"""Which motions carry the result, and why the others do not."""

from dataclasses import dataclass

import numpy as np

from rmis_calib.report.words.formatting import finite
from rmis_calib.report.words.verdict import is_usable
from rmis_calib.results import CalibrationResult, Motions

# One mark a motion up to here: about 1.5 px each on a phone. Beyond, a mark stands for several consecutive motions.
_MAX_MARKS = 240
_MAX_REJECTED_LISTED = 500


@dataclass(frozen=True)
class Reason:
    """How many motions did not enter for one reason, and that as a share of all motions in per cent."""

    text: str
    count: int
    percent: float


@dataclass(frozen=True)
class Mark:
    """One place of the strip: the share of its motions that entered, in per cent, and its tooltip."""

    used_percent: float
    tooltip: str


@dataclass(frozen=True)
class Usage:
    """What became of the motions.

    Attributes:
        total: motions in the recording.
        used: motions that the strip shows full: those in the estimate, or, where none was made, the usable ones.
        word: what these are called: `used`, `in the failed estimate` or `usable`; and its opposite, `other`.
        sentence: the same in one sentence.
        used_percent: their share.
        reasons: why the others were not, most frequent first.
        marks: the recording from its first motion to its last.
        motions_per_mark: how many motions a mark stands for, at most.
        rejected: (motion, time, reason) of the others, as many as the page lists.
        unlisted: others that are not listed.
    """

    total: int
    used: int
    word: str
    other: str
    sentence: str
    used_percent: float
    reasons: tuple[Reason, ...]
    marks: tuple[Mark, ...]
    motions_per_mark: int
    rejected: tuple[tuple[int, str, str], ...]
    unlisted: int


def usage(result: CalibrationResult) -> Usage:
    """Counts, reasons and the strip of a recording's motions."""
    motions = result.motions
    is_solved = result.status != "insufficient_data"
    used = np.asarray(motions.used, dtype=bool)
    if not is_solved:
        used = used | np.array([is_usable(reason) for reason in motions.reasons], dtype=bool)
    word = "usable" if not is_solved else "used" if result.status in ("ok", "weak") else "in the failed estimate"
    total, count = len(used), int(used.sum())
    counts = {text: n for text, n in motions.rejected_by_reason.items() if is_solved or not is_usable(text)}
    reasons = sorted(counts.items(), key=lambda item: (-item[1], item[0]))
    marks = np.array_split(np.arange(total), min(total, _MAX_MARKS)) if total else []
    rejected = np.flatnonzero(~used)
    listed = rejected[:_MAX_REJECTED_LISTED]
    return Usage(
        total=total,
        used=count,
        word=word,
        other="not usable" if not is_solved else "rejected",
        sentence=f"{count} of {total} motions {'was' if count == 1 else 'were'} {word}",
        used_percent=_percent(count, total),
        reasons=tuple(Reason(text or "no reason given", n, _percent(n, total)) for text, n in reasons),
        marks=tuple(_mark(motions, used, members, word) for members in marks),
        motions_per_mark=max((len(members) for members in marks), default=1),
        rejected=tuple((int(i), _time(motions, int(i)), motions.reasons[i] or "no reason given") for i in listed),
        unlisted=len(rejected) - len(listed),
    )


def _mark(motions: Motions, used: np.ndarray, members: np.ndarray, word: str) -> Mark:
    first, last = int(members[0]), int(members[-1])
    share = _percent(int(used[members].sum()), len(members))
    if first != last:
        return Mark(share, f"motions {first} to {last}: {int(used[members].sum())} of {len(members)} {word}")
    time = _time(motions, first)
    outcome = word if used[first] else f"rejected: {motions.reasons[first] or 'no reason given'}"
    return Mark(share, f"motion {first}{', ' + time if time else ''}: {outcome}")


def _time(motions: Motions, index: int) -> str:
    if motions.timestamps_s is None:
        return ""
    seconds = finite(motions.timestamps_s[index])
    return "" if seconds is None else f"{seconds:.3f} s"


def _percent(part: int, whole: int) -> float:
    return round(100.0 * part / whole, 2) if whole else 0.0
