"""How far a batch is: by frames, not by recordings."""

import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass

from rmis_calib.batches.fingerprint import size_bytes
from rmis_calib.batches.job_record import JobRecord, Order
from rmis_calib.parallel.processes import Event


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


class Tracker:
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
