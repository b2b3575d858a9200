"""Residual plots as inline SVG that takes its colours and its type from the page, in light and in dark.

Figures are built with matplotlib's object interface; pyplot, with its global state, is never imported.
"""

import io
import math
import re
from dataclasses import dataclass
from html import escape

import matplotlib
import numpy as np
from jaxtyping import Bool, Float
from markupsafe import Markup
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.ticker import MaxNLocator

# matplotlib writes literal colours; these stand-ins become the page's CSS variables afterwards.
_INK, _QUIET, _HAIRLINE, _SURFACE = "#010203", "#010204", "#010205", "#010206"
_DATA = {"right": "#010207", "left": "#010208", "other": "#010209"}
_CSS_VARIABLES = {
    _INK: "var(--ink)",
    _QUIET: "var(--ink-2)",
    _HAIRLINE: "var(--line)",
    _SURFACE: "var(--paper)",
    _DATA["right"]: "var(--data-right)",
    _DATA["left"]: "var(--data-left)",
    _DATA["other"]: "var(--data-other)",
}
# Points as vectors up to here; beyond, as consecutive groups (median and 95 % of each), so that a page of a million
# motions stays a page.
_MAX_POINTS = 1500
_GROUPS = 300
# Residuals beyond this many robust scales are counted at the edge of the plot instead of flattening the rest.
_SCALES_SHOWN = 6.0
_NORMAL_MAD = 1.4826  # standard deviation of a normal distribution over its median absolute value


@dataclass(frozen=True)
class ResidualPlots:
    """Two SVG drawings of one kind of residual, with the scale they use.

    Attributes:
        by_motion: residual against motion index.
        histogram: how often each size occurs.
        robust_scale: 1.4826 x median absolute residual, in the residual's unit.
        beyond: how many values lie outside the plotted range.
        motions_per_group: 1 where each motion has its point; otherwise how many share one, at most.
    """

    by_motion: Markup
    histogram: Markup
    robust_scale: float
    beyond: int
    motions_per_group: int


def plot_residuals(
    values: Float[np.ndarray, " n"], used: Bool[np.ndarray, " n"], unit: str, colour: str, name: str
) -> ResidualPlots:
    """Draw one kind of residual. Scale and histogram are of the used motions, where there are any.

    Args:
        values: one a motion, NaN where not measured; at least one is finite.
        used: whether the motion entered the estimate.
        unit: unit of the values.
        colour: `right`, `left` or `other`.
        name: what is drawn, for readers who cannot see it.
    """
    present = _counted(values, used)
    scale = _NORMAL_MAD * float(np.median(np.abs(present)))
    largest = float(np.abs(present).max())
    limit = min(largest * 1.05, _SCALES_SHOWN * scale) if scale > 0.0 else largest * 1.05
    limit = limit if limit > 0.0 else 1.0
    low = -limit if (present < 0.0).any() else 0.0
    return ResidualPlots(
        by_motion=_by_motion(values, used, (low, limit), unit, _DATA[colour], name),
        histogram=_histogram(present, scale, (low, limit), unit, _DATA[colour], name),
        robust_scale=scale,
        beyond=int((np.abs(values) > limit).sum()),  # NaN compares as false
        motions_per_group=1 if len(values) <= _MAX_POINTS else math.ceil(len(values) / _GROUPS),
    )


def _counted(values: np.ndarray, used: np.ndarray) -> np.ndarray:
    """Finite values of the used motions, or of all motions where no used one has any."""
    present = values[np.isfinite(values) & used]
    return present if present.size else values[np.isfinite(values)]


def _by_motion(
    values: np.ndarray, used: np.ndarray, limits: tuple[float, float], unit: str, colour: str, name: str
) -> Markup:
    figure, axes = _figure((5.4, 2.1))
    if len(values) > _MAX_POINTS:
        _draw_groups(axes, np.where(used, values, np.nan), limits, colour)
    else:
        _draw_points(axes, values, used, limits, colour)
    axes.axhline(float(np.median(_counted(values, used))), color=_INK, linewidth=0.8, linestyle=(0, (4, 3)))
    axes.set(xlim=(-0.5 - 0.01 * len(values), len(values) * 1.01 - 0.5), ylim=_padded(limits))
    axes.set(xlabel="motion", ylabel=f"residual, {unit}")
    axes.xaxis.set_major_locator(_whole_numbers())
    axes.grid(axis="y", color=_HAIRLINE, linewidth=0.6)
    return _svg(figure, f"{name} by motion")


def _draw_points(axes: Axes, values: np.ndarray, used: np.ndarray, limits: tuple[float, float], colour: str) -> None:
    motion = np.arange(len(values))
    inside = np.abs(values) <= limits[1]
    solid, hollow = inside & used, inside & ~used
    axes.scatter(motion[solid], values[solid], s=13, color=colour, linewidths=0, zorder=3)
    axes.scatter(motion[hollow], values[hollow], s=13, facecolors=_SURFACE, edgecolors=_QUIET, linewidths=0.8, zorder=3)
    for sign, marker in ((1.0, "^"), (-1.0, "v")):
        beyond = sign * values > limits[1]
        edge = np.full(int(beyond.sum()), sign * limits[1])
        axes.scatter(motion[beyond], edge, s=26, marker=marker, color=_INK, linewidths=0, zorder=4, clip_on=False)


