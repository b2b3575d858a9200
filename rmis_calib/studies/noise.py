"""Error against the noise coefficient: the paper's Fig. 2, with the bound and today's methods in the same plots."""

from collections.abc import Sequence
from pathlib import Path

from rmis_calib.studies.engine import Watcher
from rmis_calib.studies.lines import Shown, line_study, median_rows
from rmis_calib.studies.output import StudyResult
from rmis_calib.studies.page import Table
from rmis_calib.studies.plots import Figure, Panel, axis_label, method_curves
from rmis_calib.studies.prepare import Ready, prepare
from rmis_calib.studies.settings import NoiseStudySettings
from rmis_calib.studies.simulation import Condition
from rmis_calib.studies.summary import Group

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
    coefficients = sorted(set(settings.coefficients or (QUICK if settings.run.quick else FULL)))
    grid = (settings.positions_laparoscope, settings.positions_instrument)
    conditions = [Condition.on_grid(source.name, c, *grid) for source in ready.sources for c in coefficients]
    return line_study(
        Path(out), "noise", TITLE, [FIGURE], settings, conditions, ready.cameras,
        lambda groups: _describe(groups, ready, settings.run.n_trials), progress, command,
    )  # fmt: skip


def _describe(groups: Sequence[Group], ready: Ready, trials: int) -> Shown:
    present = sorted({group.keys["coefficient"] for group in groups})
    shown = sorted({min(present, key=lambda x: abs(x - c)) for c in SHOWN})
    tables = []
    for source in ready.sources:
        own = [group for group in groups if group.keys["noise"] == source.name]
        headings = ("cameras", "method", *(f"c = {c:g}" for c in shown))
        rows = median_rows(own, ready.methods, "coefficient", shown)
        tables.append(Table(f"{source.title}: median error, deg / mm", headings, tuple(rows)))
    return [_figure(groups, ready, trials)], tables, []


def _figure(groups: Sequence[Group], ready: Ready, trials: int) -> Figure:
    rows = []
    for measure in ("rotation", "translation"):
        for view in ready.cameras:
            row = []
            for source in ready.sources:
                part = [g for g in groups if g.keys["noise"] == source.name and g.keys["cameras"] == view]
                curves = method_curves(part, measure, "coefficient", ready.methods)
                title = f"{source.title}; {view}"
                row.append(Panel(title, "noise coefficient (mm and deg)", axis_label(measure), False, curves))
            rows.append(tuple(row))
    n = groups[0].keys["motions"]
    caption = (
        f"Medians and quartiles of {trials} trials of {n:,} motions. The bound is the median error of an unbiased "
        "estimate that attains the Cramér-Rao bound."
    )
    return Figure(FIGURE, TITLE, caption, tuple(rows))
