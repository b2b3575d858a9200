"""Shafts in all frames of a camera: decoded in the background, detected in batches, gathered on the device."""

from collections.abc import Callable
from dataclasses import dataclass, fields
from pathlib import Path

import numpy as np
import torch
from torch import Tensor

from rmis_calib.config import CalibrationConfig
from rmis_calib.geometry.cameras import Camera
from rmis_calib.io import FrameBatch, FrameSource, Recording, load_recording, open_source
from rmis_calib.pipeline.device import require_device
from rmis_calib.pipeline.masks import MaskReader, open_masks
from rmis_calib.vision import FrameReason, ShaftDetections, ShaftDetector
from rmis_calib.vision.masks import Segmenter

Progress = Callable[[str, int, int], None]


def no_progress(stage: str, done: int, total: int) -> None:
    """The progress callback of callers who do not want one."""


@dataclass(frozen=True, eq=False)
class DetectedBatch:
    """Frames with what was just found in them, for whoever draws them while they are in memory.

    Attributes:
        side: `right` or `left`.
        source: all frames of that camera.
        times_s: (N,) time of each of them; None where that is unknown.
        detector: which found it.
        frames: pictures and their numbers.
        masks: (b, h, w) that took the place of the colour stage; None: none did.
        detections: candidates, leading axis b.
    """

    side: str
    source: FrameSource
    times_s: np.ndarray | None
    detector: ShaftDetector
    frames: FrameBatch
    masks: Tensor | None
    detections: ShaftDetections


Watch = Callable[[DetectedBatch], None]


def no_watch(batch: DetectedBatch) -> None:
    """The watcher of callers who do not want one."""


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
    source: Recording | str | Path,
    config: CalibrationConfig | None = None,
    progress: Progress = no_progress,
    watch: Watch = no_watch,
    segment: Segmenter | None = None,
) -> DetectionTable:
    """Find the shaft in a recording, or in a bare video, folder of images or image (then in pixels).

    Args:
        source: what to look at.
        config: the defaults when None.
        progress: called with (stage, done, total).
        watch: called with every batch of frames and what was found in it.
        segment: maps pictures (b, 3, h, w) in [0, 1] to masks, in place of `config.masks`.

    Raises:
        FileError: the source, or `config.masks`, cannot be read.
        RecordingError: it is a recording that breaks its format.
    """
    config = config or CalibrationConfig()
    require_device(config.device)
    if not isinstance(source, Recording) and (Path(source) / "recording.yaml").is_file():
        source = load_recording(source)
    if isinstance(source, Recording):
        return DetectionTable(detect_recording(source, config, progress, watch, segment))
    frames = open_source(source)
    masks = open_masks(segment or config.masks, {"right": frames}, config.device)
    camera = _Camera("right", frames, frames.times_s, None, masks.get("right"), "detecting")
    return DetectionTable((_detect_view(camera, config, progress, watch),))


def detect_recording(
    recording: Recording,
    config: CalibrationConfig,
    progress: Progress,
    watch: Watch = no_watch,
    segment: Segmenter | None = None,
) -> tuple[View, ...]:
    """The right view, and the left one of a stereo recording."""
    rig = recording.stereo
    views = {"right": (recording.right, rig.right)}
    if recording.left is not None:
        views["left"] = (recording.left, rig.left)
    sources = {side: source for side, (source, _) in views.items()}
    masks = open_masks(segment or config.masks, sources, config.device)
    cameras = [
        _Camera(side, source, recording.frame_times_s, camera, masks.get(side), f"detecting, {side}")
        for side, (source, camera) in views.items()
    ]
    return tuple(_detect_view(camera, config, progress, watch) for camera in cameras)


@dataclass(frozen=True, eq=False)
class _Camera:
    """What is known of one camera before its frames are decoded."""

    side: str
    source: FrameSource
    times_s: np.ndarray | None
    camera: Camera | None
    masks: MaskReader | None
    stage: str


def _detect_view(view: _Camera, config: CalibrationConfig, progress: Progress, watch: Watch) -> View:
    source = view.source
    moved = None if view.camera is None else view.camera.to(dtype=torch.float64, device=config.device)
    detector = ShaftDetector(config.detector, moved)
    parts, done = [], 0
    progress(view.stage, 0, source.count)
    for batch in source.batches(config.batch_size, config.device):
        masks = None if view.masks is None else view.masks(batch)
        parts.append(detector.detect(batch.images, masks))
        watch(DetectedBatch(view.side, source, view.times_s, detector, batch, masks, parts[-1]))
        done += len(batch.indices)
        progress(view.stage, done, source.count)
    return View(view.side, source, view.camera, concatenate(parts))


def concatenate(parts: list[ShaftDetections]) -> ShaftDetections:
    """Batches of detections, one after the other."""
    joined = {f.name: torch.cat([getattr(part, f.name) for part in parts]) for f in fields(ShaftDetections)}
    return ShaftDetections(**joined)
