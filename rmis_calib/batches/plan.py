"""What a batch would do now, and why."""

import json
import time
from dataclasses import dataclass
from pathlib import Path, PurePosixPath

from rmis_calib import __version__
from rmis_calib.batches.fingerprint import fingerprint, last_change_s
from rmis_calib.batches.job_record import JobRecord, Order
from rmis_calib.batches.jobs import Job, LeftOut, Task, find_jobs
from rmis_calib.batches.settings import BatchSettings
from rmis_calib.config import CalibrationConfig
from rmis_calib.io.plain_values import finite_or_none

MANIFEST, MANIFEST_FORMAT = "batch.json", "rmis-calib-batch/1"
DONE_FILE = "done"


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


def _complete(jobs: list[Job], settle_s: float) -> tuple[list[Job], list[LeftOut]]:
    """Jobs whose recording is complete, and those that are still being written."""
    complete, unfinished = [], []
    for job in jobs:
        if (job.source / DONE_FILE).exists() or time.time() - last_change_s(job) >= settle_s:
            complete.append(job)
        else:
            unfinished.append(LeftOut(job.source, "still being written"))
    return complete, unfinished


def manifest(
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
