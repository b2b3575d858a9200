"""One job of a batch: a folder with the result, the report, a log and a record, whole or not at all."""

import contextlib
import cProfile
import io
import os
import pstats
import shutil
import traceback
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING, Any

from rmis_calib.batches.job_record import LOG, Failure, JobRecord, Order, Report, StageLog
from rmis_calib.batches.rows import row_of_run
from rmis_calib.errors import DeviceError, OutputError, RmisCalibError
from rmis_calib.io.atomic import atomic_directory

if TYPE_CHECKING:
    from rmis_calib.pipeline.pictures.detection import Detectors

_OUT_OF_MEMORY = ("out of memory", "can't allocate memory", "insufficient memory", "cannot allocate memory")
_PROFILED = 60
_REQUESTS = 2
"""Batches of a worker at its device: one is searched while the next waits."""


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
