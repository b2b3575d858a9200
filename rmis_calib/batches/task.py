"""One job of a batch: a folder with the result, the report, a log and a record, whole or not at all.

`job.json` (format `rmis-calib-job/1`) is the record: what was done, with which inputs and settings, and how it ended.
It is in the folder from the moment the folder exists.
"""

import contextlib
import cProfile
import io
import json
import os
import pstats
import shutil
import socket
import time
import traceback
from collections.abc import Callable, Iterator
from dataclasses import asdict, dataclass, field, replace
from datetime import UTC, datetime
from pathlib import Path
from typing import TYPE_CHECKING, Any, Literal

from rmis_calib.batches.jobs import Job
from rmis_calib.errors import DeviceError, OutputError, RmisCalibError
from rmis_calib.io.atomic import atomic_directory, write_json
from rmis_calib.io.configs import load_json
from rmis_calib.io.plain_values import finite_or_none
from rmis_calib.results import Nuisance

if TYPE_CHECKING:
    from rmis_calib.io import RecordingDescription
    from rmis_calib.pipeline import CalibrationRun
    from rmis_calib.pipeline.pictures.detection import Detectors
    from rmis_calib.results import CalibrationResult

JOB_FORMAT = "rmis-calib-job/1"
RECORD, LOG = "job.json", "log.jsonl"
Failure = Literal["input", "output", "memory", "crash", "device", "bug"]
"""input: the recording is at fault, and trying again is of no use; the others are the machine's, or the program's."""
_OUT_OF_MEMORY = ("out of memory", "can't allocate memory", "insufficient memory", "cannot allocate memory")
_PROFILED = 60
_REQUESTS = 2
"""Batches of a worker at its device: one is searched while the next waits."""

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


def run_job(order: Order, report: Report) -> JobRecord:
    """Do a job and leave its folder; whatever goes wrong is in the record, and nothing is raised.

    A job that fails leaves a folder with its log and its record alone. Where not even that can be written (a full disk,
    a folder with somebody's own files in it), the record is returned all the same.
    """
    log = StageLog(report)
    log.note("started", job=order.job.name, source=str(order.job.source), task=order.job.task, pid=os.getpid())
    try:
        order.target.parent.mkdir(parents=True, exist_ok=True)
        with atomic_directory(order.target, overwrite=True) as folder:
            record = _attempt(order, folder, log)
            record = replace(record, stages=log.seconds, seconds=round(log.elapsed_s, 3))
            log.note(record.outcome, message=record.message, seconds=record.seconds)
            (folder / LOG).write_text(log.text, encoding="utf-8")
            record.write(folder)
    except OSError as error:  # OutputError is one
        return JobRecord.of_failure(order, "output", _one_line(error))
    return record


def write_failure(order: Order, failure: Failure, message: str) -> JobRecord:
    """Leave the folder of a job whose worker cannot do so any more."""
    record = JobRecord.of_failure(order, failure, message)
    log = StageLog(lambda *_: None)
    log.note("failed", message=message)
    try:
        with atomic_directory(order.target, overwrite=True) as folder:
            (folder / LOG).write_text(log.text, encoding="utf-8")
            record.write(folder)
    except OSError as error:
        return replace(record, message=f"{message}; and {_one_line(error)}")
    return record


def _attempt(order: Order, folder: Path, log: "StageLog") -> JobRecord:
    work = {"calibrate": _calibrate, "detect": _detect}[order.job.task]
    try:
        with _profiled(folder / "profile.txt" if order.profile else None):
            message, row = work(order, folder, log)
    except OutputError:
        raise
    except Exception as error:
        failure, why = _classified(error, order.job.source)
        if failure == "bug":
            log.note("traceback", text=traceback.format_exc())
        _empty(folder)
        return JobRecord.of_failure(order, failure, why)
    job = order.job
    return JobRecord(job.name, str(job.source), job.task, order.fingerprint, "finished", None, message, row)


def _calibrate(order: Order, folder: Path, log: "StageLog") -> tuple[str, dict[str, Any]]:
    from rmis_calib.io import load_recording, read_description
    from rmis_calib.pipeline import run_calibration
    from rmis_calib.report import write_calibration_folder, write_thumbnail

    log("reading", 0, 1)
    description = read_description(order.job.source)
    recording = load_recording(description)
    log("reading", 1, 1)
    run = run_calibration(recording, order.job.config, log, detectors=_detectors(order))
    log("writing", 0, 1)
    drawn = write_calibration_folder(folder, run, order.overlays, order.overlay_video)
    write_thumbnail(folder / "thumbnail.jpg", drawn)
    log("writing", 1, 1)
    for note in run.result.notes:
        log.note("note", text=note)
    return run.result.message, row_of_run(run, description)


