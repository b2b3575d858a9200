"""A batch from end to end: find the work, pass over what is done, work through the rest, and summarise."""

import json
import logging
import shutil
import time
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, replace
from pathlib import Path, PurePosixPath

from rmis_calib import __version__
from rmis_calib.batches.fingerprint import fingerprint, last_change_s, size_bytes
from rmis_calib.batches.jobs import Job, LeftOut, Task, find_jobs, with_device
from rmis_calib.batches.settings import BatchSettings
from rmis_calib.batches.setups import SetupComparison, compare
from rmis_calib.batches.summary import PAGE, BatchSummary, check_summary_files
from rmis_calib.batches.task import JobRecord, Order, run_job, write_failure
from rmis_calib.config import CalibrationConfig
from rmis_calib.errors import InputError, OutputError
from rmis_calib.io.atomic import write_json
from rmis_calib.io.folders import natural_order
from rmis_calib.io.outputs import check_apart, check_file, is_json_of, remove_own
from rmis_calib.io.plain_values import finite_or_none
from rmis_calib.parallel import cluster
from rmis_calib.parallel.lock import locked
from rmis_calib.parallel.processes import Event, Limits, cores, free_memory_bytes, run_tasks
from rmis_calib.pipeline.device import require_device
from rmis_calib.results import CalibrationResult

MANIFEST, MANIFEST_FORMAT = "batch.json", "rmis-calib-batch/1"
BATCH_LOG = "batch.log"
DONE_FILE = "done"
_MEMORY_SHARE = 0.9
"""Of the free memory, what the workers may take together."""
_LEAST_MEMORY = 2 * 2**30
"""A worker gets no less, whatever is free: the libraries alone take half of it."""


@dataclass(frozen=True)
class Plan:
    """What would be done.

    Attributes:
        orders: jobs to do, with why.
        done: records of those that are done already.
        left_out: what looks like work and is none.
    """

    orders: tuple[tuple[Order, str], ...]
    done: tuple[JobRecord, ...]
    left_out: tuple[LeftOut, ...]


@dataclass(frozen=True)
class Progress:
    """How far a batch is, for whoever shows it.

    Attributes:
        event: what happened last.
        name: of its job.
        done_jobs, jobs: this run's.
        frames_done: looked at by now, of this run.
        frames: of all jobs of this run; estimated from the size of the inputs where they are not counted yet.
        left_s: seconds left; None before anything is known.
        record: of a job that has just ended.
    """

    event: Event
    name: str
    done_jobs: int
    jobs: int
    frames_done: float
    frames: float
    left_s: float | None
    record: JobRecord | None


Watcher = Callable[[Progress], None]


def batch(
    root: str | Path,
    out: str | Path,
    config: CalibrationConfig | None = None,
    *,
    task: Task = "calibrate",
    settings: BatchSettings | None = None,
    progress: Watcher = lambda _: None,
    stop: Callable[[], bool] = lambda: False,
) -> BatchSummary:
    """Work through all recordings of a tree, or of a manifest, and leave a folder a recording and a summary.

    What is done already, with the same inputs, settings and version, is not done again; whatever goes wrong with a
    recording is its own failure. A process that starts workers must be importable: call this below
    `if __name__ == "__main__":` in a script.

    Args:
        root: folder that is searched, or a manifest (`jobs.find_jobs`).
        out: output folder: `<name>/` a recording, index.html, summary.csv, .parquet and .json, batch.json, batch.log.
        config: of every calibration or detection; the defaults when None.
        task: `calibrate`, or `detect`, which takes plain videos and folders of pictures too.
        settings: workers, limits, what is drawn; the defaults when None.
        progress: called at every event.
        stop: asked now and then; True lets the jobs at work finish, begins no more, and ends a watch.

    Raises:
        FileError, InputError: no such root, nothing to do below it, or a manifest with a mistake.
        OutputError: the output folder holds what is not ours, or another batch is at work in it.
    """
    root, out = Path(root), Path(out)
    config, settings = config or CalibrationConfig(), settings or BatchSettings()
    require_device(config.device)
    first = plan(root, out, config, task, settings)
    _check_out(root, out, [order.job for order, _ in first.orders])
    if not first.orders and not first.done and not settings.watch:
        expected = "a recording (a folder with recording.yaml)" + (", a video or pictures" if task == "detect" else "")
        raise InputError(where=str(root), expected=expected, found="none in it or below it")
    out.mkdir(parents=True, exist_ok=True)
    check_summary_files(out)
    with locked(out) as dead, _log_file(out / BATCH_LOG) as log:
        if dead is not None:
            log.warning("taken over from %s, which is gone", dead)
        now = first
        while True:
            summary = _one_round(root, out, config, task, settings, now, progress, stop, log)
            if not settings.watch or stop():
                return summary
            _sleep(settings.poll_s, stop)
            now = plan(root, out, config, task, settings)


