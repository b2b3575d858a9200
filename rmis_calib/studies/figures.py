"""Figures for a paper: vector PDF and PNG, readable in print, in grey and by the colour-blind."""

from collections.abc import Mapping
from pathlib import Path
from typing import Any

import matplotlib
import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure as MplFigure
from matplotlib.ticker import FuncFormatter, LogLocator, NullFormatter

from rmis_calib.io.atomic import atomic_write
from rmis_calib.studies.plots import BOUND_COLOUR, COLOURS, MARKERS, Figure, Panel, Series

_WIDTH_IN = 7.2
"""Both columns of a journal's page."""
_PANEL_HEIGHT_IN = 1.9
_LEGEND_LINE_IN = 0.16
_APART = 0.09
"""Points without a line that share their x stand side by side: the distance from one method to the next."""
_ASIDE = 0.009
"""So do the ranges of curves, but nearer: this part of the axis from one to the next."""
_MOST_TICKS = 12
_FINE = 60.0
"""Axes that span less get numbers between the decades."""
_DASHES = ("-", (0, (5, 2)), (0, (1, 1.5)), (0, (5, 2, 1, 2)))
_RC: Any = {
    "font.family": "DejaVu Sans",
    "font.size": 7.5,
    "axes.linewidth": 0.7,
    "pdf.fonttype": 42,  # text stays text
    "axes.spines.top": False,
    "axes.spines.right": False,
}


def write_figure(folder: Path, figure: Figure, about: Mapping[str, str]) -> list[Path]:
    """Write `<name>.pdf` and `<name>.png` (300 dpi), each whole or not at all.

    Args:
        folder: exists.
        figure: what to draw.
        about: command, versions and seed, kept in the files' metadata.
    """
    with matplotlib.rc_context(_RC):
        drawn = _draw(figure)
        drawn.draw_without_rendering()
        drawn.set_layout_engine("none")  # once for both files: it takes longer than the drawing
        paths = [folder / f"{figure.name}.pdf", folder / f"{figure.name}.png"]
        text = "; ".join(f"{key}: {value}" for key, value in about.items())
        for path, metadata in zip(
            paths,
            ({"Title": figure.title, "Subject": text, "CreationDate": None}, {"Title": figure.title, "Comment": text}),
            strict=True,
        ):
            with atomic_write(path) as temporary:
                drawn.savefig(temporary, dpi=300, metadata=metadata)
    return paths


def _draw(figure: Figure) -> MplFigure:
    rows, columns = len(figure.rows), max(len(row) for row in figure.rows)
    width = _WIDTH_IN if columns > 1 else 0.55 * _WIDTH_IN
    names = {series.name for row in figure.rows for panel in row for series in panel.series if series.style.is_named}
    legend_columns = 3 if columns > 1 else 1
    height = _PANEL_HEIGHT_IN * rows + 0.45 + _LEGEND_LINE_IN * (1 + len(names) // legend_columns)
    drawn = MplFigure(figsize=(width, height), layout="constrained")
    panels = drawn.subplots(rows, columns, squeeze=False, sharey="row")
    for r, row in enumerate(figure.rows):
        for c in range(columns):
            axes = panels[r][c]
            if c >= len(row):
                axes.set_axis_off()
                continue
            _draw_panel(axes, row[c])
            if r == 0 or row[c].title != figure.rows[r - 1][c].title:
                axes.set_title(row[c].title, size=8, loc="left")
            if r == rows - 1:
                axes.set_xlabel(row[c].x_label)
            if c == 0:
                axes.set_ylabel(row[c].y_label)
    for axes in panels[:, 0]:
        least, most = axes.get_ylim()
        if most < _FINE * least:  # decades alone would leave an axis with a number or none
            axes.yaxis.set_major_locator(LogLocator(subs=(1.0, 2.0, 5.0)))
    handles: dict[str, Any] = {}
    for axes in panels.flat:
        for handle, label in zip(*axes.get_legend_handles_labels(), strict=True):
            handles.setdefault(label, handle)
    drawn.legend(list(handles.values()), list(handles), loc="outside lower center", ncols=legend_columns, frameon=False)
    return drawn


def _draw_panel(axes: Axes, panel: Panel) -> None:
    axes.set_yscale("log")
    if panel.x_is_log:
        axes.set_xscale("log")
    methods = sum(not series.style.is_bound for series in panel.series)
    for series in panel.series:
        if series.style.is_bound:
            _draw_bound(axes, series)
        else:
            _draw_method(axes, series, panel, series.style.index - 0.5 * (methods - 1))
    if panel.y_line is not None:
        axes.axhline(panel.y_line[0], color="#5b5b5b", linewidth=0.8, linestyle=(0, (1, 2)), label=panel.y_line[1])
    axes.grid(axis="y", color="#d9d9d9", linewidth=0.5)
    axes.set_axisbelow(True)
    plain = FuncFormatter(lambda value, _: f"{value:g}")
    axes.yaxis.set_major_formatter(plain)
    axes.yaxis.set_minor_formatter(NullFormatter())
    if panel.x_is_log:
        ticks = _ticks(sorted({x for series in panel.series for x in series.x}))
        axes.set_xticks(ticks, [f"{x:g}" for x in ticks])
        axes.xaxis.set_minor_formatter(NullFormatter())
        axes.minorticks_off()
    else:
        values = sorted({x for series in panel.series for x in series.x})
        if len(values) <= _MOST_TICKS and all(float(x).is_integer() for x in values):
            axes.set_xticks(values)


def _ticks(values: list[float]) -> list[float]:
    """Values far enough apart, on a log axis, for their numbers."""
    kept: list[float] = []
    span = np.log(values[-1] / values[0]) if len(values) > 1 else 1.0
    for value in reversed(values):
        if not kept or np.log(kept[-1] / value) > 0.17 * span:
            kept.append(value)
    return kept[::-1]


def _beside(x: np.ndarray, panel: Panel, series: Series, steps: float) -> np.ndarray:
    """Where points stand whose ranges would lie on each other's: so many steps aside."""
    if not series.style.has_line:
        return x + _APART * steps if series.style.is_named else x
    values = [value for own in panel.series for value in own.x]
    least, most = min(values), max(values)
    return x * (most / least) ** (_ASIDE * steps) if panel.x_is_log else x + _ASIDE * steps * (most - least)


def _draw_method(axes: Axes, series: Series, panel: Panel, steps: float) -> None:
    """A curve with its ranges, `steps` aside."""
    place = series.style.index % len(COLOURS)
    shown = np.isfinite(series.middle)
    x, middle, low, high = (np.asarray(v)[shown] for v in (series.x, series.middle, series.low, series.high))
    x = _beside(x, panel, series, steps)
    colour = COLOURS[place]
    bars = np.stack([middle - low, np.where(np.isfinite(high), high, middle) - middle])
    axes.errorbar(
        x, middle, yerr=bars, color=colour, marker=MARKERS[place], markersize=3.2,
        linewidth=1.0 if series.style.has_line else 0.0, elinewidth=0.7, capsize=1.5, capthick=0.7,
        label=series.name if series.style.is_named else None,

        markerfacecolor=colour if series.style.has_line else "white", markeredgewidth=0.7,
    )  # fmt: skip


def _draw_bound(axes: Axes, series: Series) -> None:
    dashes = _DASHES[series.style.index % len(_DASHES)]
    axes.plot(series.x, series.middle, color=BOUND_COLOUR, linewidth=1.1, linestyle=dashes, label=series.name, zorder=3)
