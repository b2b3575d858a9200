"""Error against the noise coefficient: the paper's Fig. 2, with the bound and today's methods in the same plots."""

from collections.abc import Sequence
from pathlib import Path

import numpy as np

from rmis_calib.studies.cells import make_cells
from rmis_calib.studies.engine import Watcher, run_cells, study_folder
from rmis_calib.studies.output import StudyResult, output_names, write_record, write_study
from rmis_calib.studies.page import Table
from rmis_calib.studies.plots import Figure, Panel, axis_label, method_curves
from rmis_calib.studies.prepare import prepare
from rmis_calib.studies.registry import Method, NoiseSource
from rmis_calib.studies.settings import NoiseStudySettings
from rmis_calib.studies.simulation import Condition
from rmis_calib.studies.summary import Group, summarise

TITLE = "Error against noise"
FIGURE = "noise"
QUICK = (0.0, 1.0, 2.0)
FULL = tuple(round(0.2 * i, 1) for i in range(11))
SHOWN = (0.2, 1.0, 2.0)
"""Coefficients of the table."""


def study_noise(
    out: str | Path,
    settings: NoiseStudySettings | None = None,
    *,
    progress: Watcher = lambda _: None,
    command: str | None = None,
) -> StudyResult:
    """Rotation and translation error against the noise coefficient, by method, noise source and number of cameras.

    A study that was interrupted goes on where it stopped, when it is started again in the same folder. With more than
    one worker, call this below `if __name__ == "__main__":` in a script.

    Args:
        out: folder; new, or of the same kind of study.
        settings: defaults when None.
        progress: called when a cell ends.
        command: how the study was started, for its outputs.

    Raises:
        InputError: settings that cannot be, an extension or a method that does not work.
        OutputError: a folder that may not be written.
    """
    settings = settings or NoiseStudySettings()
    ready = prepare(settings)
    coefficients = settings.coefficients or (QUICK if settings.run.quick else FULL)
    grid = (settings.positions_laparoscope, settings.positions_instrument)
    conditions = [Condition.on_grid(source, c, *grid) for source in settings.sources for c in sorted(set(coefficients))]
    out = Path(out)
    with study_folder(out, "noise", output_names([FIGURE])) as store:
        about = write_record(out, "noise", settings, command)
        cells = make_cells(
            store, conditions, settings.methods, ready.cameras, settings.setup, settings.run.extensions,
            settings.run.n_trials, settings.run.seed,
        )  # fmt: skip
        table = run_cells(cells, settings.run, progress)
        groups = summarise(table)
        result = StudyResult(
            "noise", table, tuple(group.row() for group in groups), (),
            (_figure(groups, ready.methods, ready.sources, settings.run.n_trials),),
            tuple(_tables(groups, ready.methods, ready.sources)), out,
        )  # fmt: skip
        write_study(result, TITLE, about)
    return result


def _figure(groups: Sequence[Group], methods: Sequence[Method], sources: Sequence[NoiseSource], trials: int) -> Figure:
    views = [view for view in ("mono", "stereo") if any(group.keys["cameras"] == view for group in groups)]
    rows = []
    for measure in ("rotation", "translation"):
        for view in views:
            row = []
            for source in sources:
                part = [g for g in groups if g.keys["noise"] == source.name and g.keys["cameras"] == view]
                curves = method_curves(part, measure, "coefficient", methods)
                title = f"{source.title}, {view}"
                row.append(Panel(title, "noise coefficient (mm and deg)", axis_label(measure), False, curves))
            rows.append(tuple(row))
    n = groups[0].keys["motions"]
    caption = (
        f"Medians and quartiles of {trials} trials of {n:,} motions. The bound is the median error of an unbiased "
        "estimate that attains the Cramér-Rao bound."
    )
    return Figure(FIGURE, TITLE, caption, tuple(rows))


def _tables(groups: Sequence[Group], methods: Sequence[Method], sources: Sequence[NoiseSource]) -> list[Table]:
    """Medians at a few coefficients, a table a noise source."""
    present = sorted({group.keys["coefficient"] for group in groups})
    shown = sorted({min(present, key=lambda x: abs(x - c)) for c in SHOWN})
    tables = []
    for source in sources:
        rows = []
        own = [g for g in groups if g.keys["noise"] == source.name]
        for view in ("mono", "stereo"):
            for method in methods:
                of = {
                    g.keys["coefficient"]: g
                    for g in own
                    if g.keys["cameras"] == view and g.keys["method"] == method.name
                }
                if of:
                    rows.append((view, method.title, *(_cell(of[c]) for c in shown)))
            seen = set()
            for method in methods:
                kinds = tuple(sorted(method.measurements))
                of = {
                    g.keys["coefficient"]: g
                    for g in own
                    if g.keys["cameras"] == view and g.keys["method"] == method.name
                }
                if of and kinds not in seen and np.isfinite(of[shown[0]].bound_median["rotation"]):
                    rows.append((view, f"bound, {' and '.join(kinds)}", *(_bound_cell(of[c]) for c in shown)))
                    seen.add(kinds)
        title = f"{source.title}: median error, deg / mm"
        tables.append(Table(title, ("cameras", "method", *(f"c = {c:g}" for c in shown)), tuple(rows)))
    return tables


def _cell(group: Group) -> str:
    return f"{group.quartiles['rotation'][1]:.3g} / {group.quartiles['translation'][1]:.3g}"


def _bound_cell(group: Group) -> str:
    return f"{group.bound_median['rotation']:.3g} / {group.bound_median['translation']:.3g}"