def plan(root: Path, out: Path, config: CalibrationConfig, task: Task, settings: BatchSettings) -> Plan:
    """What a batch would do now, and why; nothing is written.

    Raises:
        FileError, InputError: as `batch`.
    """
    jobs, left_out = find_jobs(root, task, config, skip=out)
    if settings.watch:
        jobs, unfinished = _complete(jobs, settings.settle_s)
        left_out += unfinished
    effect = json.dumps([settings.overlays, settings.overlay_video])
    orders, done = [], []
    for job in jobs:
        target = out.absolute() / PurePosixPath(job.name)
        mark = fingerprint(job, effect)
        order = Order(job, target, mark, settings.overlays, settings.overlay_video, settings.profile)
        record = JobRecord.read(target)
        if record is None:
            orders.append((order, "new"))
        elif record.fingerprint != mark:
            orders.append((order, "inputs, settings or version have changed"))
        elif not record.is_final:
            orders.append((order, f"failed before: {record.message}"))
        else:
            done.append(record)
    return Plan(tuple(orders), tuple(done), tuple(left_out))


def _check_out(root: Path, out: Path, jobs: Sequence[Job]) -> None:
    """Refuse an output folder that is an input, or lies in one."""
    inputs = [job.source for job in jobs] + ([] if root.is_dir() else [root])
    check_apart(out, inputs)
    if root.is_dir() and out.resolve() == root.resolve():
        raise OutputError(where=str(out), expected="an output folder of its own", found="the folder of the recordings")
    check_file(out / MANIFEST, is_json_of(MANIFEST_FORMAT), overwrite=True)


def _complete(jobs: list[Job], settle_s: float) -> tuple[list[Job], list[LeftOut]]:
    """Jobs whose recording is complete, and those that are still being written."""
    complete, unfinished = [], []
    for job in jobs:
        if (job.source / DONE_FILE).exists() or time.time() - last_change_s(job) >= settle_s:
            complete.append(job)
        else:
            unfinished.append(LeftOut(job.source, "still being written"))
    return complete, unfinished


def _one_round(
    root: Path,
    out: Path,
    config: CalibrationConfig,
    task: Task,
    settings: BatchSettings,
    now: Plan,
    progress: Watcher,
    stop: Callable[[], bool],
    log: logging.Logger,
) -> BatchSummary:
    """All work that there is now."""
    orders = [order for order, _ in now.orders]
    for order in orders:
        _clear_remains(order.target)
    write_json(out / MANIFEST, _manifest(root, task, config, settings, now))
    records = {record.name: record for record in now.done}
    if orders or not settings.watch:
        log.info("%d to do, %d done before, %d left out", len(orders), len(now.done), len(now.left_out))
    for record in _work(orders, config.device, settings, progress, stop, log):
        records[record.name] = record
    not_done = tuple(order.job.name for order in orders if order.job.name not in records)
    kept = sorted(records.values(), key=lambda record: natural_order(record.name))
    summary = BatchSummary(
        tuple(kept), setups_of(out, kept), now.left_out, tuple(record.name for record in now.done), not_done
    )
    if orders or not (out / PAGE).exists() or not settings.watch:
        summary.write(out)
        from rmis_calib.batches.page import write_index

        write_index(out, summary, title=root.resolve().name)
        log.info("%s", ", ".join(f"{count} {end}" for end, count in summary.counts.items()) or "nothing done")
    return summary


