"""What a person sees while a command runs: progress on a terminal, plain lines in a log, and the table at the end."""

import os
import sys
import time
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from datetime import datetime
from pathlib import Path
from typing import TYPE_CHECKING, Any

from rich.console import Console
from rich.progress import BarColumn, MofNCompleteColumn, Progress, TextColumn, TimeRemainingColumn
from rich.table import Table

from rmis_calib import __version__
from rmis_calib.cli import EXIT_NOT_TRUSTWORTHY, EXIT_OK

if TYPE_CHECKING:
    from rmis_calib.batches.pooling import Pooled
    from rmis_calib.pipeline import RecordingCheck
    from rmis_calib.results import CalibrationResult, Nuisance

ProgressCallback = Callable[[str, int, int], None]
LOG_INTERVAL_S = 5.0

# NO_COLOR takes all styles away, not the colours alone, as rich would.
console = Console(highlight=False, color_system=None if os.environ.get("NO_COLOR") else "auto")


@contextmanager
def progress_reporter() -> Iterator[ProgressCallback]:
    """A callback `(stage, done, total)`: bars on a terminal, one line a stage and every few seconds elsewhere."""
    if not sys.stderr.isatty():
        yield _line_reporter()
        return
    columns = (TextColumn("{task.description:<22}"), BarColumn(), MofNCompleteColumn(), TimeRemainingColumn())
    tasks: dict[str, Any] = {}
    with Progress(*columns, console=Console(stderr=True)) as progress:

        def report(stage: str, done: int, total: int) -> None:
            if stage not in tasks:
                tasks[stage] = progress.add_task(stage, total=total)
            progress.update(tasks[stage], completed=done, total=total)

        yield report


def _line_reporter() -> ProgressCallback:
    last: dict[str, float] = {}

    def report(stage: str, done: int, total: int) -> None:
        now = time.monotonic()
        if stage in last and done < total and now - last[stage] < LOG_INTERVAL_S:
            return
        if done == total and last.get(stage) == float("inf"):
            return
        last[stage] = float("inf") if done == total else now
        print(f"{stage}: {done}/{total}", file=sys.stderr, flush=True)

    return report


def print_table(title: str, rows: list[tuple[str, str]]) -> None:
    """Two columns: what, and how much with its unit. Wrapped on a terminal only, so that a log keeps paths whole."""
    console.print(title, soft_wrap=True)
    if not console.is_terminal:
        widest = max((len(name) for name, _ in rows), default=0)
        for name, value in rows:
            say(f"{name:<{widest}}  {value.replace(chr(10), chr(10) + ' ' * (widest + 2))}")
        return
    table = Table(show_header=False, box=None, padding=(0, 2, 0, 0))
    for name, value in rows:
        table.add_row(name, value)
    console.print(table)


def time_left(seconds: float | None) -> str:
    """Seconds left, in words."""
    if seconds is None:
        return "time left not known yet"
    hours, rest = divmod(round(seconds), 3600)
    minutes, seconds = divmod(rest, 60)
    return (
        f"{hours} h {minutes} min left"
        if hours
        else f"{minutes} min {seconds} s left"
        if minutes
        else f"{seconds} s left"
    )


def print_advice(sentences: Sequence[str]) -> None:
    """What would make the next recording better, one line a step; nothing where there is no advice."""
    if sentences:
        console.print("what to record next", soft_wrap=True)
        for sentence in sentences:
            console.print(f"  {sentence}", soft_wrap=True, markup=False)
        console.print()


def say(line: str) -> None:
    """One line on standard output, as it is: a folder may be called [bold]."""
    console.print(line, soft_wrap=True, markup=False)


def conclude(result: "CalibrationResult") -> None:
    """Print the answer."""
    console.print(result.status, style="bold", end="")
    say(f": {result.message}\n")
    print_table(result.camera_right_T_arm.name if result.camera_right_T_arm else "no transform", result_rows(result))
    for note in result.notes:
        say(f"note: {note}")
    if not result.trustworthy:
        print_advice(result.observability.advice)
    say("")