def _detect(order: Order, folder: Path, log: "StageLog") -> tuple[str, dict[str, Any]]:
    from rmis_calib.pipeline import detect
    from rmis_calib.report import DetectionPictures, PictureChoice, write_lines

    with DetectionPictures(folder, PictureChoice(order.overlays, order.overlay_video)) as pictures:
        table = detect(order.job.source, order.job.config, log, pictures.add, detectors=_detectors(order))
    log("writing", 0, 1)
    write_lines(folder, table)
    log("writing", 1, 1)
    row: dict[str, Any] = {"frames": sum(view.source.count for view in table.views)}
    for view in table.views:
        row[f"found_{view.side}"] = int(view.found.sum())
    found = sum(int(view.found.sum()) for view in table.views)
    return f"{found} of {row['frames']} pictures with a shaft", row


def _detectors(order: Order) -> "Detectors":
    """Who looks for shafts: the process that owns the device, or this one; always this one where masks show them."""
    from rmis_calib.pipeline.pictures.detection import OWN_DETECTORS, Detectors

    config = order.job.config
    if order.service is None or config.masks is not None:
        return OWN_DETECTORS
    from rmis_calib.parallel.shared_detector import SharedDevice

    device = SharedDevice(order.service, config.device)
    return Detectors(device.detector, pictures_on="cpu", at_once=_REQUESTS)


def row_of_run(run: "CalibrationRun", description: "RecordingDescription") -> dict[str, Any]:
    """What the summary shows of a calibration."""
    row = row_of_result(run.result)
    row |= {"frames": sum(view.source.count for view in run.views), "setup": setup_of(description)}
    for view in run.views:
        row[f"found_{view.side}"] = int(view.found.sum())
    return row


def row_of_result(result: "CalibrationResult") -> dict[str, Any]:
    """What the summary shows of a result: plain values, lengths in mm, angles in degrees."""
    clock = result.nuisances.get("clock", Nuisance(value=None, sigma=None, unit="s"))
    row: dict[str, Any] = {
        "status": result.status,
        "method": result.method,
        "rotation_sigma_deg": result.rotation_sigma_deg,
        "translation_sigma_mm": result.translation_sigma_mm,
        "working_point_sigma_mm": result.observability.working_point_sigma_mm,
        "motions": len(result.motions.used),
        "motions_used": int(result.motions.used.sum()),
        "clock_s": None if clock.value is None else round(clock.value, 9),  # rounding is no offset
        "clock_sigma_s": clock.sigma,
        "notes": list(result.notes),
    }
    for name, residual in result.residuals.items():
        row[f"residual_{name}_{residual.unit.replace(' ', '_')}"] = residual.median
    for side, error in (result.head_point_error_px or {}).items():
        row[f"head_point_{side}_px"] = error.median
    return row


def setup_of(description: "RecordingDescription") -> str:
    """Name of a robot with its cameras, arms and shaft: recordings of one set-up have one hand-eye transform, and
    share the deviation of the shaft's radius from the one that was told."""
    import hashlib

    robot, stereo, diameter_mm = description.robot, description.stereo, description.shaft_diameter_mm
    arms = {
        name: asdict(robot.arms[name]) for name in (description.laparoscope_arm, description.instrument_arm) if name
    }
    content = [robot.name, robot.dh_convention, arms, asdict(stereo), description.laparoscope_arm, diameter_mm]
    text = json.dumps(content, sort_keys=True, default=lambda array: array.tolist())
    height, width = stereo.right.image_size
    cameras = "stereo" if stereo.left is not None else "mono"
    digest = hashlib.blake2b(text.encode(), digest_size=3).hexdigest()
    return f"{robot.name}, {cameras} {width} x {height}, {diameter_mm:g} mm shaft, {digest}"


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


def _classified(error: Exception, source: Path) -> tuple[Failure, str]:
    text = _one_line(error, source)
    if isinstance(error, MemoryError) or any(words in str(error).lower() for words in _OUT_OF_MEMORY):
        return "memory", f"it needs more memory than there is for a worker ({text[:200]})"
    if isinstance(error, DeviceError):
        return "device", text
    if isinstance(error, RmisCalibError):
        return "input", text
    return "bug", f"{type(error).__name__}: {text} (a bug; {LOG} has the traceback)"


def _one_line(error: BaseException, source: Path | None = None) -> str:
    """What an error says; files of the recording by their place in it."""
    text = " ".join(str(error).split()) or type(error).__name__
    return text if source is None else text.replace(f"{source}/", "")


def _empty(folder: Path) -> None:
    for path in folder.iterdir():
        if path.is_dir():
            shutil.rmtree(path)
        else:
            path.unlink()


@contextlib.contextmanager
def _profiled(path: Path | None) -> Iterator[None]:
    """Write the functions in which the time went; nothing without a path."""
    if path is None:
        yield
        return
    profile = cProfile.Profile()
    with profile:
        yield
    text = io.StringIO()
    pstats.Stats(profile, stream=text).sort_stats("cumulative").print_stats(_PROFILED)
    path.write_text(text.getvalue(), encoding="utf-8")
