"""Edges of the pictures against the predicted contours, as sticks over the picture, coloured by their sign."""

from dataclasses import dataclass

import numpy as np
from jaxtyping import Bool, Float

from rmis_calib.pipeline.answer.run import CalibrationRun
from rmis_calib.pipeline.answer.view_edges import ViewEdges
from rmis_calib.report.charts.panel import Chart, Path, PictureArea, dots, strokes
from rmis_calib.report.charts.residuals import drawn_points, rounded_factor

_WIDTH = 400.0
"""Of a chart."""
_STICK = 0.03
"""Length of a stick of one robust scale, in picture widths."""
_MOST_SCALES = 6.0


@dataclass(frozen=True)
class EdgeMap:
    """The edges of one camera's pictures.

    Attributes:
        side: `right` or `left`.
        chart: sticks from the predicted contour towards the edge, dots where the picture shows none.
        enlarged: how many times longer than true the sticks are.
    """

    side: str
    chart: Chart
    enlarged: float


def edge_maps(run: CalibrationRun) -> tuple[EdgeMap, ...]:
    """A map a camera; nothing where no picture was looked at."""
    sizes = {view.side: view.source.size for view in run.views}
    return tuple(_map(found, sizes[found.side]) for found in run.picture_edges if np.isfinite(found.px).any())


def _map(found: ViewEdges, size: tuple[int, int]) -> EdgeMap:
    area = PictureArea(size, _WIDTH)
    px = found.px[np.isfinite(found.px)]
    spread = max(float(np.median(np.abs(px))) * 1.4826, 1e-9)
    enlarged = rounded_factor(_STICK * size[1] / spread)
    outward = (found.right_uv[:, None] * np.array([-1.0, 1.0])[:, None])[:, :, None]  # (m, 2, 1, 2)
    start = area.places(found.uv)
    limit = _MOST_SCALES * spread
    end = start + found.px.clip(-limit, limit)[..., None] * enlarged * area.scale * outward
    kinds = {"outside": found.px > 0.0, "inside": found.px <= 0.0, "none": found.looked & ~np.isfinite(found.px)}
    paths = []
    for name, which in kinds.items():
        if which.any():
            shown = _some(found.px, which)
            if name != "none":
                paths.append(Path(f"stick edge-{name}", strokes(start[shown], end[shown])))
            paths.append(Path(f"foot edge-{name}", dots(*start[shown].T)))
    words = f"Edges in the {found.side} pictures off the predicted contours, sticks {enlarged:g} times as long"
    return EdgeMap(found.side, area.chart(words, f"{found.side} pictures, × {enlarged:g}", paths), enlarged)


def _some(px: Float[np.ndarray, "m 2 s"], which: Bool[np.ndarray, "m 2 s"]) -> Bool[np.ndarray, "m 2 s"]:
    """Of the places in the mask, as many as a chart holds."""
    places = np.flatnonzero(which)
    shown = np.zeros(px.size, dtype=bool)
    shown[places[drawn_points(np.nan_to_num(px.ravel()[places]))]] = True
    return shown.reshape(px.shape)
