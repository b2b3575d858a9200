"""Where the scene's labels stand: beside their points, on no other label or point (templates/scene.js does the same).

Offsets are in em, and hold for the text of a wide and of a narrow window at once: the page chooses the size.
"""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from jaxtyping import Float

TEXT_SIZES = (15.0, 30.0)
"""Sizes of the text in the drawing's units, in a wide and in a narrow window (templates/scene.css)."""
_LETTER, _WIDE_LETTER, _ASCENT, _DESCENT, _LINE = 0.55, 0.65, 0.85, 0.25, 1.2
"""Width of a letter (generous), what a wide one adds, height over and under the baseline, and distance of lines, em."""
_BESIDE, _ABOVE, _BELOW, _DISC = 0.6, -0.45, 1.35, 0.35
"""From the point to the text and to its baseline, and the disc's radius, em."""
_ROWS = 6
"""Lines above and below a point that are tried."""
MEASURES = {
    "text_sizes": TEXT_SIZES,
    "letter": _LETTER,
    "wide_letter": _WIDE_LETTER,
    "ascent": _ASCENT,
    "descent": _DESCENT,
    "line": _LINE,
    "beside": _BESIDE,
    "above": _ABOVE,
    "below": _BELOW,
    "disc": _DISC,
    "rows": _ROWS,
}
"""The same for the page's script."""

Box = tuple[float, float, float, float]
"""Left, top, right, bottom."""


@dataclass(frozen=True)
class Place:
    """A label's place: text that begins (side 1) or ends (side -1) `dx` beside its point, baseline `dy` lower, em."""

    side: int
    dy: float

    @property
    def dx(self) -> float:
        return self.side * _BESIDE

    @property
    def anchor(self) -> str:
        return "start" if self.side > 0 else "end"

    def box(self, point: Float[np.ndarray, " 2"], name: str, size: float) -> Box:
        """What the text covers at a size, in the drawing's units."""
        ends = sorted((self.dx, self.dx + self.side * (_LETTER * len(name) + _WIDE_LETTER)))
        x, y = point.tolist()
        return (
            x + size * ends[0],
            y + size * (self.dy - _ASCENT),
            x + size * ends[1],
            y + size * (self.dy + _DESCENT),
        )


def place_labels(
    points: Float[np.ndarray, "n 2"], names: Sequence[str], sides: Sequence[int], drawing: tuple[float, float]
) -> list[Place | None]:
    """A place for each label, the nearest that is free or else the least covered.

    From the right to the left, so that of two neighbours the left one gives way to the left.

    Args:
        points: what is labelled, in the drawing's units.
        names: the labels.
        sides: the side that each tries first: 1 right, -1 left.
        drawing: its width and height.

    Returns:
        None for a point outside the drawing.
    """
    places: list[Place | None] = [None] * len(names)
    inside = ((points >= 0.0) & (points <= np.array(drawing))).all(-1)
    for i in sorted(np.flatnonzero(inside).tolist(), key=lambda k: -points[k, 0]):

        def covered(place: Place, i: int = i) -> float:
            total = 0.0
            for size in TEXT_SIZES:
                box = place.box(points[i], names[i], size)
                taken = [there.box(points[k], names[k], size) for k, there in enumerate(places) if there is not None]
                taken += [_disc(points[k], size) for k in range(len(names)) if k != i]
                outside = _area(box) - _overlap(box, (0.0, 0.0, *drawing))
                total += (outside + sum(_overlap(box, other) for other in taken)) / size**2
            return total

        places[i] = min(_tried(sides[i]), key=covered)
    return places


def _tried(side: int) -> list[Place]:
    """The places of a label, the nearest first."""
    heights = [first + sign * _LINE * row for row in range(_ROWS) for first, sign in ((_ABOVE, -1.0), (_BELOW, 1.0))]
    return [Place(s, dy) for dy in heights for s in (side, -side)]


def _disc(point: Float[np.ndarray, " 2"], size: float) -> Box:
    x, y = point.tolist()
    return x - _DISC * size, y - _DISC * size, x + _DISC * size, y + _DISC * size


def _area(box: Box) -> float:
    return (box[2] - box[0]) * (box[3] - box[1])


def _overlap(a: Box, b: Box) -> float:
    """Area that two boxes share."""
    wide, tall = min(a[2], b[2]) - max(a[0], b[0]), min(a[3], b[3]) - max(a[1], b[1])
    return max(wide, 0.0) * max(tall, 0.0)
