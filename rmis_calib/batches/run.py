"""A batch from end to end: find the work, pass over what is done, work through the rest, and summarise."""

import logging
import time
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from pathlib import Path

from rmis_calib.batches.jobs import Job, Task
from rmis_calib.batches.plan import MANIFEST, MANIFEST_FORMAT, Plan, manifest, plan
from rmis_calib.batches.progress import Watcher
from rmis_calib.batches.settings import BatchSettings
from rmis_calib.batches.setups import setups_of
from rmis_calib.batches.summary import PAGE, BatchSummary, check_summary_files
from rmis_calib.batches.work import clear_remains, work
from rmis_calib.config import CalibrationConfig
from rmis_calib.errors import InputError, OutputError
from rmis_calib.io.atomic import write_json
from rmis_calib.io.folders import natural_order
from rmis_calib.io.outputs import check_apart, check_file, is_json_of
from rmis_calib.parallel.lock import locked
from rmis_calib.pipeline.device import require_device

BATCH_LOG = "batch.log"


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
    if settings.cluster in (None, "local"):  # another machine's workers say so themselves
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


def _check_out(root: Path, out: Path, jobs: Sequence[Job]) -> None:
    """Refuse an output folder that is an input, or lies in one."""
    inputs = [job.source for job in jobs] + ([] if root.is_dir() else [root])
    check_apart(out, inputs)
    if root.is_dir() and out.resolve() == root.resolve():
        raise OutputError(where=str(out), expected="an output folder of its own", found="the folder of the recordings")
    check_file(out / MANIFEST, is_json_of(MANIFEST_FORMAT), overwrite=True)


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
        clear_remains(order.target)
    write_json(out / MANIFEST, manifest(root, task, config, settings, now))
    records = {record.name: record for record in now.done}
    if orders or not settings.watch:
        log.info("%d to do, %d done before, %d left out", len(orders), len(now.done), len(now.left_out))
    for record in work(orders, config.device, settings, progress, stop, log):
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
