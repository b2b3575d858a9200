"""What `calibrate` and `detect` leave behind: tables, pictures and the report, in a folder."""

import csv
from pathlib import Path

import numpy as np
import torch

from rmis_calib.config import CalibrationConfig
from rmis_calib.io import RecordingDescription, atomic_directory, load_recording
from rmis_calib.io.atomic import write_yaml
from rmis_calib.io.plain_values import finite_or_none
from rmis_calib.pipeline.answer.run import CalibrationRun
from rmis_calib.pipeline.calibration import run_calibration
from rmis_calib.pipeline.pictures.detection import DetectionTable, Progress, View, no_progress
from rmis_calib.report.detection_pictures import write_picture
from rmis_calib.report.drawing.frames import overlays, spread
from rmis_calib.report.drawing.overlays import Overlay
from rmis_calib.report.material import gather_material
from rmis_calib.report.overlay_video import write_overlay_videos
from rmis_calib.report.page import write_report
from rmis_calib.results import CalibrationResult
from rmis_calib.vision import EndKind, FrameReason

OVERLAYS = 12
"""Overlays a camera that are written beside the report, unless told otherwise."""

LINE_COLUMNS = (
    "camera", "frame", "candidate", "found", "reason", "confidence", "direction_known",
    *(f"contour{edge}_{point}_{axis}" for edge in (0, 1) for point in ("rcm", "tip") for axis in "xy"),
    "sigma_contour0", "sigma_contour1", "end_x", "end_y", "sigma_end", "end_u_px", "end_v_px",
    "end_kind", "end_sureness",
)  # fmt: skip


def calibrate_to_folder(
    source: RecordingDescription,
    out: Path,
    config: CalibrationConfig,
    *,
    overwrite: bool = False,
    overlays: int = OVERLAYS,
    overlay_video: bool = False,
    progress: Progress = no_progress,
) -> CalibrationResult:
    """Calibrate a recording and write the answer, the report and the pictures as one folder, whole or not at all.

    Args:
        source: from `read_description`.
        out: folder to write.
        config: of the calibration.
        overwrite: replace a folder that this program wrote.
        overlays: pictures a camera; -1 for every motion.
        overlay_video: write a video a camera, too.
        progress: called with (stage, done, total).

    Raises:
        InputError, FileError: the recording breaks its format.
        OutputError: the folder may not be written, or cannot.
    """
    recording = load_recording(source)
    with atomic_directory(out, overwrite=overwrite) as folder:
        run = run_calibration(recording, config, progress)
        write_calibration_folder(folder, run, overlays, overlay_video)
    return run.result


def write_calibration_folder(folder: Path, run: CalibrationRun, count: int, video: bool = False) -> tuple[Overlay, ...]:
    """result.json, config.yaml, observations.npz, overlays/*.jpg, report.html and, where asked for, overlay_*.mp4;
    returns the pictures that the report shows.

    Args:
        folder: existing folder.
        run: what to write.
        count: pictures per camera in `overlays`; -1 for every motion.
        video: whether to write a video a camera.
    """
    run.result.write(folder / "result.json")
    write_yaml(folder / "config.yaml", finite_or_none(run.result.config))
    if run.observations is not None:
        run.observations.save(folder / "observations.npz")
    pictures = folder / "overlays"
    pictures.mkdir()
    for overlay in overlays(run, spread(len(run.poses.frames), count)):
        write_picture(pictures / f"{overlay.camera}_{overlay.frame:06d}.jpg", overlay.drawn())
    material = gather_material(run)
    name = run.recording.path.resolve().name
    write_report(
        folder / "report.html",
        run.result,
        material,
        title=name,
        source=name,
    )
    if video:
        write_overlay_videos(folder, run)
    return material.pictures


def write_lines(folder: Path, table: DetectionTable) -> None:
    """lines.csv and lines.npz.

    Args:
        folder: existing folder.
        table: what was detected.
    """
    with (folder / "lines.csv").open("w", newline="", encoding="utf-8") as stream:
        writer = csv.writer(stream)
        writer.writerow(LINE_COLUMNS)
        for view in table.views:
            writer.writerows(_line_rows(view))
    arrays = {
        f"{name}_{view.side}": value.cpu().numpy()
        for view in table.views
        for name, value in vars(view.detections).items()
    }
    np.savez_compressed(folder / "lines.npz", allow_pickle=False, **arrays)


def _line_rows(view: View) -> list[list[object]]:
    """One row a candidate, and one for a frame without any."""
    found = view.detections
    numbers = torch.cat(
        [found.contour_xy.flatten(2), found.contour_sigma, found.end_xy, found.end_sigma[..., None], found.end_uv],
        dim=-1,
    ).double()
    rows: list[list[object]] = []
    for frame, is_valid in enumerate(found.valid.tolist()):
        reason = FrameReason(int(found.reason[frame])).sentence
        if not any(is_valid):
            rows.append([view.side, frame, "", 0, reason, *[""] * (len(LINE_COLUMNS) - 5)])
        for candidate in np.flatnonzero(is_valid):
            values = ["" if np.isnan(x) else f"{x:.9g}" for x in numbers[frame, candidate].tolist()]
            confidence = f"{float(found.confidence[frame, candidate]):.3f}"
            direction = int(found.direction_known[frame, candidate])
            kind = EndKind(int(found.end_kind[frame, candidate])).name.lower()
            sureness = f"{float(found.end_sureness[frame, candidate]):.3f}"
            rows.append([view.side, frame, int(candidate), 1, "", confidence, direction, *values, kind, sureness])
    return rows
