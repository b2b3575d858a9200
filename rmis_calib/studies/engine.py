"""Works through the cells of a study: passes over what is stored, and does the rest side by side."""

import time
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Any

from rmis_calib.errors import InputError, OutputError, RmisCalibError
from rmis_calib.io.outputs import check_file, is_json_of, is_report
from rmis_calib.parallel.lock import locked
from rmis_calib.parallel.processes import Event, Limits, cores, free_memory_bytes, run_tasks
from rmis_calib.studies.cells import run_cell
from rmis_calib.studies.settings import RunSettings

if TYPE_CHECKING:
    import pyarrow

STUDY_FORMAT = "rmis-calib-study/1"
RECORD, PAGE, STORE = "study.json", "index.html", "cells"
_RETRIES = 2
_MEMORY_SHARE = 0.9
_SHARE_TO_JUDGE_BY = 0.01
"""Before so much is done, start-up would pass for the speed."""


@dataclass(frozen=True)
class Progress:
    """How far a study is.

    Attributes:
        done, total: cells of this run.
        stored: cells that were there before.
        share: of the work of this run that is done, 0 to 1, unfinished cells included.
        left_s: seconds left; None before anything is known.
    """

    done: int
    total: int
    stored: int
    share: float
    left_s: float | None


Watcher = Callable[[Progress], None]


@contextmanager
def study_folder(out: Path, kind: str, names: Sequence[str]) -> Iterator[Path]:
    """The folder of a study, new or to go on with, locked; gives the store of its cells.

    Args:
        out: folder.
        kind: of study.
        names: files that the study writes beside its record and its page.

    Raises:
        OutputError: the folder holds what is not of such a study, or another one is at work in it.
    """
    if out.exists() and not out.is_dir():
        raise OutputError(where=str(out), expected="a folder to write", found="a file")
    if out.is_dir() and any(out.iterdir()):
        record = out / RECORD
        if not is_json_of(STUDY_FORMAT)(record) or f'"study": "{kind}"' not in record.read_text(encoding="utf-8"):
            expected = f"a new folder, or one of a {kind} study to go on with"
            raise OutputError(where=str(out), expected=expected, found="a folder with other content")
    check_file(out / PAGE, is_report, overwrite=True)
    for name in names:
        check_file(out / name, lambda _: (out / RECORD).is_file(), overwrite=True)
    try:
        (out / STORE).mkdir(parents=True, exist_ok=True)
    except OSError as error:
        raise OutputError(where=str(out), expected="a place that can be written", found=error.strerror) from error
    with locked(out, "study"):
        for remains in (out / STORE).glob(".*.tmp*"):  # of a study that was killed while it wrote
            remains.unlink(missing_ok=True)
        yield out / STORE


def run_cells(cells: Sequence[Any], run: RunSettings, progress: Watcher, work: Any = run_cell) -> "pyarrow.Table":
    """Do what is not stored yet, and gather the rows of all cells.

    Args:
        cells: of the study (`Cell`, `Experiment`): a dataclass with `parts` and a `weight`.
        run: workers or cluster.
        progress: called when a cell ends or gets on.
        work: does a cell; returns what went wrong.

    Raises:
        InputError: a method, a noise source or an extension that does not work.
        RmisCalibError: a worker died with its cell more often than it may.
    """
    missing = [replace(cell, parts=tuple(part for part in cell.parts if not part.path.exists())) for cell in cells]
    todo = [cell for cell in missing if cell.parts]
    meter = _Meter([cell.weight for cell in todo], len(cells) - len(todo), progress)
    meter.tell()
    events = _events(todo, run, work, meter.advance)
    try:
        for event in events:
            if event.kind == "died":
                raise RmisCalibError(f"study: {event.value}; the same command goes on where it stopped")
            if event.kind == "progress":
                meter.advance(event.index, *event.value)
            if event.kind == "finished":
                if event.value:
                    raise InputError(event.value)
                meter.finish(event.index)
    finally:
        events.close()
    return _gathered(cells)


class _Meter:
    """How far the cells of a run are, by their weights."""

    def __init__(self, weights: Sequence[int], stored: int, progress: Watcher) -> None:
        self._weights, self._shares = weights, [0.0] * len(weights)
        self._stored, self._progress = stored, progress
        self._done, self._begun = 0, time.monotonic()

    def advance(self, index: int, _: str, done: int, total: int) -> None:
        """A cell has done so much of its work."""
        self._shares[index] = max(self._shares[index], min(1.0, done / max(1, total)))
        self.tell()

    def finish(self, index: int) -> None:
        self._shares[index], self._done = 1.0, self._done + 1
        self.tell()

    def tell(self) -> None:
        share = sum(w * s for w, s in zip(self._weights, self._shares, strict=True)) / (sum(self._weights) or 1.0)
        is_known = share > _SHARE_TO_JUDGE_BY
        left_s = (time.monotonic() - self._begun) * (1.0 - share) / share if is_known else None
        self._progress(Progress(self._done, len(self._weights), self._stored, share, left_s))


def _events(todo: Sequence[Any], run: RunSettings, work: Any, advance: Callable[..., None]) -> Any:
    workers = min(run.workers or cores(), max(1, len(todo)))
    if not todo or (workers == 1 and run.cluster is None):
        return _in_this_process(todo, work, advance)
    free = free_memory_bytes()
    limits = Limits(
        threads=max(1, cores() // workers),
        memory_bytes=None if free is None else max(2**31, int(_MEMORY_SHARE * free / workers)),
        timeout_s=None,
        retries=_RETRIES,
    )
    if run.cluster is not None:
        from rmis_calib.parallel import cluster

        return cluster.run_tasks(todo, work, run.cluster, workers, limits)
    return run_tasks(todo, work, workers, limits)


def _in_this_process(todo: Sequence[Any], work: Any, advance: Callable[..., None]) -> Iterator[Event]:
    for index, cell in enumerate(todo):
        yield Event(index, "finished", work(cell, partial(advance, index)), 1, 0)


def _gathered(cells: Sequence[Any]) -> "pyarrow.Table":
    """All rows, in the order of the cells."""
    import pyarrow
    import pyarrow.parquet

    paths = [part.path for cell in cells for part in cell.parts]
    for path in paths:
        if not path.is_file():
            found = "nothing: do all workers share the output folder?"
            raise OutputError(where=str(path), expected="the trials that a worker stored", found=found)
    try:
        return pyarrow.concat_tables([pyarrow.parquet.read_table(path) for path in paths])
    except (pyarrow.ArrowInvalid, OSError) as error:
        raise OutputError(where=str(paths[0].parent), expected="stored trials", found=str(error)) from error
