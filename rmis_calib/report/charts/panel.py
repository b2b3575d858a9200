"""Small charts as plain numbers, which templates/charts.html draws as SVG in the page's own colours and type.

A dot is a stroke without length and with a round end: a hundred of them are one short path.
"""

from dataclasses import dataclass

import numpy as np
from jaxtyping import Float
from matplotlib.ticker import MaxNLocator

LEFT, TOP, BOTTOM = 34.0, 8.0, 32.0
"""Room for labels, in the chart's units, which are about CSS pixels."""
_TITLE = 18.0
"""Room for the title above a picture."""


@dataclass(frozen=True)
class Path:
    """Dots or strokes of one look: `classes` for the style sheet, `d` as in SVG."""

    classes: str
    d: str


@dataclass(frozen=True)
class Chart:
    """One chart.

    Attributes:
        words: what it shows, for who cannot see it.
        width, height: of everything.
        box: left, top, right and bottom of the plotting area.
        title: above it; label: of the horizontal axis.
        x_ticks, y_ticks: places and labels.
        zero: place of the horizontal line at 0; None for none.
        framed: whether the plotting area has a border.
        paths: what is drawn.
    """

    words: str
    width: float
    height: float
    box: tuple[float, float, float, float]
    title: str
    label: str
    x_ticks: tuple[tuple[float, str], ...]
    y_ticks: tuple[tuple[float, str], ...]
    zero: float | None
    framed: bool
    paths: tuple[Path, ...]


@dataclass(frozen=True)
class PictureArea:
    """A chart over a camera's picture.

    Attributes:
        size: (height, width) of the picture, px.
        width: of the plotting area.
    """

    size: tuple[int, int]
    width: float

    @property
    def scale(self) -> float:
        """A pixel in the chart."""
        return self.width / self.size[1]

    def places(self, uv: Float[np.ndarray, "*n 2"]) -> Float[np.ndarray, "*n 2"]:
        """Where pixels lie."""
        return (uv + 0.5) * self.scale + np.array([0.5, _TITLE])

    def chart(self, words: str, title: str, paths: list[Path]) -> Chart:
        """The chart of these paths."""
        bottom = self.size[0] * self.scale + _TITLE
        box = (0.5, _TITLE, self.width + 0.5, bottom)
        return Chart(words, self.width + 1.0, bottom + 1.0, box, title, "", (), (), None, True, tuple(paths))


@dataclass(frozen=True)
class Scale:
    """Values from `low` to `high` onto places from `start` to `stop`."""

    low: float
    high: float
    start: float
    stop: float

    def __call__(self, values: Float[np.ndarray, " n"]) -> Float[np.ndarray, " n"]:
        """Where values lie."""
        return self.start + (values - self.low) / (self.high - self.low) * (self.stop - self.start)

    def at(self, value: float) -> float:
        """Where one value lies."""
        return float(self(np.array([value], dtype=float))[0])

    def ticks(self, count: int) -> tuple[tuple[float, str], ...]:
        """Round values within the range, with their places."""
        values = np.asarray(MaxNLocator(count, steps=[1, 2, 5, 10]).tick_values(self.low, self.high))
        slack = 1e-9 * (self.high - self.low)
        kept = [value for value in values.tolist() if self.low - slack <= value <= self.high + slack]
        return tuple((round(self.at(value), 1), f"{value + 0.0:g}".replace("-", "−")) for value in kept)


def range_of(values: Float[np.ndarray, " n"], margin: float = 0.04) -> tuple[float, float]:
    """Least and largest finite value with a margin; never an empty range."""
    known = values[np.isfinite(values)]
    if not len(known):
        return 0.0, 1.0
    low, high = float(known.min()), float(known.max())
    more = margin * (high - low) or max(1e-3, 0.05 * abs(high))
    return low - more, high + more


def dots(x: Float[np.ndarray, " n"], y: Float[np.ndarray, " n"]) -> str:
    """The path of dots at these places; NaN is none."""
    known = np.isfinite(x) & np.isfinite(y)
    return "".join(f"M{a:.1f} {b:.1f}h0" for a, b in zip(x[known].tolist(), y[known].tolist(), strict=True))


def strokes(start: Float[np.ndarray, "n 2"], end: Float[np.ndarray, "n 2"]) -> str:
    """The path of straight strokes; NaN is none."""
    known = np.isfinite(start).all(1) & np.isfinite(end).all(1)
    ends = np.concatenate([start, end], axis=1)[known].tolist()
    return "".join(f"M{a:.1f} {b:.1f}L{c:.1f} {d:.1f}" for a, b, c, d in ends)
