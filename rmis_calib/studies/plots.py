"""What a figure of a study shows, once for print (figures.py) and once for the page (page.py)."""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from rmis_calib.studies.summary import MEASURES, Group

# Okabe and Ito's palette, told apart by the colour-blind, and by markers in black and white.
COLOURS = ("#d55e00", "#0072b2", "#009e73", "#cc79a7", "#e69f00", "#56b4e9", "#5b5b5b")
MARKERS = ("s", "o", "^", "D", "v", "P", "X")
BOUND_COLOUR = "#000000"


@dataclass(frozen=True)
class Style:
    """How a series looks: the place of its colour and marker in the palettes; of a bound, of its dashes. Points without
    a line are hollow, and explained by the caption unless they are named."""

    index: int
    is_bound: bool = False
    has_line: bool = True
    is_named: bool = True


@dataclass(frozen=True)
class Series:
    """One curve: middle and range of the errors at each x; a bound has no range.

    Attributes:
        name: in the legend.
        style: how it looks.
        x: increasing.
        middle, low, high: median and quartiles.
        notes: a line a point, for whoever points at it.
    """

    name: str
    style: Style
    x: tuple[float, ...]
    middle: tuple[float, ...]
    low: tuple[float, ...]
    high: tuple[float, ...]
    notes: tuple[str, ...]


@dataclass(frozen=True)
class Panel:
    """One pair of axes."""

    title: str
    x_label: str
    y_label: str
    x_is_log: bool
    series: tuple[Series, ...]
    y_line: tuple[float, str] | None = None
    """A level to reach, and its name."""


@dataclass(frozen=True)
class Figure:
    """Panels in rows, which share their y axis.

    Attributes:
        name: of its files.
        title: of the figure.
        caption: what it shows.
        rows: of panels.
    """

    name: str
    title: str
    caption: str
    rows: tuple[tuple[Panel, ...], ...]


def curve(groups: Sequence[Group], measure: str, x_key: str, name: str, style: Style, bound: bool = False) -> Series:
    """A series of groups along one of their keys: errors, or the bound."""
    ordered = sorted(groups, key=lambda group: group.keys[x_key])
    if bound:
        middle = tuple(group.bound_median[measure] for group in ordered)
        low, high = middle, middle
    else:
        low, middle, high, _ = zip(*(group.quartiles[measure] for group in ordered), strict=True)
    notes = tuple(_note(group, measure, bound) for group in ordered)
    return Series(name, style, tuple(float(group.keys[x_key]) for group in ordered), middle, low, high, notes)


def axis_label(measure: str) -> str:
    """A measure with its unit, for an axis."""
    return f"{measure.replace('_', '-')} error, {MEASURES[measure]}"


def method_curves(groups: Sequence[Group], measure: str, x_key: str, methods: Sequence[Any]) -> tuple[Series, ...]:
    """Curves of methods, and the bound of each set of measurements that they use.

    Args:
        groups: of one panel.
        measure: which error.
        x_key: along which.
        methods: `registry.Method`, in the order of their styles.
    """
    series: list[Series] = []
    of_method = {method.name: [g for g in groups if g.keys["method"] == method.name] for method in methods}
    for index, method in enumerate(methods):
        if of_method[method.name]:
            series.append(curve(of_method[method.name], measure, x_key, method.title, Style(index)))
    seen: list[tuple[str, ...]] = []
    for method in methods:
        kinds = tuple(sorted(method.measurements))
        known = [g for g in of_method[method.name] if np.isfinite(g.bound_median[measure])]
        if kinds in seen or not known:
            continue
        words = "axis lines" if kinds == ("axis",) else " and ".join(kinds)
        series.append(curve(known, measure, x_key, f"bound, {words}", Style(len(seen), is_bound=True), bound=True))
        seen.append(kinds)
    return tuple(series)


def _note(group: Group, measure: str, bound: bool) -> str:
    keys = group.keys
    grid = f"{keys['motions']} motions"
    if keys.get("instrument_positions"):  # 0: random motions
        grid += f", M_L {keys['laparoscope_positions']}, M_I {keys['instrument_positions']}"
    unit = MEASURES[measure]
    if bound:
        return f"{grid}: rms {group.bound_rms[measure]:.3g} {unit}"
    text = f"{grid}: rms {group.rms[measure]:.3g} {unit}"
    if np.isfinite(group.quartiles[measure][3]):
        text += f", 90 % below {group.quartiles[measure][3]:.3g} {unit}"
    return text + (f", {group.unanswered} of {group.count} without a usable answer" if group.unanswered else "")
