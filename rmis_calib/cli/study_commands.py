"""The studies: each a sub-command of `study`, with its settings as flags."""

import re
import shlex
import sys
import time
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import TYPE_CHECKING, Any

import tyro
from rich.console import Console
from rich.progress import BarColumn, TextColumn
from rich.progress import Progress as Bars

from rmis_calib.cli import EXIT_BAD_INPUT, EXIT_NOT_TRUSTWORTHY, EXIT_OK, help_page
from rmis_calib.cli.console import LOG_INTERVAL_S, say, summarise, time_left
from rmis_calib.cli.usage import parse_arguments
from rmis_calib.errors import InputError
from rmis_calib.io.configs import did_you_mean
from rmis_calib.studies.settings import (
    ComparisonStudySettings,
    MotionsStudySettings,
    NoiseStudySettings,
    PlanSettings,
    ReprojectionStudySettings,
)

if TYPE_CHECKING:
    from rmis_calib.studies.engine import Progress
    from rmis_calib.studies.output import StudyResult
    from rmis_calib.studies.page import Table


@dataclass(frozen=True, kw_only=True)
class _Study:
    """What every study has."""

    command: tyro.conf.Suppress[str | None] = None
    """How the program was called, for the outputs."""


@dataclass(frozen=True, kw_only=True)
class Noise(_Study):
    """Error against the noise coefficient, by method and number of cameras, with the Cramer-Rao bound (Fig. 2).

    Writes OUT/index.html, noise.pdf, noise.png, trials.csv, trials.parquet and summary.csv. Started again in the same
    folder, it goes on where it stopped.
    """

    out: Path = Path("study_noise")
    """Folder to write, or to go on with."""
    settings: tyro.conf.OmitArgPrefixes[NoiseStudySettings] = field(default_factory=NoiseStudySettings)

    def run(self) -> int:
        from rmis_calib.studies import study_noise

        with study_reporter() as progress:
            return conclude_study(study_noise(self.out, self.settings, progress=progress, command=self.command))


@dataclass(frozen=True, kw_only=True)
class Motions(_Study):
    """Error against the number of motions, for every split over the two arms, by method and number of cameras (Fig. 3).

    Writes OUT/index.html, motions_mono and motions_stereo (.pdf, .png), trials.csv, trials.parquet and summary.csv.
    Started again in the same folder, it goes on where it stopped.
    """

    out: Path = Path("study_motions")
    """Folder to write, or to go on with."""
    settings: tyro.conf.OmitArgPrefixes[MotionsStudySettings] = field(default_factory=MotionsStudySettings)

    def run(self) -> int:
        from rmis_calib.studies import study_motions

        with study_reporter() as progress:
            return conclude_study(study_motions(self.out, self.settings, progress=progress, command=self.command))


@dataclass(frozen=True, kw_only=True)
class Plan(_Study):
    """How many motions a wanted error at the working point takes, on your robot and with your cameras.

    Writes OUT/index.html, plan.pdf, plan.png, trials.csv, trials.parquet and summary.csv. Exit code 1 where no number
    of motions suffices.
    """

    out: Path = Path("study_plan")
    """Folder to write, or to go on with."""
    settings: tyro.conf.OmitArgPrefixes[PlanSettings] = field(default_factory=PlanSettings)

    def run(self) -> int:
        from rmis_calib.studies import study_plan

        with study_reporter() as progress:
            return conclude_study(study_plan(self.out, self.settings, progress=progress, command=self.command))


@dataclass(frozen=True, kw_only=True)
class Reprojection(_Study):
    """Head-point error in pixels against the number of motions, on rendered pictures (Fig. 5).

    Writes OUT/index.html, reprojection.pdf, reprojection.png, trials.csv, trials.parquet and summary.csv. Started again
    in the same folder, it goes on where it stopped.
    """

    out: Path = Path("study_reprojection")
    """Folder to write, or to go on with."""
    settings: tyro.conf.OmitArgPrefixes[ReprojectionStudySettings] = field(default_factory=ReprojectionStudySettings)

    def run(self) -> int:
        from rmis_calib.studies import study_reprojection

        with study_reporter() as progress:
            return conclude_study(study_reprojection(self.out, self.settings, progress=progress, command=self.command))