def _work(
    orders: list[Order],
    device: str,
    settings: BatchSettings,
    progress: Watcher,
    stop: Callable[[], bool],
    log: logging.Logger,
) -> Iterator[JobRecord]:
    """Records of the jobs, as they end."""
    if not orders:
        return
    asked = settings.workers or cores()
    workers = min(asked, len(orders))
    limits = Limits(
        # Not by the jobs that are left: sums over threads round differently, and a batch that was resumed must come to
        # the same numbers.
        threads=max(1, cores() // asked),
        memory_bytes=_memory_of_each(workers, settings.memory_gb),
        timeout_s=None if settings.timeout_min is None else 60.0 * settings.timeout_min,
        retries=settings.retries,
    )
    if device == "cuda":
        orders = _spread_over_gpus(orders)
    tracker = _Tracker(orders)
    ended = False

    def is_over() -> bool:
        return ended or stop()

    if settings.cluster is not None:
        events = cluster.run_tasks(orders, run_job, settings.cluster, workers, limits, is_over)
    else:
        events = run_tasks(orders, run_job, workers, limits, is_over)
    try:
        for event in events:
            order, record = orders[event.index], None
            if event.kind == "started" and event.attempt > 1:
                log.warning("%s: attempt %d, its process died before", order.job.name, event.attempt)
            elif event.kind == "finished":
                record = _seen_from_here(order, event.value)
            elif event.kind == "died":
                _clear_remains(order.target)  # the dead process could not
                times = f" in each of {event.attempt} attempts" if event.attempt > 1 else ""
                record = write_failure(order, "crash", f"{event.value}{times}")
            if record is not None:
                log.info("%s: %s (%.1f s)", order.job.name, record.line, record.seconds)
                ended = ended or (settings.fail_fast and not record.trustworthy)
            progress(tracker.update(event, record))
            if record is not None:
                yield record
    finally:
        events.close()  # type: ignore[attr-defined]


def _seen_from_here(order: Order, record: JobRecord) -> JobRecord:
    """The record; a failure where its folder was written on a disk that this machine does not see."""
    if record.failure == "output" or JobRecord.read(order.target) is not None:
        return record
    message = f"its output, written on {record.host}, is not seen from here: do all workers share the output folder?"
    return JobRecord.of_failure(order, "output", message)


class _Tracker:
    """Frames done and to do of all jobs of a run, and the time left."""

    def __init__(self, orders: Sequence[Order]) -> None:
        self._names = [order.job.name for order in orders]
        self._bytes = [max(1, size_bytes(order.job)) for order in orders]
        self._total: dict[int, dict[str, int]] = {}
        self._done: dict[int, dict[str, int]] = {}
        self._ended: set[int] = set()
        self._start = time.monotonic()

    def update(self, event: Event, record: JobRecord | None) -> Progress:
        """The progress after an event."""
        index = event.index
        if event.kind == "started":
            self._total[index], self._done[index] = {}, {}
        elif event.kind == "progress":
            stage, done, total = event.value
            if stage.startswith("detecting"):
                self._total[index][stage], self._done[index][stage] = total, done
        if record is not None:
            self._ended.add(index)
        done, frames = self._frames()
        elapsed = time.monotonic() - self._start
        left_s = elapsed * (frames - done) / done if done > 0 else None
        return Progress(event, self._names[index], len(self._ended), len(self._names), done, frames, left_s, record)

    def _frames(self) -> tuple[float, float]:
        """Frames done, and of all jobs: counted where a job has begun to look at them, else by its bytes."""
        counted = {index: sum(total.values()) for index, total in self._total.items() if total}
        known_bytes = sum(self._bytes[index] for index in counted)
        per_byte = sum(counted.values()) / known_bytes if known_bytes else 0.0
        done = total = 0.0
        for index, size in enumerate(self._bytes):
            frames = counted.get(index, per_byte * size)
            total += frames
            done += frames if index in self._ended else sum(self._done.get(index, {}).values())
        return done, total


def _memory_of_each(workers: int, asked_gb: float | None) -> int | None:
    if asked_gb is not None:
        return int(asked_gb * 1e9)
    free = free_memory_bytes()
    return None if free is None else max(_LEAST_MEMORY, int(_MEMORY_SHARE * free / workers))


def _spread_over_gpus(orders: list[Order]) -> list[Order]:
    """Each job on one of the GPUs in turn."""
    import torch

    count = torch.cuda.device_count()
    return [replace(order, job=with_device(order.job, f"cuda:{i % count}")) for i, order in enumerate(orders)]


def setups_of(out: Path, records: Sequence[JobRecord]) -> tuple[SetupComparison, ...]:
    """Comparisons of the recordings of each set-up."""
    by_setup: dict[str, list[JobRecord]] = {}
    for record in records:
        if record.outcome == "finished" and "setup" in record.row:
            by_setup.setdefault(record.row["setup"], []).append(record)
    comparisons = []
    for setup, members in sorted(by_setup.items()):
        results = [CalibrationResult.read(out / PurePosixPath(member.name) / "result.json") for member in members]
        comparisons.append(compare(results, [member.name for member in members], setup))
    return tuple(comparisons)


def _manifest(
    root: Path, task: Task, config: CalibrationConfig, settings: BatchSettings, now: Plan
) -> dict[str, object]:
    return {
        "format": MANIFEST_FORMAT,
        "version": __version__,
        "root": str(root.resolve()),
        "task": task,
        "config": finite_or_none(config.to_dict()),
        "settings": vars(settings),
        "to_do": [
            {"name": order.job.name, "source": str(order.job.source), "found": order.job.why, "why": why}
            for order, why in now.orders
        ],
        "done_before": [record.name for record in now.done],
        "left_out": [{"path": str(item.path), "why": item.why} for item in now.left_out],
    }


def _clear_remains(target: Path) -> None:
    """Remove what a batch that was killed while it wrote this folder left beside it: `.name.<random>.tmp`."""
    if not target.parent.is_dir():
        return
    for path in target.parent.iterdir():
        name = path.name
        if not (name.startswith(f".{target.name}.") and name.endswith(".tmp") and path.is_dir()):
            continue
        if name.endswith(".old.tmp"):  # the folder before, with what somebody may have put into it
            remove_own(path)
        elif "." not in name.removeprefix(f".{target.name}.").removesuffix(".tmp"):
            shutil.rmtree(path, ignore_errors=True)


def _sleep(seconds: float, stop: Callable[[], bool]) -> None:
    until = time.monotonic() + seconds
    while time.monotonic() < until and not stop():
        time.sleep(0.1)


@contextmanager
def _log_file(path: Path) -> Iterator[logging.Logger]:
    """A logger that appends plain lines to a file while the block runs."""
    logger = logging.getLogger(f"rmis_calib.batches.{path}")
    logger.setLevel(logging.INFO)
    logger.propagate = False
    handler = logging.FileHandler(path, encoding="utf-8")
    handler.setFormatter(logging.Formatter("%(asctime)s %(levelname)s %(message)s"))
    logger.addHandler(handler)
    try:
        yield logger
    finally:
        logger.removeHandler(handler)
        handler.close()