def summarise(what: str, *facts: str | None) -> None:
    """The last line, to be pasted into a lab book: when, which version, what was done, what came out, where it is."""
    when = datetime.now().astimezone().isoformat(" ", "minutes")
    say(f"{when} rmis-calib {__version__} {what}: {'; '.join(fact for fact in facts if fact)}")


def summarise_result(what: str, result: "CalibrationResult", written: Path) -> int:
    """The same for a calibration; the exit code says whether to trust it."""
    used = f"{int(result.motions.used.sum())} of {len(result.motions.used)} motions, method {result.method}"
    summarise(what, result.status, *transform_facts(result), used, f"written to {written}")
    return EXIT_OK if result.trustworthy else EXIT_NOT_TRUSTWORTHY


def transform_facts(found: "CalibrationResult | Pooled") -> list[str]:
    """A transform and its uncertainty in one line; nothing where there is none."""
    facts, transform = [], found.camera_right_T_arm
    if transform is not None:
        position = ", ".join(f"{x:.3f}" for x in transform.matrix[:3, 3].tolist())
        turn = ", ".join(f"{x:.6f}" for x in transform.quat_wxyz.tolist())
        facts.append(f"{transform.name}: t = ({position}) mm, q_wxyz = ({turn})")
    if found.rotation_sigma_deg is not None and found.translation_sigma_mm is not None:
        facts.append(f"1 sigma {found.rotation_sigma_deg:.3f} deg, {found.translation_sigma_mm:.3f} mm")
    return facts


def conclude_check(check: "RecordingCheck", recording: Path) -> int:
    """Print what was found in a recording, the exit code says whether there are any."""
    rows = [
        (finding.topic, f"DOUBT: {finding.sentence}" if finding.is_doubt else finding.sentence)
        for finding in check.findings
    ]
    print_table(f"what can be said of {recording} before it is calibrated", rows)
    for note in check.notes:
        say(f"note: {note}")
    count = len(check.doubts)
    verdict = "nothing speaks against calibrating it" if check.fit else f"{count} doubt{'s' if count > 1 else ''}"
    summarise(f"check {recording}", verdict)
    return EXIT_OK if check.fit else EXIT_NOT_TRUSTWORTHY


def result_rows(result: "CalibrationResult") -> list[tuple[str, str]]:
    """The answer with frames, units and uncertainty."""
    from rmis_calib.results import INTRINSICS

    rows: list[tuple[str, str]] = []
    transform = result.camera_right_T_arm
    if transform is not None:
        matrix = transform.matrix.tolist()
        lines = ["".join(f"{x:10.6f}" for x in row[:3]) + f"{row[3]:12.4f}" for row in matrix[:3]]
        rows.append(("rotation | translation, mm", "\n".join(lines)))
        rows.append(("quaternion wxyz", "".join(f"{x:10.6f}" for x in transform.quat_wxyz.tolist())))
    if result.rotation_sigma_deg is not None and result.translation_sigma_mm is not None:
        rows.append(("1 sigma", f"{result.rotation_sigma_deg:.3f} deg, {result.translation_sigma_mm:.3f} mm"))
    used, total = int(result.motions.used.sum()), len(result.motions.used)
    rows.append(("motions used", f"{used} of {total} (method {result.method})"))
    rows += [(f"  {count} rejected", reason) for reason, count in result.motions.rejected_by_reason.items()]
    for kind, residual in result.residuals.items():
        if residual.median is not None:
            rows.append((f"residual, {kind.replace('_', ' ')}", f"median {residual.median:.3g} {residual.unit}"))
    for name, nuisance in result.nuisances.items():
        # Hundredths of a pixel, and corrections that are said in words where they matter: for result.json and report.
        if name.startswith("edge_bias") or name.partition(" ")[0] in INTRINSICS:
            continue
        sigma = "" if nuisance.sigma is None else f" +- {nuisance.sigma:.2g}"
        held = " (held by its prior)" if nuisance.held else ""
        rows.append((name.replace("_", " "), f"{_value(nuisance)}{sigma} {nuisance.unit}{held}"))
    return rows


def _value(nuisance: "Nuisance") -> str:
    if nuisance.value is None:
        return "unknown"
    is_rounding = abs(nuisance.value) < 1e-9 * (nuisance.sigma or 0.0)
    return f"{0.0 if is_rounding else nuisance.value:.4g}"
