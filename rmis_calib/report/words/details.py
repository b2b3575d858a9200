"""Everything else that a result holds, in print: unknowns, sizes of residuals, groups, configuration."""

import json
from dataclasses import dataclass
from typing import Any

import numpy as np

from rmis_calib.io.plain_values import finite_or_none
from rmis_calib.report.charts.residuals import COLOURS, robust_scale
from rmis_calib.report.words.formatting import significant, tiny_as_zero, with_sigma
from rmis_calib.results import CalibrationResult, Residual, ResidualTest
from rmis_calib.solver.test_list import HALVES, MEAN, NEAR_IN_JOINTS, NEAR_IN_TIME, TIME, TIME_STEP

_MEASUREMENTS = {
    "contour": "Contours, distance of both edges",
    "axis": "Axis line, distance",
    "end": "Shaft end, distance along the shaft",
    "head": "Head point, distance",
}


_ENDS_AT = {"tube": "end of the dark tube", "ring": "ring that closes it", "unknown": "not told"}
_NO_END = {
    "border": "the shaft leaves the picture",
    "hidden": "something covers the end",
    "unclear": "no clear end",
}
_TESTED_KINDS = ("answer", "clock", "shift", "turn", "width", "taper", "end", "head")
_TESTED_OVER = {
    MEAN: "mean",
    TIME: "time",
    TIME_STEP: "step in time",
    NEAR_IN_TIME: "next motion",
    NEAR_IN_JOINTS: "nearest motion",
    HALVES: "halves",
    "u": "u",
    "v": "v",
    "r2": "r²",
}
"""What residuals are tested over, as the table heads it, joints last."""


@dataclass(frozen=True)
class Row:
    """One unknown or noise level: name, value, uncertainty, unit, and whether its prior holds it."""

    name: str
    value: str
    sigma: str
    unit: str
    held: bool


@dataclass(frozen=True)
class SizeRow:
    """How large residuals of one kind are."""

    title: str
    unit: str
    count: int
    median: str
    rms: str
    robust_scale: str


@dataclass(frozen=True)
class GroupRow:
    """One group of neighbouring motions: its number, colour, size, and what the answer does without it."""

    number: int
    colour: int
    motions: int
    rotation_deg: str
    translation_mm: str
    sigmas: str


@dataclass(frozen=True)
class TestTable:
    """Tests of the residuals.

    Attributes:
        failed: words and sigmas of those that fail.
        causes: likely ones, in words.
        columns: what tests are over.
        rows: each kind with its cells: sigmas, and whether the test fails.
        count: number of tests.
    """

    __test__ = False  # for pytest

    failed: tuple[tuple[str, str], ...]
    causes: tuple[str, ...]
    columns: tuple[str, ...]
    rows: tuple[tuple[str, tuple[tuple[str, bool], ...]], ...]
    count: int


@dataclass(frozen=True)
class EndTable:
    """Where shaft ends were measured.

    Attributes:
        rows: what they were taken for, with their number at the first place, at the second one, and left out.
        gap: how far the second place lies beyond the first one or before it, with 1 sigma; empty where there is one.
        not_measured: why other shafts have no measured end, and how many.
    """

    rows: tuple[tuple[str, tuple[int, int, int]], ...]
    gap: str
    not_measured: tuple[tuple[str, int], ...]


@dataclass(frozen=True)
class PictureRow:
    """What the pictures of one camera show along the predicted contours, px."""

    camera: str
    motions: int
    share: str
    median_px: str
    spread_px: str
    right_px: str
    outward_px: str
    along_right_px: tuple[str, ...]
    along_outward_px: tuple[str, ...]


def unknowns(result: CalibrationResult) -> tuple[Row, ...]:
    """Everything else that was estimated or assumed, with its sigma."""
    rows = []
    for name, entry in result.nuisances.items():
        value, sigma = with_sigma(entry.value, entry.sigma)
        rows.append(Row(name, value, "" if entry.sigma is None else sigma, entry.unit, bool(entry.held)))
    return tuple(rows)


def unknowns_summary(rows: tuple[Row, ...]) -> str:
    """How many there are of each kind."""
    estimated = sum(bool(row.sigma) for row in rows)
    held = sum(row.held for row in rows)
    said = [f"{estimated} unknown{'s' if estimated != 1 else ''}"]
    if held:
        said.append(f"{held} of them held by {'its' if held == 1 else 'their'} prior{'' if held == 1 else 's'}")
    if len(rows) > estimated:
        said.append(f"{len(rows) - estimated} level{'s' if len(rows) - estimated != 1 else ''} without a sigma")
    return ", ".join(said)


def residual_sizes(result: CalibrationResult) -> tuple[SizeRow, ...]:
    """Each kind of residual, in the order of the result."""
    return tuple(_size(kind, entry, result) for kind, entry in result.residuals.items())


