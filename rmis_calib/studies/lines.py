"""Studies on lines without pictures: conditions in, a folder out. What they show is up to each."""

from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from rmis_calib.studies.cells import make_cells
from rmis_calib.studies.engine import Watcher, run_cells, study_folder
from rmis_calib.studies.output import StudyResult, output_names, write_record, write_study
from rmis_calib.studies.page import Table
from rmis_calib.studies.plots import Figure
from rmis_calib.studies.registry import Method
from rmis_calib.studies.settings import Cameras
from rmis_calib.studies.simulation import Condition
from rmis_calib.studies.summary import Group, summarise

Shown = tuple[Sequence[Figure], Sequence[Table], Sequence[str]]
"""Figures, tables and sentences."""


def line_study(
    out: Path,
    kind: str,
    title: str,
    figure_names: Sequence[str],
    settings: Any,
    conditions: Sequence[Condition],
    cameras: Sequence[Cameras],
    describe: Callable[[Sequence[Group]], Shown],
    progress: Watcher,
    command: str | None,
) -> StudyResult:
    """Simulate and solve all conditions, and leave the folder.

    Args:
        out: folder; new, or of the same kind of study.
        kind: of study.
        title: of its page.
        figure_names: files that `describe` draws.
        settings: with `methods`, `setup` and `run`.
        conditions: of the trials.
        cameras: numbers of cameras to compare.
        describe: what the groups of trials show.
        progress: called when a cell ends.
        command: how the study was started.

    Raises:
        InputError: an extension or a method that does not work.
        OutputError: a folder that may not be written.
    """
    with study_folder(out, kind, output_names(figure_names)) as store:
        about = write_record(out, kind, settings, command)
        cells = make_cells(
            store, conditions, settings.methods, cameras, settings.setup, settings.run.extensions,
            settings.run.n_trials, settings.run.seed,
        )  # fmt: skip
        table = run_cells(cells, settings.run, progress)
        groups = summarise(table)
        figures, tables, sentences = describe(groups)
        rows = tuple(group.row() for group in groups)
        result = StudyResult(kind, table, rows, tuple(sentences), tuple(figures), tuple(tables), out)
        write_study(result, title, about)
    return result


def median_rows(
    groups: Sequence[Group], methods: Sequence[Method], key: str, shown: Sequence[Any]
) -> list[tuple[str, ...]]:
    """Rows of a table of medians, deg / mm, by number of cameras and method; and of their bounds.

    Args:
        groups: that differ in `key`, cameras and method alone.
        methods: in the order of the rows.
        key: along the columns.
        shown: its values; a dash where there is none.
    """
    rows: list[tuple[str, ...]] = []
    for view in ("mono", "stereo"):
        bounds: dict[tuple[str, ...], tuple[str, ...]] = {}
        for method in methods:
            of = {g.keys[key]: g for g in groups if g.keys["cameras"] == view and g.keys["method"] == method.name}
            if not of:
                continue
            errors = (_pair({name: q[1] for name, q in of[x].quartiles.items()}) if x in of else "-" for x in shown)
            rows.append((view, method.title, *errors))
            if any(np.isfinite(group.bound_median["rotation"]) for group in of.values()):
                kinds = tuple(sorted(method.measurements))
                bound = (_pair(of[x].bound_median) if x in of else "-" for x in shown)
                bounds.setdefault(kinds, (view, f"bound, {' and '.join(kinds)}", *bound))
        rows += bounds.values()
    return rows


def _pair(value: Any) -> str:
    return f"{value['rotation']:.3g} / {value['translation']:.3g}"
