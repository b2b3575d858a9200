"""What goes to a worker, and what a job's folder says of how it went: its record and its log.

`job.json` (format `rmis-calib-job/1`) is the record: what was done, with which inputs and settings, and how it ended.
It is in the folder from the moment the folder exists.
"""

import json
import socket
import time
from collections.abc import Callable
from dataclasses import asdict, dataclass, field
from datetime import UTC, datetime
from pathlib import Path
from typing import Any, Literal

from rmis_calib.batches.jobs import Job
from rmis_calib.errors import RmisCalibError
from rmis_calib.io.atomic import write_json
from rmis_calib.io.configs import load_json
from rmis_calib.io.plain_values import finite_or_none

JOB_FORMAT = "rmis-calib-job/1"
RECORD, LOG = "job.json", "log.jsonl"
Failure = Literal["input", "output", "memory", "crash", "device", "bug"]
"""input: the recording is at fault, and trying again is of no use; the others are the machine's, or the program's."""
Report = Callable[[str, int, int], None]


@dataclass(frozen=True)
class Order:
    """A job as a worker gets it.

    Attributes:
        job: what to do.
        target: folder to write.
        fingerprint: of the inputs and settings.
        overlays: pictures a camera; -1: every frame.
        overlay_video: whether to write a video with what was detected and predicted.
        profile: whether to write where the time went.
        service: address of the process that owns the device; None: the worker looks at its pictures itself.
    """

    job: Job
    target: Path
    fingerprint: str
    overlays: int
    overlay_video: bool
    profile: bool
    service: str | None = None


@dataclass(frozen=True)
class JobRecord:
    """How a job ended.

    Attributes:
        name, source, task: of the job.
        fingerprint: of its inputs and settings; None where nothing of it could be looked at.
        outcome: `finished` with a result, whatever its verdict, or `failed`.
        failure: kind of failure; None for a finished one.
        message: the result's line, or why there is none.
        row: what the summary shows of the result (`row_of_run`).
        stages: seconds of each stage.
        seconds: of everything.
        host: machine that did it.
        written: when, ISO 8601.
    """

    name: str
    source: str
    task: str
    fingerprint: str | None
    outcome: Literal["finished", "failed"]
    failure: Failure | None
    message: str
    row: dict[str, Any] = field(default_factory=dict)
    stages: dict[str, float] = field(default_factory=dict)
    seconds: float = 0.0
    host: str = field(default_factory=socket.gethostname)
    written: str = field(default_factory=lambda: datetime.now(UTC).isoformat(timespec="seconds"))

    @property
    def is_final(self) -> bool:
        """Whether doing it again with the same inputs would end the same way."""
        return self.outcome == "finished" or self.failure == "input"

    @property
    def trustworthy(self) -> bool:
        """A result that passed its own checks; of `detect`, lines in a file."""
        return self.outcome == "finished" and (self.task == "detect" or self.row.get("status") == "ok")

    @property
    def line(self) -> str:
        """How it ended, for people."""
        return f"failed: {self.message}" if self.outcome == "failed" else self.message

    def write(self, folder: Path) -> None:
        """Write `job.json`.

        Raises:
            OutputError: it cannot be written.
        """
        write_json(folder / RECORD, {"format": JOB_FORMAT, **finite_or_none(asdict(self))})

    @classmethod
    def read(cls, folder: Path) -> "JobRecord | None":
        """The record of an output folder; None where there is none that can be read."""
        try:
            raw = load_json(folder / RECORD)
            if raw.pop("format") != JOB_FORMAT:
                return None
            return cls(**raw)
        except (RmisCalibError, TypeError, KeyError):
            return None

    @classmethod
    def of_failure(cls, order: Order, failure: Failure, message: str) -> "JobRecord":
        """Record of a job that came to no result."""
        job = order.job
        return cls(job.name, str(job.source), job.task, order.fingerprint, "failed", failure, message)


class StageLog:
    """A progress callback that keeps how long each stage took, and the lines of `log.jsonl`: one JSON object each."""

    def __init__(self, report: Report) -> None:
        self._report = report
        self._start = time.monotonic()
        self._began: dict[str, float] = {}
        self._lines: list[str] = []
        self.seconds: dict[str, float] = {}

    def __call__(self, stage: str, done: int, total: int) -> None:
        now = time.monotonic()
        if done == 0 or stage not in self._began:
            self._began[stage] = now
        if done >= total:
            took = now - self._began[stage]
            self.seconds[stage] = round(self.seconds.get(stage, 0.0) + took, 3)
            self.note("stage", stage=stage, items=total, seconds=round(took, 3))
            self._began[stage] = now
        self._report(stage, done, total)

    @property
    def elapsed_s(self) -> float:
        return time.monotonic() - self._start

    @property
    def text(self) -> str:
        return "".join(f"{line}\n" for line in self._lines)

    def note(self, event: str, **values: Any) -> None:
        """Add a line."""
        stamp = datetime.now(UTC).isoformat(timespec="milliseconds")
        self._lines.append(json.dumps({"time": stamp, "event": event, **values}, ensure_ascii=False))
