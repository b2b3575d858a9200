"""What the page says, worked out from a result: plain values and words, no markup."""

import json
import math
from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from rmis_calib.geometry.rigid import RigidTransform
from rmis_calib.io.plain_values import finite_or_none
from rmis_calib.report.formatting import UNKNOWN, finite, fixed, significant
from rmis_calib.results import STATUS_SENTENCES, CalibrationResult
from rmis_calib.solver.observability import Direction, Observability, Verdict

AXES = ("x, right", "y, down", "z, forward")


@dataclass(frozen=True)
class Headline:
    """The verdict, the first thing to read: `tone` is `ok`, `weak` or `bad`, and chooses colour and icon together."""

    tone: str
    word: str
    advice: str = ""
    sentence: str = ""


HEADLINES = {
    "solver_failed": Headline("bad", "No solution"),
    "unobservable": Headline("bad", "Not observable", "do not use"),
    "insufficient_data": Headline("bad", "Not enough data"),
    "weak": Headline("weak", "Weak", "do not rely on it"),
    "ok": Headline("ok", "Trustworthy"),
}
"""Of each status, what needs a look most first."""
_TONES = {Verdict.TRUSTWORTHY: "ok", Verdict.WEAK: "weak", Verdict.UNOBSERVABLE: "bad", None: "open"}


@dataclass(frozen=True)
class Pose:
    """A rigid transform in print.

    Attributes:
        name: `dst_T_src`.
        dst: frame it maps to.
        src: frame it maps from.
        rows: 4 x 4 cells.
        quat_wxyz: four numbers.
        translation_mm: three numbers.
        code: the same at full precision, as Python.
    """

    name: str
    dst: str
    src: str
    rows: tuple[tuple[str, ...], ...]
    quat_wxyz: tuple[str, ...]
    translation_mm: tuple[str, ...]
    code: str


@dataclass(frozen=True)
class AxisRow:
    """Uncertainty along one axis of the camera: 1 sigma of rotation about it and of translation along it."""

    axis: str
    rotation_deg: str
    translation_mm: str


@dataclass(frozen=True)
class Uncertainty:
    """1 sigma of the transform: the roots of the traces, the working point, and each axis."""

    rotation_deg: str
    translation_mm: str
    working_point_mm: str
    axes: tuple[AxisRow, ...]


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


@dataclass(frozen=True)
class Row:
    """One line of a table of names, values and their uncertainty."""

    name: str
    value: str
    sigma: str
    unit: str


def headline(result: CalibrationResult) -> Headline:
    """The verdict in words and a sentence."""
    return replace(HEADLINES[result.status], sentence=STATUS_SENTENCES[result.status])


def pose(name: str, transform: RigidTransform | None) -> Pose | None:
    """A transform in print, or None where there is none."""
    if transform is None:
        return None
    record = transform.to_dict()
    matrix = np.asarray(record["matrix"], dtype=float).reshape(4, 4)
    rows = [(*(fixed(cell, 6) for cell in row[:3]), fixed(row[3], 3)) for row in matrix[:3]]
    quat = np.asarray(record["quat_wxyz"], dtype=float).reshape(4)
    translation = np.asarray(record["translation_mm"], dtype=float).reshape(3)
    return Pose(
        name=name,
        dst=str(record["dst"]),
        src=str(record["src"]),
        rows=(*rows, ("0", "0", "0", "1")),
        quat_wxyz=tuple(fixed(value, 6) for value in quat),
        translation_mm=tuple(fixed(value, 3) for value in translation),
        code=_code(name, str(record["src"]), str(record["dst"]), matrix, quat),
    )


def _code(name: str, src: str, dst: str, matrix: np.ndarray, quat: np.ndarray) -> str:
    rows = "\n".join("    [" + ", ".join(f"{cell: .9f}" for cell in row) + "]," for row in matrix)
    return (
        f"# maps coordinates in {src} to coordinates in {dst}; translation in mm\n"
        f"{name} = [\n{rows}\n]\n"
        f"quat_wxyz = [{', '.join(f'{value:.9f}' for value in quat)}]\n"
        f"translation_mm = [{', '.join(f'{value:.6f}' for value in matrix[:3, 3])}]"
    )


def uncertainty(result: CalibrationResult) -> Uncertainty:
    """The covariance in degrees and millimetres; "unknown" wherever it is absent or not a covariance."""
    covariance = np.full((6, 6), math.nan) if result.covariance is None else np.asarray(result.covariance, dtype=float)
    variances = np.diag(covariance)
    variances = np.where(variances >= 0.0, variances, np.nan)
    sigmas = np.sqrt(variances)
    degrees = np.degrees(sigmas[:3])
    return Uncertainty(
        rotation_deg=significant(math.sqrt(np.sum(degrees**2)), 2),
        translation_mm=significant(math.sqrt(np.sum(variances[3:])), 2),
        working_point_mm=significant(result.observability.working_point_sigma_mm, 2),
        axes=tuple(
            AxisRow(axis, significant(degrees[index], 2), significant(sigmas[3 + index], 2))
            for index, axis in enumerate(AXES)
        ),
    )


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


def nuisances(result: CalibrationResult) -> tuple[Row, ...]:
    """Everything else that was estimated or assumed, with its sigma."""
    return tuple(
        Row(name, significant(entry.value, 4), "" if entry.sigma is None else significant(entry.sigma, 2), entry.unit)
        for name, entry in result.nuisances.items()
    )


def head_point_errors(result: CalibrationResult) -> tuple[tuple[str, ...], ...]:
    """Camera, median, rms, largest (px) and count."""
    errors = result.head_point_error_px or {}
    return tuple(
        (
            camera,
            *(significant(distance) for distance in (error.median, error.rms, error.max)),
            str(error.count),
        )
        for camera, error in errors.items()
    )


def created(result: CalibrationResult) -> str:
    """When the result was made, to the minute or second that it states, for readers rather than parsers."""
    return result.created.replace("T", " ", 1).replace("+00:00", " UTC")


def covariance_text(covariance: np.ndarray | None) -> str:
    """The covariance as six aligned lines, empty where there is none."""
    if covariance is None:
        return ""
    return "\n".join("  ".join(_covariance_cell(cell) for cell in row) for row in covariance)


def _covariance_cell(value: Any) -> str:
    number = finite(value)
    return f"{UNKNOWN:>10}" if number is None else f"{number: .3e}"


def plain_json(value: Any) -> str:
    """Indented JSON for the folded blocks."""
    return json.dumps(finite_or_none(value), indent=2, ensure_ascii=False, default=str)
