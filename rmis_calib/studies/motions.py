"""Error against the number of motions: the paper's Fig. 3, for every split of the motions over the two arms."""

from collections.abc import Sequence
from pathlib import Path

from rmis_calib.studies.engine import Watcher
from rmis_calib.studies.lines import Shown, line_study, median_rows
from rmis_calib.studies.output import StudyResult
from rmis_calib.studies.page import Table
from rmis_calib.studies.plots import Figure, Panel, Series, Style, axis_label, curve, method_curves
from rmis_calib.studies.prepare import Ready, prepare
from rmis_calib.studies.settings import MotionsStudySettings
from rmis_calib.studies.simulation import Condition
from rmis_calib.studies.summary import Group

TITLE = "Error against the number of motions"
QUICK = (3, 4, 6, 8)
FULL = tuple(range(3, 13))
SPLITS = {
    "both arms move": lambda lap, tool: lap > 1 and tool > 1,
    "instrument alone": lambda lap, tool: lap == 1,
    "laparoscope alone": lambda lap, tool: tool == 1,
}
"""Which arms move, by positions a joint."""


def study_motions(
    out: str | Path,
    settings: MotionsStudySettings | None = None,
    *,
    progress: Watcher = lambda _: None,
    command: str | None = None,
) -> StudyResult:
    """Rotation and translation error against N = M_L^3 M_I^3, for every split of M_L M_I, by method and number of
    cameras.

    Args:
        out: folder; new, or of the same kind of study.
        settings: defaults when None.
        progress: called when a cell ends.
        command: how the study was started, for its outputs.

    Raises:
        InputError: settings that cannot be, an extension or a method that does not work.
        OutputError: a folder that may not be written.
    """
    settings = settings or MotionsStudySettings()
    ready = prepare(settings, [settings.source])
    products = sorted(set(settings.positions or (QUICK if settings.run.quick else FULL)))
    conditions = [
        Condition.on_grid(settings.source, settings.coefficient, lap, product // lap)
        for product in products
        for lap in range(1, product + 1)
        if product % lap == 0
    ]
    names = [f"motions_{view}" for view in ready.cameras]
    return line_study(
        Path(out), "motions", TITLE, names, settings, conditions, ready.cameras,
        lambda groups: _describe(groups, ready, settings), progress, command,
    )  # fmt: skip


def _describe(groups: Sequence[Group], ready: Ready, settings: MotionsStudySettings) -> Shown:
    tables = []
    for name in SPLITS:
        own = _balanced(_of_split(groups, name))
        counts = sorted({group.keys["motions"] for group in own})
        headings = ("cameras", "method", *(f"{n:,}" for n in counts))
        rows = median_rows(own, ready.methods, "motions", counts)
        if rows:
            tables.append(Table(f"{name[0].upper()}{name[1:]}: median error, deg / mm", headings, tuple(rows)))
    figures = [
        _figure([g for g in groups if g.keys["cameras"] == view], view, ready, settings) for view in ready.cameras
    ]
    return figures, tables, []


def _figure(groups: Sequence[Group], view: str, ready: Ready, settings: MotionsStudySettings) -> Figure:
    rows = []
    for measure in ("rotation", "translation"):
        row = []
        for name in SPLITS:
            own = _of_split(groups, name)
            if own:
                balanced = _balanced(own)
                curves = method_curves(balanced, measure, "motions", ready.methods)
                others = _others([group for group in own if group not in balanced], measure, ready)
                row.append(Panel(name, "motions", axis_label(measure), True, (*curves, *others)))
        rows.append(tuple(row))
    caption = (
        f"{ready.sources[0].title}, coefficient {settings.coefficient:g}, {view}: medians and quartiles of "
        f"{settings.run.n_trials} trials. Lines: the split whose arms have the most equal numbers of positions; "
        "hollow: the other splits. The bound is the median error of an unbiased estimate that attains the Cramér-Rao "
        "bound."
    )
    return Figure(f"motions_{view}", f"{TITLE}, {view}", caption, tuple(rows))


def _of_split(groups: Sequence[Group], name: str) -> list[Group]:
    is_such = SPLITS[name]
    return [g for g in groups if is_such(g.keys["laparoscope_positions"], g.keys["instrument_positions"])]


def _balanced(groups: Sequence[Group]) -> list[Group]:
    """Of each number of motions the split whose arms have the most equal numbers of positions; of two alike the one
    with more for the instrument."""

    def imbalance(group: Group) -> tuple[int, int]:
        lap, tool = group.keys["laparoscope_positions"], group.keys["instrument_positions"]
        return abs(lap - tool), lap

    best: dict[int, tuple[int, int]] = {}
    for group in groups:
        n = group.keys["motions"]
        best[n] = min(best.get(n, imbalance(group)), imbalance(group))
    return [group for group in groups if imbalance(group) == best[group.keys["motions"]]]


def _others(groups: Sequence[Group], measure: str, ready: Ready) -> list[Series]:
    """The splits beside the most equal one, as points without a line."""
    series = []
    for index, method in enumerate(ready.methods):
        own = [group for group in groups if group.keys["method"] == method.name]
        if own:
            name = f"{method.title}, other splits"
            series.append(curve(own, measure, "motions", name, Style(index, has_line=False, is_named=False)))
    return series