def _size(kind: str, entry: Residual, result: CalibrationResult) -> SizeRow:
    measurement, _, camera = kind.rpartition("_")
    known = measurement in _MEASUREMENTS and camera in ("right", "left")
    used = np.asarray(result.motions.used, dtype=bool)
    used = used if len(used) == len(entry.by_motion) and measurement != "head" else np.ones(len(entry.by_motion), bool)
    counted = entry.by_motion[np.isfinite(entry.by_motion) & used]
    return SizeRow(
        title=f"{_MEASUREMENTS[measurement]}, {camera} camera" if known else kind,
        unit=entry.unit,
        count=len(counted),
        median=tiny_as_zero(entry.median),
        rms=tiny_as_zero(entry.rms),
        robust_scale=tiny_as_zero(robust_scale(counted) if len(counted) else None),
    )


def shaft_ends(result: CalibrationResult) -> EndTable | None:
    """Where the shaft's end was measured, and what it ends at where it was not; None without ends."""
    ends = result.ends
    if ends is None:
        return None
    rows = tuple(
        (_ENDS_AT[kind], (counts.first_place, counts.second_place, counts.left_out))
        for kind, counts in ends.by_kind.items()
    )
    gap = ""
    if ends.gap_mm is not None:
        size, sigma = with_sigma(abs(ends.gap_mm), ends.gap_sigma_mm)
        gap = f"{size} ± {sigma} mm {'beyond' if ends.gap_mm > 0 else 'before'}"
    unseen = tuple((_NO_END[why], count) for why, count in ends.not_measured.items())
    return EndTable(rows, gap, unseen)


def groups(result: CalibrationResult) -> tuple[GroupRow, ...]:
    """Groups of neighbouring motions, as residuals are coloured by."""
    if result.consistency is None:
        return ()
    return tuple(
        GroupRow(
            number=number,
            colour=number % COLOURS,
            motions=group.motions,
            rotation_deg=significant(group.rotation_deg, 2),
            translation_mm=significant(group.translation_mm, 2),
            sigmas=significant(group.sigmas, 2),
        )
        for number, group in enumerate(result.consistency.groups)
    )


def residual_tests(result: CalibrationResult) -> TestTable | None:
    """The tests of the residuals: kinds down, what they are over across; None without tests."""
    if result.tests is None or not result.tests.tests:
        return None
    by_name = {(test.kind, test.over): test for test in result.tests.tests}
    kinds = dict.fromkeys(sorted({kind for kind, _ in by_name}, key=_kind_order))
    overs = list(dict.fromkeys(over for over in (*_TESTED_OVER, *sorted({over for _, over in by_name}))))
    overs = [over for over in overs if any((kind, over) in by_name for kind in kinds)]
    rows = tuple((kind.replace("_", " "), tuple(_cell(by_name.get((kind, over))) for over in overs)) for kind in kinds)
    columns = tuple(_TESTED_OVER.get(over, over.replace("_", " ")) for over in overs)
    failed = tuple(
        (f"{test.words[:1].upper()}{test.words[1:]}", significant(test.statistic, 2)) for test in result.tests.failed
    )
    return TestTable(failed, result.tests.causes, columns, rows, len(by_name))


def _kind_order(kind: str) -> tuple[int, str]:
    """Those that every recording has first."""
    first = [name for name in _TESTED_KINDS if kind.startswith(name)]
    return (_TESTED_KINDS.index(first[0]) if first else len(_TESTED_KINDS), kind)


def _cell(test: ResidualTest | None) -> tuple[str, bool]:
    """Sigmas, and whether the test fails."""
    return ("", False) if test is None or test.statistic is None else (f"{test.statistic:.1f}", test.failed)


def head_point_errors(result: CalibrationResult) -> tuple[tuple[str, ...], ...]:
    """Camera, median, rms, largest (px) and count."""
    errors = result.head_point_error_px or {}
    return tuple(
        (camera, *(significant(distance) for distance in (error.median, error.rms, error.max)), str(error.count))
        for camera, error in errors.items()
    )


def picture_rows(result: CalibrationResult) -> tuple[PictureRow, ...]:
    """What the pictures show along the predicted contours, a row a camera."""
    if result.picture is None:
        return ()
    return tuple(
        PictureRow(
            camera=camera,
            motions=view.motions,
            share=f"{100.0 * view.edge_share:.0f} %",
            median_px=significant(view.median_px, 2),
            spread_px=significant(view.spread_px, 2),
            right_px=significant(view.right_px, 2),
            outward_px=significant(view.outward_px, 2),
            along_right_px=tuple(_pixels(px) for px in view.along_right_px.tolist()),
            along_outward_px=tuple(_pixels(px) for px in view.along_outward_px.tolist()),
        )
        for camera, view in result.picture.views.items()
    )


def _pixels(px: float) -> str:
    return f"{px:+.2f}".replace("-", "−") if np.isfinite(px) else ""


def created(result: CalibrationResult) -> str:
    """When the result was made, to the minute or second that it states, for readers rather than parsers."""
    return result.created.replace("T", " ", 1).replace("+00:00", " UTC")


def plain_json(value: Any) -> str:
    """Indented JSON for the folded blocks."""
    return json.dumps(finite_or_none(value), indent=2, ensure_ascii=False, default=str)
