"""Shafts in all frames of the cameras: decoded in the background, detected in batches, gathered on the device."""

from collections import deque
from collections.abc import Callable, Iterator
from concurrent.futures import Future, ThreadPoolExecutor
from contextlib import ExitStack, contextmanager
from dataclasses import dataclass
from functools import partial
from pathlib import Path

import numpy as np
import torch
from torch import Tensor

from rmis_calib.config import CalibrationConfig
from rmis_calib.geometry.cameras import Camera
from rmis_calib.io import FrameBatch, FrameSource, Recording, load_recording, open_source
from rmis_calib.pipeline.device import require_device
from rmis_calib.pipeline.pictures.frozen import ChangeMeter
from rmis_calib.pipeline.pictures.masks import MaskReader, open_masks
from rmis_calib.pipeline.pictures.memory import detect_run, in_runs
from rmis_calib.vision import DetectorSettings, EndKind, FrameReason, ShaftDetections, ShaftDetector
from rmis_calib.vision.masks import Segmenter

Progress = Callable[[str, int, int], None]
_MOST_WORKERS = 4


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
        change: largest change of each picture from the one before, levels of 255; infinite where it was not looked at.
        head_step: (N, 2) how far labelled head points are to be moved to where they were when the middle row was read,
            normalised units; None: they stay.
    """

    side: str
    source: FrameSource
    camera: Camera | None
    detections: ShaftDetections
    change: Tensor
    head_step: Tensor | None = None

    @property
    def found(self) -> Tensor:
        """(N,) frames with at least one shaft."""
        return self.detections.valid.any(dim=-1)

    def at(self, frames: np.ndarray) -> ShaftDetections:
        """The detections of some frames, by their numbers."""
        return self.detections.of_frames(torch.as_tensor(frames, device=self.detections.valid.device))


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
            searched = int((view.detections.reason != FrameReason.LEFT_OUT).sum())
            rows.append((name, f"{int(found.sum())} of {searched} frames with a shaft"))
            ends = (view.detections.end_valid & view.detections.valid).any(dim=-1)
            rows.append(("  shaft end seen", f"{int(ends.sum())}"))
            codes, counts = view.detections.reason[~found].unique(return_counts=True)
            for code, count in zip(codes.tolist(), counts.tolist(), strict=True):
                rows.append((f"  {FrameReason(code).sentence}", str(count)))
        return rows


@dataclass(frozen=True)
class Detectors:
    """Who looks for shafts: this process, on the device of the configuration, or another one that looks for many.

    Attributes:
        make: a detector from settings and camera.
        pictures_on: device that decoded pictures go to; None: the configuration's.
        at_once: batches under way; None: as many as the device does well.
    """

    make: Callable[[DetectorSettings, Camera | None], ShaftDetector] = ShaftDetector
    pictures_on: str | None = None
    at_once: int | None = None


OWN_DETECTORS = Detectors()


def detect(
    source: Recording | str | Path,
    config: CalibrationConfig | None = None,
    progress: Progress = no_progress,
    watch: Watch = no_watch,
    segment: Segmenter | None = None,
    detectors: Detectors = OWN_DETECTORS,
) -> DetectionTable:
    """Find the shaft in a recording, or in a bare video, folder of images or image (then in pixels).

    Args:
        source: what to look at.
        config: the defaults when None.
        progress: called with (stage, done, total).
        watch: called with every batch of frames and what was found in it.
        segment: maps pictures (b, 3, h, w) in [0, 1] to masks, in place of `config.masks`.
        detectors: who looks for shafts.

    Raises:
        FileError: the source, or `config.masks`, cannot be read.
        RecordingError: it is a recording that breaks its format.
    """
    config = config or CalibrationConfig()
    require_device(config.device)
    if not isinstance(source, Recording) and (Path(source) / "recording.yaml").is_file():
        source = load_recording(source)
    if isinstance(source, Recording):
        return DetectionTable(detect_recording(source, config, progress, watch, segment, detectors))
    frames = open_source(source)
    masks = open_masks(segment or config.masks, {"right": frames}, config.device, config.mask_labels)
    camera = _Camera("right", frames, frames.times_s, None, masks.get("right"), "detecting")
    return DetectionTable(_detect_views([camera], config, progress, watch, detectors))


def detect_recording(
    recording: Recording,
    config: CalibrationConfig,
    progress: Progress,
    watch: Watch = no_watch,
    segment: Segmenter | None = None,
    detectors: Detectors = OWN_DETECTORS,
) -> tuple[View, ...]:
    """The right view, and the left one of a stereo recording."""
    rig = recording.stereo
    views: dict[str, tuple[FrameSource, Camera | None]] = {"right": (recording.right, rig.right)}
    if recording.left is not None:
        views["left"] = (recording.left, rig.left)
    sources = {side: source for side, (source, _) in views.items()}
    masks = open_masks(segment or config.masks, sources, config.device, config.mask_labels)
    cameras = [
        _Camera(side, source, recording.frame_times_s, camera, masks.get(side), f"detecting, {side}")
        for side, (source, camera) in views.items()
    ]
    return _detect_views(cameras, config, progress, watch, detectors)


@dataclass(frozen=True, eq=False)
class _Camera:
    """What is known of one camera before its frames are decoded."""

    side: str
    source: FrameSource
    times_s: np.ndarray | None
    camera: Camera | None
    masks: MaskReader | None
    stage: str


def _detect_views(
    cameras: list[_Camera], config: CalibrationConfig, progress: Progress, watch: Watch, detectors: Detectors
) -> tuple[View, ...]:
    """All cameras at once: their videos are decoded side by side, and the next batches while the last are searched."""
    tables: dict[str, ShaftDetections] = {}
    meters = {camera.side: ChangeMeter() for camera in cameras}
    changes = {camera.side: torch.full((camera.source.count,), torch.inf) for camera in cameras}
    done = dict.fromkeys(changes, 0)
    wanted = {camera.side: -(-camera.source.count // config.every) for camera in cameras}
    for camera in cameras:
        progress(camera.stage, 0, wanted[camera.side])
    with ExitStack() as stack:
        executor, at_once = stack.enter_context(detecting_threads(config.device, detectors.at_once))
        running: deque[tuple[_Camera, ShaftDetector, FrameBatch, Tensor | None, Future[ShaftDetections]]] = deque()

        def finish_one() -> None:
            camera, detector, batch, masks, future = running.popleft()
            found = future.result()
            # Into one table each: small tensors of every batch, kept, would scatter over memory between those that go.
            if camera.side not in tables:
                tables[camera.side] = over_all(found, camera.source.count, batch.indices)
            tables[camera.side].put(batch.indices, found)
            changes[camera.side][batch.indices] = meters[camera.side](batch.images).cpu()
            watch(DetectedBatch(camera.side, camera.source, camera.times_s, detector, batch, masks, found))
            done[camera.side] += len(batch.indices)
            progress(camera.stage, done[camera.side], wanted[camera.side])

        for camera, detector, batch in _take_turns(cameras, config, detectors, stack):
            masks = None if camera.masks is None else camera.masks(batch)
            running.append((camera, detector, batch, masks, executor.submit(_detect, detector, batch, masks, config)))
            if len(running) > at_once:
                finish_one()
        while running:
            finish_one()
    return tuple(View(c.side, c.source, c.camera, tables[c.side], changes[c.side]) for c in cameras)


def _take_turns(
    cameras: list[_Camera], config: CalibrationConfig, detectors: Detectors, stack: ExitStack
) -> Iterator[tuple[_Camera, ShaftDetector, FrameBatch]]:
    """A batch of each camera in turn until all are through; leaving the stack ends their decoding."""
    left = deque()
    device = detectors.pictures_on or config.device
    for camera in cameras:
        batches = camera.source.batches(config.batch_size, device, config.every)
        stack.callback(batches.close)
        moved = None if camera.camera is None else camera.camera.to(dtype=torch.float64, device=device)
        remembers = camera.masks is None and config.search_every > 1
        parts = in_runs(batches) if remembers else batches
        left.append((camera, detectors.make(config.detector, moved), parts))
    while left:
        camera, detector, batches = left.popleft()
        batch = next(batches, None)
        if batch is not None:
            left.append((camera, detector, batches))
            yield camera, detector, batch


def _detect(
    detector: ShaftDetector, batch: FrameBatch, masks: Tensor | None, config: CalibrationConfig
) -> ShaftDetections:
    """Shafts of a batch, or of a run of consecutive pictures."""
    if masks is not None or config.search_every == 1:
        return detector.detect(batch.images, masks)
    return detect_run(detector, batch.images, config.search_every, config.batch_size)


@contextmanager
def detecting_threads(device: str, at_once: int | None = None) -> Iterator[tuple[ThreadPoolExecutor, int]]:
    """Threads that detect, and how many there are.

    Most steps of the search are small: on a CPU two batches beside each other, each on one core, are 15 per cent
    faster than one on both. Beyond four, threads wait for Python. A GPU takes one batch after the other.
    """
    threads = torch.get_num_threads()
    count = at_once or (min(threads, _MOST_WORKERS) if torch.device(device).type == "cpu" else 1)
    start = partial(torch.set_num_threads, max(1, threads // count))
    with ThreadPoolExecutor(count, thread_name_prefix="rmis-detect", initializer=start) as executor:
        try:
            yield executor, count
        finally:
            executor.shutdown(wait=True, cancel_futures=True)
            torch.set_num_threads(threads)  # what a thread sets for itself is the default of later ones too


def over_all(found: ShaftDetections, count: int, searched: Tensor) -> ShaftDetections:
    """Detections of the searched frames, as those of all `count` frames."""
    spread = {}
    for name, value in vars(found).items():
        codes = {"reason": int(FrameReason.LEFT_OUT), "end_kind": int(EndKind.UNKNOWN)}
        empty = torch.nan if value.is_floating_point() else codes.get(name, False)
        spread[name] = value.new_full((count, *value.shape[1:]), empty)
        spread[name][searched] = value
    return ShaftDetections(**spread)
