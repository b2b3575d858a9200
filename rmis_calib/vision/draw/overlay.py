"""Pictures that show what was detected, for reports and for the eye."""

from itertools import pairwise

import cv2
import numpy as np

from rmis_calib.vision.detections import ShaftDetections

_EDGE_COLOURS = ((255, 196, 0), (0, 214, 255), (170, 255, 90))
"""Amber, cyan, green: best, second, third shaft. All legible on red tissue, pink phantom and dark lab."""
_END_COLOUR = (255, 60, 220)
_PREDICTED_COLOUR = (255, 255, 255)
_SHIFT = 4


def draw_detections(
    image: np.ndarray, found: ShaftDetections, frame: int = 0, predicted_uv: np.ndarray | None = None, label: str = ""
) -> np.ndarray:
    """A copy of a picture with contours, middle lines and ends drawn on it.

    Args:
        image: (h, w, 3) uint8 RGB.
        found: detections of a batch.
        frame: which frame of the batch the picture is.
        predicted_uv: polylines to compare with, (n, points, 2) raw px, drawn thin and white; NaN points break a line.
        label: text for the top left corner.

    Returns:
        (h, w, 3) uint8 RGB.
    """
    canvas = np.ascontiguousarray(image.copy())
    weight = max(1, round(image.shape[1] / 640))
    if predicted_uv is not None:
        for line in predicted_uv:
            draw_polyline(canvas, np.asarray(line, float), _PREDICTED_COLOUR, 1)
    for rank in range(found.valid.shape[1] - 1, -1, -1):
        if not bool(found.valid[frame, rank]):
            continue
        colour = _EDGE_COLOURS[rank % len(_EDGE_COLOURS)]
        contours = found.contour_uv[frame, rank].double().cpu().numpy()
        for line in contours:
            draw_polyline(canvas, line, (0, 0, 0), weight + 2)
        for line in contours:
            draw_polyline(canvas, line, colour, weight)
        draw_polyline(canvas, contours.mean(0)[::2], colour, 1)
        _end(canvas, contours, found, frame, rank, weight)
        place = contours[0, contours.shape[1] // 2]
        text = f"{float(found.confidence[frame, rank]):.2f}"
        if np.isfinite(place).all():
            _text(canvas, text, (int(place[0]) + 8, int(place[1]) - 8), colour)
    if label:
        _text(canvas, label, (10, 24), (255, 255, 255))
    return canvas


def _end(canvas: np.ndarray, contours: np.ndarray, found: ShaftDetections, frame: int, rank: int, weight: int) -> None:
    """A bar across the shaft where it ends, and a dot on the axis."""
    if not bool(found.end_valid[frame, rank]):
        return
    draw_polyline(canvas, contours[:, -1], _END_COLOUR, weight)
    centre = found.end_uv[frame, rank].double().cpu().numpy()
    draw_dot(canvas, centre, _END_COLOUR, weight + 2)


def _fixed(point: np.ndarray) -> tuple[int, int]:
    return round(float(point[0]) * (1 << _SHIFT)), round(float(point[1]) * (1 << _SHIFT))


def draw_polyline(canvas: np.ndarray, points: np.ndarray, colour: tuple[int, int, int], weight: int) -> None:
    """A line through (n, 2) raw px, drawn to a sixteenth of a pixel; NaN points, and far outside ones, break it."""
    limit = 4.0 * max(canvas.shape)
    for a, b in pairwise(points):
        if np.isfinite([a, b]).all() and np.abs([a, b]).max() < limit:
            cv2.line(canvas, _fixed(a), _fixed(b), colour, weight, cv2.LINE_AA, _SHIFT)


def draw_dot(canvas: np.ndarray, uv: np.ndarray, colour: tuple[int, int, int], radius: int) -> None:
    """A disc about a point in raw px; nothing where it is NaN or far outside."""
    if np.isfinite(uv).all() and np.abs(uv).max() < 4.0 * max(canvas.shape):
        cv2.circle(canvas, _fixed(uv), radius << _SHIFT, colour, -1, cv2.LINE_AA, _SHIFT)


def _text(canvas: np.ndarray, text: str, place: tuple[int, int], colour: tuple[int, int, int]) -> None:
    """Text on a darkened plate, which is legible on tissue, glare and black; moved into the picture where it is not."""
    size = max(0.5, canvas.shape[1] / 1600)
    (width, height), below = cv2.getTextSize(text, cv2.FONT_HERSHEY_SIMPLEX, size, 1)
    margin = round(8 * size)
    left = int(np.clip(place[0], margin, max(margin, canvas.shape[1] - width - margin)))
    base = int(np.clip(place[1], height + margin, max(height + margin, canvas.shape[0] - below - margin)))
    plate = canvas[base - height - margin : base + below + margin // 2, left - margin : left + width + margin]
    plate[:] = plate // 4
    cv2.putText(canvas, text, (left, base), cv2.FONT_HERSHEY_SIMPLEX, size, colour, 1, cv2.LINE_AA)
