"""The page of the morning after: every recording of a batch with its verdict, and every set-up over its recordings."""

import base64
from dataclasses import dataclass
from pathlib import Path, PurePosixPath
from typing import Any
from urllib.parse import quote

import numpy as np
from markupsafe import Markup

from rmis_calib import __version__
from rmis_calib.batches.job_record import RECORD, JobRecord
from rmis_calib.batches.setups import SetupComparison
from rmis_calib.batches.summary import PAGE, BatchSummary, end_of
from rmis_calib.io.atomic import atomic_write
from rmis_calib.io.outputs import check_file, is_report
from rmis_calib.report.charts.repeatability import plot_repeatability
from rmis_calib.report.page import template
from rmis_calib.report.words.answer import Pose, pose
from rmis_calib.report.words.formatting import UNKNOWN, significant
from rmis_calib.report.words.verdict import HEADLINES, Headline

_ENDS = {
    "failed": Headline("bad", "Failed"),
    **HEADLINES,
    "found": Headline("open", "Detected"),
    "not done": Headline("open", "Not done"),
}
"""Each way in which a job can end; what needs a look comes first."""
_RANKS = {end: rank for rank, end in enumerate(_ENDS)}
_RESIDUALS = ("residual_contour_right_px", "residual_contour_left_px")


@dataclass(frozen=True)
class Cell:
    """A number of the table: as shown, and as sorted (empty where it is unknown)."""

    text: str
    order: str


@dataclass(frozen=True)
class PageRow:
    """One recording in the table."""

    name: str
    link: str
    thumbnail: str
    tone: str
    word: str
    rank: int
    end: str
    message: str
    notes: tuple[str, ...]
    cells: tuple[Cell, ...]


@dataclass(frozen=True)
class PageSetup:
    """One set-up in print."""

    name: str
    count: int
    sentences: tuple[str, ...]
    tone: str
    pose: Pose | None
    sigma: str
    plot: Markup | None


HEADINGS = (
    ("error, mm", "predicted, 1 sigma, where the instrument works"),
    ("rotation, deg", "1 sigma, root of the trace"),
    ("translation, mm", "1 sigma, root of the trace"),
    ("used", "motions that entered the estimate"),
    ("of", "motions, or pictures"),
    ("clock, s", "offset between video and joints that was found"),
    ("residual, px", "median distance of the contours from the prediction, the larger one of both cameras"),
    ("time, s", "of everything"),
)


def write_index(folder: Path, summary: BatchSummary, title: str) -> None:
    """Write index.html, whole or not at all. It loads nothing: it opens without a server, and sorts without a network.

    Args:
        folder: the batch's output folder, with the folders of the recordings.
        summary: what to show.
        title: heading.

    Raises:
        OutputError: another file is there, or it cannot be written.
    """
    check_file(folder / PAGE, is_report, overwrite=True)
    rows = sorted((_row(folder, record) for record in summary.records), key=lambda row: row.rank)
    page = template(PAGE, "rmis_calib.batches").render(
        title=title,
        version=__version__,
        tone="ok" if summary.trustworthy else "weak",
        verdict=_verdict(summary),
        counts=[(end, _end(end).tone, _end(end).word, count) for end, count in summary.counts.items()],
        rows=rows,
        headings=HEADINGS,
        setups=[_setup(setup) for setup in summary.setups],
        left_out=summary.left_out,
        not_done=summary.not_done,
        seconds=significant(sum(record.seconds for record in summary.records)),
    )
    with atomic_write(folder / PAGE) as temporary:
        temporary.write_text(page, encoding="utf-8")


def _verdict(summary: BatchSummary) -> str:
    total = len(summary.records) + len(summary.not_done)
    good = sum(record.trustworthy for record in summary.records)
    if summary.trustworthy:
        return f"All {total} recordings can be trusted" if total != 1 else "The recording can be trusted"
    return f"{total - good} of {total} recordings need a look"


def _end(end: str) -> Headline:
    """How a job ended, in words; an end this page does not know, of a later version, counts as bad."""
    return _ENDS.get(end, Headline("bad", end))


def _row(folder: Path, record: JobRecord) -> PageRow:
    end = end_of(record)
    verdict = _end(end)
    row = record.row
    target = folder / PurePosixPath(record.name)
    page = next((name for name in ("report.html", "lines.csv", RECORD) if (target / name).is_file()), None)
    residuals = [row[key] for key in _RESIDUALS if isinstance(row.get(key), (int, float))]
    used = row.get("motions_used", sum(row.get(f"found_{side}", 0) for side in ("right", "left")) if row else None)
    values = (
        row.get("working_point_sigma_mm"),
        row.get("rotation_sigma_deg"),
        row.get("translation_sigma_mm"),
        used,
        row.get("motions", row.get("frames")),
        row.get("clock_s"),
        max(residuals, default=None),
        round(record.seconds, 1),
    )
    return PageRow(
        name=record.name,
        link="" if page is None else quote(f"{record.name}/{page}"),
        thumbnail=_embedded(target / "thumbnail.jpg"),
        tone=verdict.tone,
        word=verdict.word,
        rank=_RANKS.get(end, 0),
        end=end,
        message=record.message,
        notes=tuple(row.get("notes") or ()),
        cells=tuple(_cell(value) for value in values),
    )


def _cell(value: Any) -> Cell:
    if value is None:
        return Cell("", "")
    text = str(value) if isinstance(value, int) else significant(value, 3)
    return Cell("" if text == UNKNOWN else text, repr(float(value)))


def _embedded(path: Path) -> str:
    """A JPEG as a data URI; empty where there is none."""
    try:
        return f"data:image/jpeg;base64,{base64.b64encode(path.read_bytes()).decode('ascii')}"
    except OSError:
        return ""


def _setup(setup: SetupComparison) -> PageSetup:
    pooled = setup.pooled
    plot = None
    if pooled is not None and len(setup.results) > 1:
        sigma = np.sqrt(np.stack([np.diagonal(np.asarray(result.covariance)) for result in setup.results]))
        marks = tuple(change.index for change in setup.changes)
        plot = plot_repeatability(pooled.deviation, sigma, pooled.kept, marks, f"Repeatability, {setup.setup}")
    return PageSetup(
        name=setup.setup,
        count=len(setup.names),
        sentences=tuple(setup.sentences()),
        tone="open"
        if pooled is None or len(setup.names) < 2
        else ("ok" if setup.agrees and not setup.outliers else "weak"),
        pose=pose("camera_right_T_arm", pooled.camera_right_T_arm) if pooled is not None and setup.agrees else None,
        sigma=""
        if pooled is None
        else f"{significant(pooled.rotation_sigma_deg, 2)} deg, {significant(pooled.translation_sigma_mm, 2)} mm",
        plot=plot,
    )
