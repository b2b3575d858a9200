"""A calibration as a video: every motion with its contours, its residual and the verdict; and its smallest picture."""

from collections.abc import Sequence
from pathlib import Path

import cv2
import numpy as np

from rmis_calib.io.video_writing import OverlayVideo
from rmis_calib.pipeline.answer.run import CalibrationRun
from rmis_calib.report.detection_pictures import playing_rate_hz
from rmis_calib.report.drawing.frames import overlays
from rmis_calib.report.drawing.overlays import Overlay
from rmis_calib.report.words.verdict import headline
from rmis_calib.results import CalibrationResult

THUMBNAIL_PX = (160, 120)
"""Width and height that a thumbnail fits into."""
_BAR_PX = 0.055
"""Height of the caption and of the residual's bar, as a part of the picture's height."""
_FULL_SCALE_PX = 5.0
"""Residual at which the bar is full."""
_INK, _QUIET, _PLATE = (236, 240, 242), (155, 171, 181), (17, 22, 26)
_TONES = {"ok": (98, 205, 184), "weak": (240, 180, 92), "bad": (255, 154, 143)}


def write_overlay_videos(folder: Path, run: CalibrationRun) -> None:
    """overlay_right.mp4 and, of a stereo recording, overlay_left.mp4; memory does not grow with their length.

    Below each picture stands what became of its motion, the distance of its contours from the prediction as a bar (full
    at 5 px), and the result's verdict.

    Args:
        folder: existing folder.
        run: what to draw.

    Raises:
        OutputError: a video cannot be written.
    """
    if not len(run.poses.frames):
        return
    times_s = run.recording.frame_times_s[run.poses.frames]
    for view in run.views:
        height, width = view.source.size
        strip = _strip_height(height)
        with OverlayVideo(
            folder / f"overlay_{view.side}.mp4", (height + strip, width), playing_rate_hz(times_s)
        ) as video:
            for overlay in overlays(run, np.arange(len(run.poses.frames)), view.side):
                video.add(np.concatenate([overlay.drawn(), _strip(overlay, run.result, strip)]))


def write_thumbnail(path: Path, drawn: Sequence[Overlay]) -> None:
    """One of these pictures as a JPEG of 160 x 120 px at most: of the right camera and of a used motion where there is
    one, from the middle.

    Raises:
        OutputError: it cannot be written.
    """
    right = [overlay for overlay in drawn if overlay.camera == "right"]
    shown = [overlay for overlay in right if overlay.used] or right
    if not shown:
        return
    overlay = shown[len(shown) // 2]
    image = overlay.drawn()
    height, width = image.shape[:2]
    scale = min(THUMBNAIL_PX[0] / width, THUMBNAIL_PX[1] / height)
    size = (max(1, round(width * scale)), max(1, round(height * scale)))
    small = cv2.resize(image, size, interpolation=cv2.INTER_AREA)
    encoded = cv2.imencode(".jpg", np.ascontiguousarray(small[..., ::-1]), [cv2.IMWRITE_JPEG_QUALITY, 70])[1]
    path.write_bytes(encoded.tobytes())


def _strip_height(height: int) -> int:
    return max(24, 2 * round(_BAR_PX * height))


def _strip(overlay: Overlay, result: CalibrationResult, height: int) -> np.ndarray:
    """The lines below a picture: what became of the motion with its residual's bar, and the verdict."""
    width = overlay.image.shape[1]
    strip = np.full((height, width, 3), _PLATE, np.uint8)
    half, margin = height // 2, max(6, width // 80)
    value = result.residual(f"contour_{overlay.camera}", overlay.frame)
    tone = _TONES[headline(result).tone]
    _write(strip, f"frame {overlay.frame}: {overlay.caption}", (margin, half), half, _INK if overlay.used else _QUIET)
    _write(strip, f"{result.status}: {result.message}", (margin, height), half, tone)
    if value is not None:
        length = round(0.25 * width)
        left, top, bottom = width - margin - length, round(0.3 * half), round(0.75 * half)
        cv2.rectangle(strip, (left, top), (width - margin, bottom), _QUIET, 1)
        full = round(length * min(1.0, value / _FULL_SCALE_PX))
        cv2.rectangle(strip, (left, top), (left + full, bottom), _TONES["ok" if overlay.used else "bad"], -1)
    return strip


def _write(strip: np.ndarray, text: str, place: tuple[int, int], height: int, colour: tuple[int, int, int]) -> None:
    """One line that ends at the strip's edge, its base a third of a line above `place`."""
    scale = height / 40.0
    cv2.putText(
        strip, text, (place[0], place[1] - height // 3), cv2.FONT_HERSHEY_SIMPLEX, scale, colour, 1, cv2.LINE_AA
    )
