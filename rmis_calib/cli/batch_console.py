"""What a person sees of a batch: a bar for each recording at work and one for all, the counts at the end."""

import signal
import sys
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from typing import TYPE_CHECKING, Any

from rich.console import Console
from rich.progress import BarColumn, TextColumn
from rich.progress import Progress as Bars

from rmis_calib.cli import EXIT_NOT_TRUSTWORTHY, EXIT_OK
from rmis_calib.cli.console import LOG_INTERVAL_S, print_table, say, summarise, time_left, transform_facts

if TYPE_CHECKING:
    from pathlib import Path

    from rmis_calib.batches import BatchSummary, Progress, SetupComparison
    from rmis_calib.batches.plan import Plan
    from rmis_calib.results import CalibrationResult

_NAME_WIDTH = 34


@contextmanager
def batch_reporter() -> Iterator["Callable[[Progress], None]"]:
    """A callback for the events of a batch: bars on a terminal, a line a recording and every few seconds elsewhere."""
    if not sys.stderr.isatty():
        yield _line_reporter()
        return
    columns = (TextColumn("{task.description}"), BarColumn(), TextColumn("{task.fields[note]}"))
    with Bars(*columns, console=Console(stderr=True)) as bars:
        whole = bars.add_task(_cut("all recordings"), total=None, note="")
        rows: dict[int, Any] = {}

        def report(progress: "Progress") -> None:
            event = progress.event
            if event.index not in rows:
                rows[event.index] = bars.add_task(_cut(progress.name), total=None, note="")
            if event.kind == "progress":
                stage, done, total = event.value
                bars.update(rows[event.index], completed=done, total=total, note=stage)
            if progress.record is not None:
                bars.remove_task(rows.pop(event.index))
                bars.console.print(_end_line(progress), markup=False, highlight=False, soft_wrap=True)
            note = f"{progress.done_jobs} of {progress.jobs}, {time_left(progress.left_s)}"
            bars.update(whole, completed=progress.frames_done, total=progress.frames or None, note=note)

        yield report


def _line_reporter() -> "Callable[[Progress], None]":
    last = 0.0

    def report(progress: "Progress") -> None:
        nonlocal last
        if progress.record is not None:
            print(_end_line(progress), file=sys.stderr, flush=True)
        elif time.monotonic() - last >= LOG_INTERVAL_S and progress.event.kind == "progress":
            stage, done, total = progress.event.value
            where = f"{progress.done_jobs} of {progress.jobs} recordings, {time_left(progress.left_s)}"
            print(f"{where}; {progress.name}: {stage} {done}/{total}", file=sys.stderr, flush=True)
        else:
            return
        last = time.monotonic()

    return report


def _end_line(progress: "Progress") -> str:
    record = progress.record
    assert record is not None
    return f"[{progress.done_jobs}/{progress.jobs}] {record.name} ({record.seconds:.1f} s): {record.line}"


def _cut(name: str) -> str:
    return f"{name if len(name) <= _NAME_WIDTH else '…' + name[1 - _NAME_WIDTH :]:<{_NAME_WIDTH}}"


@contextmanager
def stopped_by_signal(watches: bool) -> Iterator[Callable[[], bool]]:
    """Whether Ctrl-C or SIGTERM asked a watch to end: it finishes what it does, and concludes. A batch that does not
    watch is interrupted at once."""
    if not watches:
        yield lambda: False
        return
    asked: list[int] = []
    before = {number: signal.getsignal(number) for number in (signal.SIGINT, signal.SIGTERM)}
    for number in before:
        signal.signal(number, lambda received, _: asked.append(received))
    try:
        yield lambda: bool(asked)
    finally:
        for number, handler in before.items():
            signal.signal(number, handler)


def say_plan(plan: "Plan") -> int:
    """What a batch would do; nothing to do is no mistake."""
    for order, why in plan.orders:
        say(f"would {order.job.task} {order.job.name} ({order.job.source}, found by its {order.job.why}): {why}")
    for record in plan.done:
        say(f"done before: {record.name}: {record.message}")
    for item in plan.left_out:
        say(f"left out: {item.path}: {item.why}")
    say(f"{len(plan.orders)} to do, {len(plan.done)} done before, {len(plan.left_out)} left out; nothing was written")
    return EXIT_OK


def conclude_batch(what: str, summary: "BatchSummary", page: "Path") -> int:
    """Counts, what needs a look with its cause, what set-ups show; the exit code says whether all can be trusted."""
    print_table("recordings", [(end.replace("_", " "), str(count)) for end, count in summary.counts.items()])
    for record in summary.records:
        if not record.trustworthy:
            say(f"{record.name}: {record.line}")
    for name in summary.not_done:
        say(f"{name}: not begun")
    for setup in summary.setups:
        if len(setup.names) > 1:
            say(f"\n{setup.setup}")
            for sentence in setup.sentences():
                say(f"  {sentence}")
    say("")
    counts = [f"{count} {end.replace('_', ' ')}" for end, count in summary.counts.items() if count]
    summarise(what, *counts, f"written to {page}")
    return EXIT_OK if summary.trustworthy else EXIT_NOT_TRUSTWORTHY


def conclude_comparison(comparison: "SetupComparison", results: "dict[str, CalibrationResult]") -> int:
    """The pooled transform and each result about it; exit code 0 where all results agree."""
    import numpy as np

    for name, result in results.items():
        if name not in comparison.names and name not in dict(comparison.copies):
            say(f"{name}: {result.status}, left out")
    if comparison.pooled is not None:
        pooled = comparison.pooled
        rows = []
        for name, moved, keep in zip(comparison.names, pooled.deviation, pooled.kept, strict=True):
            turn, shift = np.degrees(np.linalg.norm(moved[:3])), np.linalg.norm(moved[3:])
            sigma = results[name]
            predicted = f"predicted {sigma.rotation_sigma_deg:.2g} deg, {sigma.translation_sigma_mm:.2g} mm"
            rows.append((name, f"{turn:.3g} deg, {shift:.3g} mm away; {predicted}{'' if keep else '; does not fit'}"))
        print_table("from the pooled transform", rows)
        if comparison.answer is not None:
            matrix = pooled.camera_right_T_arm.matrix.tolist()
            lines = ["".join(f"{x:10.6f}" for x in row[:3]) + f"{row[3]:12.4f}" for row in matrix[:3]]
            sigma = f"{pooled.rotation_sigma_deg:.3f} deg, {pooled.translation_sigma_mm:.3f} mm"
            print_table(
                "pooled camera_right_T_arm", [("rotation | translation, mm", "\n".join(lines)), ("1 sigma", sigma)]
            )
    sentences = comparison.sentences()
    for sentence in sentences:
        say(sentence)
    all_fit = comparison.agrees and len(comparison.names) == len(results) and not comparison.outliers
    facts = [f"{len(comparison.names)} of {len(results)} usable", *(sentence.rstrip(".") for sentence in sentences[:1])]
    if comparison.pooled is not None and comparison.answer is not None:
        facts += transform_facts(comparison.pooled)
    summarise(f"compare {', '.join(results)}", *facts)
    return EXIT_OK if all_fit else EXIT_NOT_TRUSTWORTHY
