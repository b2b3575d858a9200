"""One page of a study, with everything inside it: plots that answer to the pointer, the table, how it was made."""

import json
from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

from markupsafe import Markup

from rmis_calib import __version__
from rmis_calib.io.atomic import atomic_write
from rmis_calib.io.outputs import check_file, is_report
from rmis_calib.io.plain_values import finite_or_none
from rmis_calib.report.page import template
from rmis_calib.studies.plots import BOUND_COLOUR, COLOURS, MARKERS, Figure


@dataclass(frozen=True)
class Table:
    """Numbers in print."""

    title: str
    headings: tuple[str, ...]
    rows: tuple[tuple[str, ...], ...]


def write_page(
    path: Path,
    title: str,
    sentences: Sequence[str],
    figures: Sequence[Figure],
    tables: Sequence[Table],
    about: Mapping[str, str],
) -> None:
    """Write the page, whole or not at all. It loads nothing, and works without a network.

    Args:
        path: HTML file.
        title: heading.
        sentences: what was found.
        figures: drawn by the page's script from the numbers in it.
        tables: below the figures.
        about: how it was made: command, seed, versions.

    Raises:
        OutputError: another file is there, or it cannot be written.
    """
    check_file(path, is_report, overwrite=True)
    page = template("study.html", "rmis_calib.studies").render(
        title=title,
        sentences=sentences,
        figures=figures,
        data=_script_safe({"figures": [asdict(figure) for figure in figures], "palette": _PALETTE}),
        tables=tables,
        about=about,
        version=__version__,
    )
    with atomic_write(path) as temporary:
        temporary.write_text(page, encoding="utf-8")


_PALETTE = {"colours": COLOURS, "markers": MARKERS, "bound": BOUND_COLOUR}


def _script_safe(value: Any) -> Markup:
    """JSON for a script element: nothing in it can end the element."""
    text = json.dumps(finite_or_none(value), allow_nan=False, separators=(",", ":"))
    return Markup(text.replace("<", "\\u003c").replace(">", "\\u003e").replace("&", "\\u0026"))
