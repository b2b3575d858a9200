"""Pictures for the report: a frame with its detected and predicted contours, embedded as JPEG."""

import base64
from dataclasses import dataclass

import cv2
import numpy as np

from rmis_calib.errors import InputError, ShapeError

DETECTED_RGB = (64, 224, 255)
"""Colour of what was found in the image. Cyan: absent from tissue, and unlike amber for every kind of colour vision."""

PREDICTED_RGB = (255, 176, 0)
"""Colour of what the calibration predicts, drawn over the detected contours."""

MAX_WIDTH_PX = 720
"""Widest embedded picture: twice the width of a column of the page, so that it stays sharp on a phone."""

JPEG_QUALITY = 85


@dataclass(frozen=True)
class Overlay:
    """One frame with its contours drawn: detected in `DETECTED_RGB`, predicted in `PREDICTED_RGB`.

    Attributes:
        frame: index of the frame in the recording.
        camera: which camera saw it, `right` or `left`.
        image: (height, width, 3) uint8, RGB, with the contours drawn.
        caption: what there is to see, one line.
        used: whether this motion entered the estimate.

    Raises:
        ShapeError: the image is not a picture of that shape and type.
        InputError: the camera is neither.
    """

    frame: int
    camera: str
    image: np.ndarray
    caption: str
    used: bool

    def __post_init__(self) -> None:
        image = self.image
        if image.ndim != 3 or image.shape[-1] != 3 or image.size == 0 or image.dtype != np.uint8:
            found = f"{tuple(image.shape)} {image.dtype}"
            raise ShapeError(where="Overlay.image", expected="(height, width, 3) uint8 RGB", found=found)
        if self.camera not in ("right", "left"):
            raise InputError(where="Overlay.camera", expected='"right" or "left"', found=repr(self.camera))


@dataclass(frozen=True)
class Picture:
    """An overlay ready for the page.

    Attributes:
        overlay: what it shows.
        data_uri: the JPEG, embedded.
        width_px: width as embedded.
        height_px: height as embedded.
    """

    overlay: Overlay
    data_uri: str
    width_px: int
    height_px: int


def embed(overlay: Overlay) -> Picture:
    """The overlay as a JPEG data URI, no wider than `MAX_WIDTH_PX`."""
    image = overlay.image
    height, width = image.shape[:2]
    if width > MAX_WIDTH_PX:
        height, width = max(1, round(height * MAX_WIDTH_PX / width)), MAX_WIDTH_PX
        image = cv2.resize(image, (width, height), interpolation=cv2.INTER_AREA)
    bgr = np.ascontiguousarray(image[..., ::-1])
    encoded = cv2.imencode(".jpg", bgr, [cv2.IMWRITE_JPEG_QUALITY, JPEG_QUALITY])[1]
    payload = base64.b64encode(encoded.tobytes()).decode("ascii")
    return Picture(overlay, f"data:image/jpeg;base64,{payload}", width, height)
