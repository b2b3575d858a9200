"""The recordings that are to be done, on processes or a cluster: limits, devices, and a record of each as it ends."""

import logging
import shutil
from collections.abc import Callable, Iterator
from contextlib import closing, contextmanager
from dataclasses import replace
from pathlib import Path

from rmis_calib.batches.job_record import JobRecord, Order
from rmis_calib.batches.jobs import with_device
from rmis_calib.batches.progress import Tracker, Watcher
from rmis_calib.batches.settings import BatchSettings
from rmis_calib.batches.task import run_job, write_failure
from rmis_calib.io.outputs import remove_own
from rmis_calib.parallel import cluster
from rmis_calib.parallel.processes import Event, Limits, cores, free_memory_bytes, run_tasks

_MEMORY_SHARE = 0.9
"""Of the free memory, what the workers may take together."""
_LEAST_MEMORY = 2 * 2**30
"""A worker gets no less, whatever is free: the libraries alone take half of it."""
_GPU_BATCH = 64
"""Frames that a GPU searches at once where nothing else is asked for."""


def work(
    orders: list[Order],
    device: str,
    settings: BatchSettings,
    progress: Watcher,
    stop: Callable[[], bool],
    log: logging.Logger,
) -> Iterator[JobRecord]:
    """Records of the jobs, as they end; closing the iterator kills what is at work.

    Args:
        orders: what to do.
        device: that the configuration asks for.
        settings: workers, limits, who detects.
        progress: called at every event.
        stop: True lets the jobs at work finish, and begins no more.
        log: of the batch.
    """
    if not orders:
        return
    if device == "cuda" and settings.cluster in (None, "local"):  # a worker elsewhere takes the GPU that it has
        orders = _spread_over_gpus(orders)
    tracker = Tracker(orders)
    ended = False

    def is_over() -> bool:
        return ended or stop()

    with _events(orders, device, settings, is_over) as events:
        for event in events:
            order = orders[event.index]
            if event.kind == "started" and event.attempt > 1:
                log.warning("%s: attempt %d, its process died before", order.job.name, event.attempt)
            record = _record_of(event, order)
            if record is not None:
                log.info("%s: %s (%.1f s)", order.job.name, record.line, record.seconds)
                ended = ended or (settings.fail_fast and not record.trustworthy)
            progress(tracker.update(event, record))
            if record is not None:
                yield record


@contextmanager
def _events(
    orders: list[Order], device: str, settings: BatchSettings, is_over: Callable[[], bool]
) -> Iterator[Iterator[Event]]:
    """What happens to the orders, on a cluster or on processes of this machine."""
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
    if settings.cluster is not None:
        with closing(cluster.run_tasks(orders, run_job, settings.cluster, workers, limits, is_over)) as events:
            yield events
        return
    with (
        _sharing_devices(orders, device, settings.device_batch) as ready,
        closing(run_tasks(ready, run_job, workers, limits, is_over)) as events,
    ):
        yield events


@contextmanager
def _sharing_devices(orders: list[Order], device: str, frames: int | None) -> Iterator[list[Order]]:
    """The orders, told who searches their pictures: a process a device where that is asked for, or for a GPU."""
    if frames is None:
        frames = _GPU_BATCH if device.startswith("cuda") else 0
    if frames == 0:
        yield orders
        return
    from rmis_calib.parallel.device_service import device_services

    devices = sorted({order.job.config.device for order in orders})
    with device_services(devices, frames, cores()) as addresses:
        yield [replace(order, service=addresses[order.job.config.device]) for order in orders]


def _record_of(event: Event, order: Order) -> JobRecord | None:
    """The record of a job that has ended; None for other events."""
    if event.kind == "finished":
        return _seen_from_here(order, event.value)
    if event.kind != "died":
        return None
    clear_remains(order.target)  # the dead process could not
    times = f" in each of {event.attempt} attempts" if event.attempt > 1 else ""
    return write_failure(order, "crash", f"{event.value}{times}")


def _seen_from_here(order: Order, record: JobRecord) -> JobRecord:
    """The record; a failure where its folder was written on a disk that this machine does not see."""
    if record.failure == "output" or JobRecord.read(order.target) is not None:
        return record
    message = f"its output, written on {record.host}, is not seen from here: do all workers share the output folder?"
    return JobRecord.of_failure(order, "output", message)


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


def clear_remains(target: Path) -> None:
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
