"""Pictures for the report: a frame with what is drawn on it, embedded as JPEG with the drawing beside it."""

import base64
from dataclasses import dataclass

import cv2
import numpy as np
from jaxtyping import UInt8

from rmis_calib.errors import InputError, ShapeError
from rmis_calib.report.drawing.marks import Mark, draw_marks

MAX_WIDTH_PX = 720
"""Widest embedded picture: twice the width of a column of the page, so that it stays sharp on a phone."""

JPEG_QUALITY = 82


@dataclass(frozen=True)
class Overlay:
    """One frame with what is to be drawn on it.

    Attributes:
        frame: index of the frame in the recording.
        camera: which camera saw it, `right` or `left`.
        image: (height, width, 3) uint8, RGB, as the camera saw it.
        caption: what there is to see, one line.
        used: whether this motion entered the estimate.
        marks: what is drawn, raw px.

    Raises:
        ShapeError: the image is not a picture of that shape and type.
        InputError: the camera is neither.
    """

    frame: int
    camera: str
    image: np.ndarray
    caption: str
    used: bool
    marks: tuple[Mark, ...] = ()

    def __post_init__(self) -> None:
        image = self.image
        if image.ndim != 3 or image.shape[-1] != 3 or image.size == 0 or image.dtype != np.uint8:
            found = f"{tuple(image.shape)} {image.dtype}"
            raise ShapeError(where="Overlay.image", expected="(height, width, 3) uint8 RGB", found=found)
        if self.camera not in ("right", "left"):
            raise InputError(where="Overlay.camera", expected='"right" or "left"', found=repr(self.camera))

    def drawn(self) -> UInt8[np.ndarray, "h w 3"]:
        """A copy of the picture with the marks drawn into it."""
        canvas = np.ascontiguousarray(self.image.copy())
        draw_marks(canvas, self.marks)
        return canvas


@dataclass(frozen=True)
class Picture:
    """An overlay ready for the page.

    Attributes:
        overlay: what it shows.
        data_uri: the JPEG without marks, embedded.
        width_px, height_px: size as embedded.
        marks: what is drawn, in px of the embedded picture.
    """

    overlay: Overlay
    data_uri: str
    width_px: int
    height_px: int
    marks: tuple[Mark, ...]

    @property
    def words(self) -> str:
        """What there is to see, for who cannot see it."""
        overlay = self.overlay
        labels = "".join(f" {mark.label}." for mark in self.marks if mark.label)
        return f"Frame {overlay.frame}, {overlay.camera} camera. {overlay.caption}.{labels}"


def embed(overlay: Overlay, max_width_px: int = MAX_WIDTH_PX) -> Picture:
    """The overlay with its picture as a JPEG data URI, no wider than that."""
    image = overlay.image
    height, width = image.shape[:2]
    scale = min(1.0, max_width_px / width)
    if scale < 1.0:
        height, width = max(1, round(height * scale)), max_width_px
        image = cv2.resize(image, (width, height), interpolation=cv2.INTER_AREA)
    bgr = np.ascontiguousarray(image[..., ::-1])
    encoded = cv2.imencode(".jpg", bgr, [cv2.IMWRITE_JPEG_QUALITY, JPEG_QUALITY])[1]
    payload = base64.b64encode(encoded.tobytes()).decode("ascii")
    # Pixel (0, 0) is the centre of the top-left pixel; an SVG's is its corner.
    marks = tuple(Mark(mark.style, (mark.points + 0.5) * scale, mark.label) for mark in overlay.marks)
    return Picture(overlay, f"data:image/jpeg;base64,{payload}", width, height, marks)
