"""What a person sees while a command runs: progress on a terminal, plain lines in a log, and the table at the end."""

import sys
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from typing import Any

from rich.console import Console
from rich.progress import BarColumn, MofNCompleteColumn, Progress, TextColumn, TimeRemainingColumn
from rich.table import Table

ProgressCallback = Callable[[str, int, int], None]
LOG_INTERVAL_S = 5.0

console = Console(highlight=False)


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
    """Two columns: what, and how much with its unit."""
    console.print(title, soft_wrap=True)
    table = Table(show_header=False, box=None, padding=(0, 2, 0, 0))
    for name, value in rows:
        table.add_row(name, value)
    console.print(table)


def print_advice(sentences: list[str]) -> None:
    """What would make the next recording better, one line a step; nothing where there is no advice."""
    if sentences:
        console.print("what to record next", soft_wrap=True)
        for sentence in sentences:
            console.print(f"  {sentence}", soft_wrap=True, markup=False)
        console.print()
