"""Figures as inline SVG that take their colours and their type from the page, in light and in dark.

Figures are built with matplotlib's object interface; pyplot, with its global state, is never imported.
"""

import io
import re
from html import escape

import matplotlib
from markupsafe import Markup
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.ticker import MaxNLocator

# matplotlib writes literal colours; these stand-ins become the page's CSS variables afterwards.
INK, QUIET, HAIRLINE, SURFACE, OTHER = "#010203", "#010204", "#010205", "#010206", "#010209"
DATA = {"right": "#010207", "left": "#010208", "other": OTHER}
GROUPS = tuple(f"#0103{number:02x}" for number in range(8))
"""Of groups of motions, by number; more begin again."""
_CSS_VARIABLES = {
    INK: "var(--ink)",
    QUIET: "var(--ink-2)",
    HAIRLINE: "var(--line)",
    SURFACE: "var(--paper)",
    DATA["right"]: "var(--data-right)",
    DATA["left"]: "var(--data-left)",
    OTHER: "var(--data-other)",
} | {colour: f"var(--group-{number})" for number, colour in enumerate(GROUPS)}


def whole_numbers() -> MaxNLocator:
    """Ticks at whole numbers."""
    return MaxNLocator(6, steps=[1, 2, 5, 10], integer=True)


def style(axes: Axes) -> None:
    """The page's look."""
    axes.set_facecolor("none")
    axes.set_axisbelow(True)
    axes.spines[["top", "right", "left"]].set_visible(False)
    axes.spines["bottom"].set(color=QUIET, linewidth=0.8)
    axes.tick_params(colors=QUIET, labelsize=9, length=0, pad=4)
    axes.xaxis.label.set(color=QUIET, size=9)
    axes.yaxis.label.set(color=QUIET, size=9)


def as_svg(figure: Figure, description: str) -> Markup:
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
