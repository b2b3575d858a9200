"""What is drawn on a picture, as lines and dots with a meaning: once, for pages (SVG) and for files (pixels)."""

from dataclasses import dataclass
from typing import Literal

import cv2
import numpy as np
from jaxtyping import Float, UInt8

from rmis_calib.vision import draw_dot, draw_polyline

DETECTED_RGB = (64, 224, 255)
"""Colour of what was found in the image. Cyan: absent from tissue, and unlike amber for every kind of colour vision."""
PREDICTED_RGB = (255, 176, 0)
"""Colour of what the calibration predicts, drawn over what was detected."""
REFUSED_RGB = (255, 64, 129)
"""Colour of a candidate that was not taken, or contradicts."""


@dataclass(frozen=True)
class Style:
    """How one kind of mark looks, and what the legend says of it.

    Attributes:
        words: for the legend.
        rgb: colour.
        kind: `line`, `dashed`, `arrow` (towards its last point), `dot` or `ring`.
        width: of a line, or radius of a dot, in thousandths of the picture's width.
    """

    words: str
    rgb: tuple[int, int, int]
    kind: Literal["line", "dashed", "arrow", "dot", "ring"]
    width: float


STYLES = {
    "detected": Style("edges found in the picture", DETECTED_RGB, "line", 3.0),
    "predicted": Style("edges where the result puts them, from the RCM to the shaft's end", PREDICTED_RGB, "line", 2.0),
    "refused": Style("candidate that was not taken, or does not fit", REFUSED_RGB, "line", 3.0),
    "search": Style("strip that the search looked at and did not accept", REFUSED_RGB, "dashed", 2.5),
    "end": Style("end of the shaft, found", DETECTED_RGB, "ring", 7.0),
    "end_predicted": Style("end of the shaft, predicted", PREDICTED_RGB, "dot", 4.0),
    "head": Style("head point, labelled", (255, 255, 255), "ring", 9.0),
    "head_predicted": Style("head point, predicted", (120, 255, 140), "dot", 4.5),
    "wrist": Style("from the shaft's end over the wrist to the tip", (120, 255, 140), "dashed", 2.0),
    "tip": Style("last frame of the arm, at the tip", (120, 255, 140), "ring", 5.0),
    "rcm": Style("towards the remote centre (RCM)", (255, 255, 255), "arrow", 2.5),
    "x": Style("x axis of arm, 10 mm", (255, 96, 96), "arrow", 2.0),
    "y": Style("y axis of arm, 10 mm", (120, 255, 140), "arrow", 2.0),
    "z": Style("z axis of arm, 10 mm", (120, 160, 255), "arrow", 2.0),
    "sigma1": Style("1 σ of the answer at this point", (255, 255, 255), "line", 3.0),
    "sigma2": Style("2 σ", (255, 255, 255), "dashed", 2.5),
}  # fmt: skip
"""By name, in the order in which they are drawn and explained."""


@dataclass(frozen=True, eq=False)
class Mark:
    """A line, an arrow or a dot on a picture.

    Attributes:
        style: key of `STYLES`.
        points: (p, 2) raw px; NaN breaks a line; one point for a dot.
        label: shown beside the last point, and to who cannot see the picture.
    """

    style: str
    points: Float[np.ndarray, "p 2"]
    label: str = ""

    @property
    def runs(self) -> list[np.ndarray]:
        """The finite stretches of the line."""
        known = np.asarray(np.isfinite(self.points).all(-1))
        cuts = np.flatnonzero(np.diff(known.astype(int))) + 1
        parts = np.split(np.arange(len(known)), cuts)
        return [self.points[part] for part in parts if len(part) and known[part[0]]]


def draw_marks(canvas: UInt8[np.ndarray, "h w 3"], marks: tuple[Mark, ...]) -> None:
    """Draw marks into a picture, RGB."""
    scale = canvas.shape[1] / 1000.0
    for mark in marks:
        style = STYLES[mark.style]
        width = max(1, round(style.width * scale))
        for points in mark.runs:
            if style.kind == "dot":
                draw_dot(canvas, points[-1], style.rgb, width)
            elif style.kind == "ring":
                _circle(canvas, points[-1], style.rgb, max(2, width))
            elif style.kind == "dashed":
                for dash in _dashes(points, 8.0 * scale):
                    draw_polyline(canvas, dash, style.rgb, width)
            else:
                draw_polyline(canvas, points, style.rgb, width)
            if style.kind == "arrow" and len(points) > 1:
                draw_polyline(canvas, arrow_head(points, 12.0 * scale), style.rgb, width)


def arrow_head(points: Float[np.ndarray, "p 2"], length: float) -> Float[np.ndarray, "3 2"]:
    """The two strokes of an arrow's head, as a line through its tip."""
    along = points[-1] - points[-2]
    along = along / max(float(np.linalg.norm(along)), 1e-9) * length
    across = 0.5 * np.array([-along[1], along[0]])
    return np.stack([points[-1] - along + across, points[-1], points[-1] - along - across])


def _dashes(points: Float[np.ndarray, "p 2"], length: float) -> list[np.ndarray]:
    """Every second stretch of this length of a line."""
    at = np.concatenate([[0.0], np.cumsum(np.linalg.norm(np.diff(points, axis=0), axis=1))])
    count = int(min(at[-1] / max(length, 1.0), 1000)) + 1
    where = np.linspace(0.0, at[-1], 2 * (count // 2) + 2)
    cuts = np.stack([np.interp(where, at, points[:, axis]) for axis in (0, 1)], axis=1)
    return list(cuts.reshape(-1, 2, 2))


def _circle(canvas: np.ndarray, uv: np.ndarray, rgb: tuple[int, int, int], radius: int) -> None:
    if np.abs(uv).max() < 4.0 * max(canvas.shape):
        centre = (round(float(uv[0]) * 16), round(float(uv[1]) * 16))
        cv2.circle(canvas, centre, radius * 16, rgb, max(1, radius // 4), cv2.LINE_AA, 4)
