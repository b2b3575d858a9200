"""Results of one set-up over its recordings, drawn axis by axis."""

import math

import numpy as np
from jaxtyping import Bool, Float
from markupsafe import Markup
from matplotlib.figure import Figure

from rmis_calib.report.charts.svg_figures import DATA, INK, QUIET, SURFACE, as_svg, style, whole_numbers


def plot_repeatability(
    deviation: Float[np.ndarray, "n 6"],
    sigma: Float[np.ndarray, "n 6"],
    kept: Bool[np.ndarray, " n"],
    changes: tuple[int, ...],
    name: str,
) -> Markup:
    """Results of one set-up about their pooled transform, axis by axis, each with its 1-sigma bar.

    Args:
        deviation: of each result: rotation vector in rad, translation in mm.
        sigma: of each result; the same units.
        kept: whether a result counts; the others are hollow.
        changes: numbers of the results before which the transform changes: upright lines.
        name: what is drawn, for readers who cannot see it.
    """
    figure = Figure(figsize=(8.6, 4.4), layout="constrained", facecolor="none")
    panels = figure.subplots(2, 3, sharex=True)
    place = np.arange(1, len(deviation) + 1)
    for axis, axes in enumerate(panels.flat):
        to_unit, unit = (180.0 / np.pi, "deg") if axis < 3 else (1.0, "mm")
        values, bars = deviation[:, axis] * to_unit, sigma[:, axis] * to_unit
        style(axes)
        axes.axhline(0.0, color=QUIET, linewidth=0.8)
        for change in changes:
            axes.axvline(change + 0.5, color=INK, linewidth=0.8, linestyle=(0, (4, 3)))
        for shown, face in ((kept, DATA["right"]), (~kept, SURFACE)):
            axes.errorbar(
                place[shown], values[shown], yerr=bars[shown], fmt="o", markersize=3.5, color=DATA["right"],
                markerfacecolor=face, elinewidth=0.9, capsize=0,
            )  # fmt: skip
        scatter = float(np.sqrt(np.mean(values[kept] ** 2))) if kept.any() else math.nan
        predicted = float(np.sqrt(np.mean(bars[kept] ** 2))) if kept.any() else math.nan
        what = ("about x", "about y", "about z", "along x", "along y", "along z")[axis]
        title = f"{what}\nscatter {scatter:.2g}, predicted {predicted:.2g} {unit}"
        axes.set_title(title, size=9, color=INK, loc="left")
        axes.set(xlim=(0.4, len(deviation) + 0.6))
        axes.xaxis.set_major_locator(whole_numbers())
        if axis >= 3:
            axes.set_xlabel("recording")
        if axis % 3 == 0:
            axes.set_ylabel(unit)
    return as_svg(figure, name)