@dataclass(frozen=True, kw_only=True)
class Comparison(_Study):
    """Calibration from the instrument against calibration with a board, through the same narrow motion (Fig. 6).

    Writes OUT/index.html, comparison_motions and comparison_experiments (.pdf, .png), trials.csv, trials.parquet and
    summary.csv. Started again in the same folder, it goes on where it stopped.
    """

    out: Path = Path("study_comparison")
    """Folder to write, or to go on with."""
    settings: tyro.conf.OmitArgPrefixes[ComparisonStudySettings] = field(default_factory=ComparisonStudySettings)

    def run(self) -> int:
        from rmis_calib.studies import study_comparison

        with study_reporter() as progress:
            return conclude_study(study_comparison(self.out, self.settings, progress=progress, command=self.command))


STUDIES: dict[str, tuple[type, str]] = {
    "noise": (Noise, "error against noise, by method and number of cameras (Fig. 2)"),
    "motions": (Motions, "error against the number of motions, by which arm moves (Fig. 3)"),
    "reprojection": (Reprojection, "head-point error in pixels, from rendered pictures (Fig. 5)"),
    "comparison": (Comparison, "instrument against calibration board (Fig. 6)"),
    "plan": (Plan, "how many motions a wanted accuracy takes"),
}


def parse_study(argv: Sequence[str]) -> Any:
    """The study that the words after `study` ask for.

    Raises:
        SystemExit: help was asked for, and printed.
        InputError: no such study, or a word that is not understood.
    """
    if not argv:
        print(help_page("study"), end="")
        raise SystemExit(EXIT_BAD_INPUT)
    name = argv[0]
    if name not in STUDIES:
        found = f"{name!r}{did_you_mean(name, list(STUDIES))}"
        raise InputError(where="rmis-calib study", expected=f"one of {', '.join(STUDIES)}", found=found)
    try:
        parsed = parse_arguments(STUDIES[name][0], argv[1:], f"rmis-calib study {name}")
        return replace(parsed, command=shlex.join(["rmis-calib", "study", *argv]))
    except InputError as error:
        where = re.sub(r"^--(run|setup|pictures)\.", "--", error.where)  # the flags have no groups in their names
        raise InputError(where=where, expected=error.expected, found=error.found) from None


@contextmanager
def study_reporter() -> Iterator[Callable[["Progress"], None]]:
    """A callback for the progress of a study: a bar on a terminal, a line every few seconds elsewhere."""
    if not sys.stderr.isatty():
        yield _line_reporter()
        return
    columns = (TextColumn("{task.description}"), BarColumn(), TextColumn("{task.fields[note]}"))
    with Bars(*columns, console=Console(stderr=True)) as bars:
        whole = bars.add_task("cells", total=None, note="")

        def report(progress: "Progress") -> None:
            bars.update(whole, completed=progress.share, total=1.0, note=_how_far(progress))

        yield report


def _line_reporter() -> Callable[["Progress"], None]:
    last = 0.0

    def report(progress: "Progress") -> None:
        nonlocal last
        if not last or progress.done == progress.total or time.monotonic() - last >= LOG_INTERVAL_S:
            last = time.monotonic()
            print(_how_far(progress), file=sys.stderr, flush=True)

    return report


def _how_far(progress: "Progress") -> str:
    stored = f" ({progress.stored} stored before)" if progress.stored else ""
    left = "" if progress.done == progress.total else f", {100 * progress.share:.0f} %, {time_left(progress.left_s)}"
    return f"{progress.done} of {progress.total} cells{stored}{left}"


def conclude_study(result: "StudyResult") -> int:
    """What was found, and where it is."""
    for table in result.tables:
        _print_table(table)
    for sentence in result.sentences:
        say(sentence)
    found = (sentence.rstrip(".") for sentence in result.sentences[:1])
    summarise(f"study {result.kind}", *found, f"written to {result.page}")
    return EXIT_OK if result.reached else EXIT_NOT_TRUSTWORTHY


def _print_table(table: "Table") -> None:
    """Columns side by side, as wide as they need."""
    say(table.title)
    widths = [max(len(row[i]) for row in (table.headings, *table.rows)) for i in range(len(table.headings))]
    for row in (table.headings, *table.rows):
        say("  " + "  ".join(f"{cell:<{width}}" for cell, width in zip(row, widths, strict=True)).rstrip())
    say("")
