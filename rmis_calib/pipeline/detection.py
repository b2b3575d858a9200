"""Shafts in all frames of a camera: decoded in the background, detected in batches, gathered on the device."""

from collections.abc import Callable
from dataclasses import dataclass, fields
from pathlib import Path

import torch
from torch import Tensor

from rmis_calib.config import CalibrationConfig
from rmis_calib.geometry.cameras import Camera
from rmis_calib.io import FrameSource, Recording, load_recording, open_source
from rmis_calib.pipeline.device import require_device
from rmis_calib.vision import FrameReason, ShaftDetections, ShaftDetector

Progress = Callable[[str, int, int], None]


def no_progress(stage: str, done: int, total: int) -> None:
    """The progress callback of callers who do not want one."""


@dataclass(frozen=True, eq=False)
class View:
    """One camera's frames with what was found in them.

    Attributes:
        side: `right` or `left`.
        source: the frames.
        camera: its intrinsics; None where lines are in pixels.
        detections: candidates of every frame, leading axis N.
    """

    side: str
    source: FrameSource
    camera: Camera | None
    detections: ShaftDetections

    @property
    def found(self) -> Tensor:
        """(N,) frames with at least one shaft."""
        return self.detections.valid.any(dim=-1)


@dataclass(frozen=True, eq=False)
class DetectionTable:
    """What `detect` found, one view a camera."""

    views: tuple[View, ...]

    def rows(self) -> list[tuple[str, str]]:
        """Counts of found and missed frames, and the reasons."""
        rows = []
        for view in self.views:
            found = view.found
            name = "pictures" if view.camera is None else f"camera_{view.side}"
            rows.append((name, f"{int(found.sum())} of {len(found)} frames with a shaft"))
            ends = (view.detections.end_valid & view.detections.valid).any(dim=-1)
            rows.append(("  shaft end seen", f"{int(ends.sum())}"))
            codes, counts = view.detections.reason[~found].unique(return_counts=True)
            for code, count in zip(codes.tolist(), counts.tolist(), strict=True):
                rows.append((f"  {FrameReason(code).sentence}", str(count)))
        return rows


def detect(
    source: Recording | str | Path, config: CalibrationConfig | None = None, progress: Progress = no_progress
) -> DetectionTable:
    """Find the shaft in a recording, or in a bare video, folder of images or image (then in pixels).

    Raises:
        FileError: the source cannot be read.
        RecordingError: it is a recording that breaks its format.
    """
    config = config or CalibrationConfig()
    require_device(config.device)
    if not isinstance(source, Recording) and (Path(source) / "recording.yaml").is_file():
        source = load_recording(source)
    if isinstance(source, Recording):
        return DetectionTable(detect_recording(source, config, progress))
    frames = open_source(source)
    return DetectionTable((_detect_view("right", frames, None, config, progress, "detecting"),))


def detect_recording(recording: Recording, config: CalibrationConfig, progress: Progress) -> tuple[View, ...]:
    """The right view, and the left one of a stereo recording."""
    rig = recording.stereo
    views = [_detect_view("right", recording.right, rig.right, config, progress, "detecting, right")]
    if recording.left is not None:
        views.append(_detect_view("left", recording.left, rig.left, config, progress, "detecting, left"))
    return tuple(views)


def _detect_view(
    side: str, source: FrameSource, camera: Camera | None, config: CalibrationConfig, progress: Progress, stage: str
) -> View:
    moved = None if camera is None else camera.to(dtype=torch.float64, device=config.device)
    detector = ShaftDetector(config.detector, moved)
    parts, done = [], 0
    progress(stage, 0, source.count)
    for batch in source.batches(config.batch_size, config.device):
        parts.append(detector.detect(batch.images))
        done += len(batch.indices)
        progress(stage, done, source.count)
    return View(side, source, camera, concatenate(parts))


def concatenate(parts: list[ShaftDetections]) -> ShaftDetections:
    """Batches of detections, one after the other."""
    joined = {f.name: torch.cat([getattr(part, f.name) for part in parts]) for f in fields(ShaftDetections)}
    return ShaftDetections(**joined)
