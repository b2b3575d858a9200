"""What `detect` draws while the frames are in memory: overlays, an overlay video a camera, and sheets of the stages."""

from collections import Counter
from contextlib import ExitStack
from dataclasses import dataclass
from pathlib import Path
from types import TracebackType

import cv2
import numpy as np
import torch

from rmis_calib.errors import OutputError
from rmis_calib.io.video_writing import OverlayVideo
from rmis_calib.pipeline.pictures.detection import DetectedBatch
from rmis_calib.report.drawing.frames import spread
from rmis_calib.vision import FrameReason, draw_detections, draw_stage_sheet

_STILLS_HZ = 5.0
"""Pictures a second of an overlay video of images whose times are unknown."""
_RATES_HZ = (1.0, 120.0)
"""Slower and faster than this players do badly."""


@dataclass(frozen=True)
class PictureChoice:
    """Which pictures `DetectionPictures` draws.

    Attributes:
        overlays: JPEGs a camera, spread over the frames; -1: every frame.
        video: an overlay video a camera.
        stages: sheets of the stages a camera: of every frame where there are no more than this, else of the first so
            many frames without a shaft; -1: of every frame.
    """

    overlays: int = -1
    video: bool = False
    stages: int = 0


class DetectionPictures:
    """Draws batches as they are detected, into a folder: overlays/*.jpg, overlay_<side>.mp4, debug/*.jpg.

    A context manager: leaving it completes the videos. Memory does not grow with the number of frames.
    """

    def __init__(self, folder: Path, choice: PictureChoice) -> None:
        self._folder, self._choice = folder, choice
        self._open = ExitStack()
        self._videos: dict[str, OverlayVideo] = {}
        self._drawn: dict[str, set[int]] = {}
        self.sheets: Counter[str] = Counter()
        """Sheets of stages drawn, by side."""
        self.failed: Counter[str] = Counter()
        """Frames without a shaft, by side."""
        (folder / "overlays").mkdir()
        if choice.stages:
            (folder / "debug").mkdir()

    def __enter__(self) -> "DetectionPictures":
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self._open.__exit__(kind, error, trace)

    def add(self, batch: DetectedBatch) -> None:
        """Draw a batch."""
        if batch.side not in self._drawn:
            self._drawn[batch.side] = set(spread(batch.source.count, self._choice.overlays).tolist())
            if self._choice.video:
                path = self._folder / f"overlay_{batch.side}.mp4"
                video = OverlayVideo(path, batch.source.size, playing_rate_hz(batch.times_s))
                self._videos[batch.side] = self._open.enter_context(video)
        frames = batch.frames.indices.tolist()
        chosen = [i for i, frame in enumerate(frames) if self._choice.video or frame in self._drawn[batch.side]]
        for i in chosen:
            canvas = draw_detections(_picture(batch, i), batch.detections, i, label=frame_label(batch, i))
            if self._choice.video:
                self._videos[batch.side].add(canvas)
            if frames[i] in self._drawn[batch.side]:
                write_picture(self._folder / "overlays" / f"{batch.side}_{frames[i]:06d}.jpg", canvas)
        self._explain(batch)

    def _explain(self, batch: DetectedBatch) -> None:
        """Sheets of the stages of those frames of the batch that are to have one."""
        failed = (~batch.detections.valid.any(-1)).tolist()
        self.failed[batch.side] += sum(failed)
        limit = self._choice.stages
        every = limit < 0 or batch.source.count <= limit
        wanted = [i for i, has_failed in enumerate(failed) if every or has_failed]
        if not every:
            wanted = wanted[: limit - self.sheets[batch.side]]
        if not wanted:
            return
        self.sheets[batch.side] += len(wanted)
        index = torch.tensor(wanted, device=batch.frames.images.device)
        masks = None if batch.masks is None else batch.masks[index]
        found, stages = batch.detector.explain(batch.frames.images[index], masks)
        for place, i in enumerate(wanted):
            title = f"camera {batch.side}, {frame_name(batch, i)}"
            sheet = draw_stage_sheet(_picture(batch, i), found, stages, place, title)
            write_picture(self._folder / "debug" / f"{batch.side}_{int(batch.frames.indices[i]):06d}.jpg", sheet)


def playing_rate_hz(times_s: np.ndarray | None) -> float:
    """Frames a second of a video whose frames have these times: the usual one, within what players can do."""
    if times_s is None or len(times_s) < 2:
        return _STILLS_HZ
    return float(np.clip(1.0 / max(float(np.median(np.diff(times_s))), 1e-6), *_RATES_HZ))


def frame_name(batch: DetectedBatch, i: int) -> str:
    """Number and time of a frame of the batch."""
    frame = int(batch.frames.indices[i])
    return f"frame {frame}" + ("" if batch.times_s is None else f", {batch.times_s[frame]:.3f} s")


def frame_label(batch: DetectedBatch, i: int) -> str:
    """A frame's name and what was found in it."""
    reason = FrameReason(int(batch.detections.reason[i]))
    count = int(batch.detections.valid[i].sum())
    found = f"{count} shaft{'s' if count > 1 else ''}" if reason is FrameReason.OK else f"no shaft: {reason.sentence}"
    return f"{frame_name(batch, i)}   {found}"


def _picture(batch: DetectedBatch, i: int) -> np.ndarray:
    """(h, w, 3) uint8 RGB."""
    return np.ascontiguousarray(batch.frames.images[i].permute(1, 2, 0).cpu().numpy())


def write_picture(path: Path, image_rgb: np.ndarray) -> None:
    """A JPEG from RGB.

    Raises:
        OutputError: the file cannot be written; says why, which `cv2.imwrite` does not.
    """
    _, coded = cv2.imencode(".jpg", np.ascontiguousarray(image_rgb[..., ::-1]), [cv2.IMWRITE_JPEG_QUALITY, 92])
    try:
        path.write_bytes(coded.tobytes())
    except OSError as error:
        raise OutputError(where=str(path), expected="a place that can be written", found=error.strerror) from error