def _draw_groups(axes: Axes, values: np.ndarray, limits: tuple[float, float], colour: str) -> None:
    groups = [group[np.isfinite(group)] for group in np.array_split(values, _GROUPS)]
    centre = np.array([group.mean() for group in np.array_split(np.arange(len(values)), _GROUPS)])
    filled = np.array([group.size > 0 for group in groups])
    bands = np.array([np.percentile(group, (5, 50, 95)) for group in groups if group.size]).clip(*limits).reshape(-1, 3)
    axes.fill_between(centre[filled], bands[:, 0], bands[:, 2], color=colour, alpha=0.25, linewidth=0, zorder=2)
    axes.plot(centre[filled], bands[:, 1], color=colour, linewidth=1.0, zorder=3)


def _histogram(
    present: np.ndarray, scale: float, limits: tuple[float, float], unit: str, colour: str, name: str
) -> Markup:
    figure, axes = _figure((3.4, 2.1))
    bins = int(np.clip(2 * np.sqrt(present.size), 8, 40))
    axes.hist(present, bins=bins, range=limits, color=colour, edgecolor=_SURFACE, linewidth=0.6, zorder=3)
    for mark in (scale,) if limits[0] == 0.0 else (-scale, scale):
        axes.axvline(mark, color=_INK, linewidth=0.8, linestyle=(0, (1, 2)), zorder=4)
    axes.set(xlim=limits, xlabel=f"residual, {unit}", ylabel="motions")
    axes.yaxis.set_major_locator(_whole_numbers())
    axes.grid(axis="y", color=_HAIRLINE, linewidth=0.6)
    return _svg(figure, f"{name}, histogram")


def _whole_numbers() -> MaxNLocator:
    return MaxNLocator(6, steps=[1, 2, 5, 10], integer=True)


def _padded(limits: tuple[float, float]) -> tuple[float, float]:
    return limits[0] if limits[0] == 0.0 else limits[0] * 1.06, limits[1] * 1.06


def _figure(size_inches: tuple[float, float]) -> tuple[Figure, Axes]:
    figure = Figure(figsize=size_inches, layout="constrained", facecolor="none")
    axes = figure.add_subplot()
    _style(axes)
    return figure, axes


def _style(axes: Axes) -> None:
    axes.set_facecolor("none")
    axes.set_axisbelow(True)
    axes.spines[["top", "right", "left"]].set_visible(False)
    axes.spines["bottom"].set(color=_QUIET, linewidth=0.8)
    axes.tick_params(colors=_QUIET, labelsize=9, length=0, pad=4)
    axes.xaxis.label.set(color=_QUIET, size=9)
    axes.yaxis.label.set(color=_QUIET, size=9)


def _svg(figure: Figure, description: str) -> Markup:
    """The figure as an `<svg>` element without header, outside names or fixed size; ids unique to `description`."""
    buffer = io.StringIO()
    no_metadata = dict.fromkeys(("Creator", "Date", "Format", "Type"))
    with matplotlib.rc_context({"svg.fonttype": "none", "svg.hashsalt": description}):
        figure.savefig(buffer, format="svg", transparent=True, metadata=no_metadata)
    text = buffer.getvalue()
    text = text[text.index("<svg") :]
    prefix = re.sub(r"\W+", "-", description)
    text = re.sub(r'\s(?:xmlns(?::\w+)?|version)="[^"]*"', "", text)
    text = re.sub(r'\bid="', f'id="{prefix}-', text)
    text = re.sub(r'(url\(#|href="#)', rf"\1{prefix}-", text)
    text = text.replace("xlink:href", "href")
    text = re.sub(
        r"<defs>\s*<style.*?</defs>", "", text, count=1, flags=re.DOTALL
    )  # its rule `*` would reach the whole page
    text = re.sub(
        r"(font-family: |font: [^;\"]*?px )[^;\"]*", r"\1var(--sans)", text
    )  # longhand, and older matplotlib's shorthand
    for stand_in, variable in _CSS_VARIABLES.items():
        text = text.replace(stand_in, variable)
    label = escape(description, quote=True)
    head = re.sub(r'\s(?:width|height)="[^"]*"', "", text[: text.index(">")])
    return Markup(f'{head} role="img" aria-label="{label}"{text[text.index(">") :]}')


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
        _style(axes)
        axes.axhline(0.0, color=_QUIET, linewidth=0.8)
        for change in changes:
            axes.axvline(change + 0.5, color=_INK, linewidth=0.8, linestyle=(0, (4, 3)))
        for shown, face in ((kept, _DATA["right"]), (~kept, _SURFACE)):
            axes.errorbar(
                place[shown], values[shown], yerr=bars[shown], fmt="o", markersize=3.5, color=_DATA["right"],
                markerfacecolor=face, elinewidth=0.9, capsize=0,
            )  # fmt: skip
        scatter = float(np.sqrt(np.mean(values[kept] ** 2))) if kept.any() else math.nan
        predicted = float(np.sqrt(np.mean(bars[kept] ** 2))) if kept.any() else math.nan
        what = ("about x", "about y", "about z", "along x", "along y", "along z")[axis]
        title = f"{what}\nscatter {scatter:.2g}, predicted {predicted:.2g} {unit}"
        axes.set_title(title, size=9, color=_INK, loc="left")
        axes.set(xlim=(0.4, len(deviation) + 0.6))
        axes.xaxis.set_major_locator(_whole_numbers())
        if axis >= 3:
            axes.set_xlabel("recording")
        if axis % 3 == 0:
            axes.set_ylabel(unit)
    return _svg(figure, name)
