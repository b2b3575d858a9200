"""Calibration from the instrument against calibration with a board, through the same narrow motion: the paper's
Fig. 6."""

from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path

from rmis_calib.errors import InputError
from rmis_calib.studies.engine import Watcher, run_cells, study_folder
from rmis_calib.studies.experiment import BOARD, LINES, make_experiments, run_experiment
from rmis_calib.studies.output import StudyResult, output_names, write_record, write_study
from rmis_calib.studies.page import Table
from rmis_calib.studies.plots import Figure, Panel, Series, Style, axis_label, curve
from rmis_calib.studies.prepare import find_methods, prepare_pictures
from rmis_calib.studies.registry import find_noise_source
from rmis_calib.studies.reprojection import MEASURES, noise_in_words, triple, truth_px
from rmis_calib.studies.settings import ComparisonStudySettings
from rmis_calib.studies.summary import Group, summarise

TITLE = "Instrument against board"
BY_MOTIONS, BY_EXPERIMENT = "comparison_motions", "comparison_experiments"
FULL, QUICK = (12, 24, 48, 96, 192, 343), (12, 32)
FULL_BOARD, QUICK_BOARD = (4, 6, 8, 12, 16, 24, 32), (6, 12, 16)
PAPERS_BOARD_MOTIONS = 12


def study_comparison(
    out: str | Path,
    settings: ComparisonStudySettings | None = None,
    *,
    progress: Watcher = lambda _: None,
    command: str | None = None,
) -> StudyResult:
    """Head-point error and errors of the transform, of methods on lines of a rendered instrument and of methods on a
    rendered board, with the same cameras, ranges of motion and robot noise.

    Each experiment has a hand-eye transform of its own, and is rendered once; each trial takes some of its motions at
    random, and draws the noise: of both arms for the instrument, of the laparoscope's arm for the board.

    Args:
        out: folder; new, or of the same kind of study.
        settings: defaults when None.
        progress: called when a cell ends.
        command: how the study was started, for its outputs.

    Raises:
        InputError: settings that cannot be, an extension or a method that does not work.
        OutputError: a folder that may not be written.
    """
    settings, out = settings or ComparisonStudySettings(), Path(out)
    _, cameras = prepare_pictures(settings, ("stereo", "mono"))
    _check_board_methods(settings)
    quick = settings.run.quick
    counts = settings.motions or (QUICK if quick else FULL)
    board_counts = settings.board_motions or (QUICK_BOARD if quick else FULL_BOARD)
    experiments = settings.experiments or (1 if quick else 6)
    with study_folder(out, "comparison", output_names([BY_MOTIONS, BY_EXPERIMENT])) as store:
        about = write_record(out, "comparison", settings, command)
        cells = make_experiments(
            store, experiments, settings.methods, settings.board_methods, cameras[:1], counts, board_counts, settings
        )
        table = run_cells(cells, settings.run, progress, run_experiment)
        keys = ("target", "motions", "cameras", "method")
        groups, each = summarise(table, keys), summarise(table, ("experiment", *keys))
        at = {LINES: max(counts), BOARD: min(board_counts, key=lambda n: abs(n - PAPERS_BOARD_MOTIONS))}
        figures = (_by_motions(groups, settings, truth_px(table)), _by_experiment(each, settings, at, truth_px(table)))
        rows = tuple(group.row() for group in each)
        tables = _tables(groups, settings)
        write_study(result := StudyResult("comparison", table, rows, (), figures, tables, out), TITLE, about)
    return result


def _check_board_methods(settings: ComparisonStudySettings) -> None:
    from rmis_calib import baselines

    known = [name for name in baselines.METHODS if name != "rcm"]  # it needs the centre of motion in the board
    for name in settings.board_methods:
        if name not in known:
            raise InputError(where="--board-methods", expected=f"one of {', '.join(known)}", found=name)
        if name in settings.methods:
            raise InputError(where="--methods", expected="other names than those of --board-methods", found=name)
    source = None if settings.pictures.source is None else find_noise_source(settings.pictures.source)
    if source is not None and source.disturb is not None and source.disturb_board is None:
        expected = "disturb_board beside disturb: the same errors for the board"
        raise InputError(where=f"noise source {source.name}", expected=expected, found="none")


def _names(settings: ComparisonStudySettings) -> list[tuple[str, str, str]]:
    """(target, method, title) of every method, in the order of their styles."""
    lines = find_methods(settings.methods, settings.run.extensions)
    named = [(LINES, method.name, f"instrument: {method.title}") for method in lines]
    return named + [(BOARD, name, f"board: {name}") for name in dict.fromkeys(settings.board_methods)]


def _curves(groups: Sequence[Group], measure: str, key: str, settings: ComparisonStudySettings) -> tuple[Series, ...]:
    series = []
    for index, (target, name, title) in enumerate(_names(settings)):
        own = [group for group in groups if (group.keys["target"], group.keys["method"]) == (target, name)]
        series.append(curve(own, measure, key, title, Style(index)))
    return tuple(series)


def _by_motions(groups: Sequence[Group], settings: ComparisonStudySettings, floor_px: float) -> Figure:
    rows = []
    for measure in MEASURES:
        level = (floor_px, "the true transform") if measure == "reprojection" else None
        curves = _curves(groups, measure, "motions", settings)
        rows.append((Panel("", "motions", axis_label(measure), True, curves, level),))
    return Figure(BY_MOTIONS, f"{TITLE}, by number of motions", _caption(settings), tuple(rows))


def _by_experiment(
    groups: Sequence[Group], settings: ComparisonStudySettings, at: dict[str, int], floor_px: float
) -> Figure:
    chosen = [group for group in groups if group.keys["motions"] == at[group.keys["target"]]]
    curves = _curves(chosen, "reprojection", "experiment", settings)
    apart = tuple(_without_line(series) for series in curves)
    level = (floor_px, "the true transform")
    panel = Panel("", "experiment", axis_label("reprojection"), False, apart, level)
    caption = f"{at[LINES]} motions of the instrument, {at[BOARD]} of the board. {_caption(settings)}"
    return Figure(BY_EXPERIMENT, f"{TITLE}, by experiment", caption, ((panel,),))


def _without_line(series: Series) -> Series:
    return replace(series, style=replace(series.style, has_line=False))


def _caption(settings: ComparisonStudySettings) -> str:
    return (
        f"Rendered pictures; {noise_in_words(settings.pictures)}. Medians and quartiles of {settings.n_trials} trials "
        f"an experiment; reprojection: mean of {settings.pictures.validation} "
        "further poses, whose kinematics are as noisy, so that even the true transform has an error."
    )


def _tables(groups: Sequence[Group], settings: ComparisonStudySettings) -> tuple[Table, ...]:
    tables = []
    for target, title in ((LINES, "Instrument"), (BOARD, "Board")):
        own = [group for group in groups if group.keys["target"] == target]
        counts = sorted({group.keys["motions"] for group in own})
        rows = []
        for of_target, name, label in _names(settings):
            if of_target == target:
                of = {group.keys["motions"]: group for group in own if group.keys["method"] == name}
                rows.append((label.partition(": ")[2], *(triple(of[n]) for n in counts)))
        headings = ("method", *(f"{n:,}" for n in counts))
        tables.append(Table(f"{title}: median head-point error, px / deg / mm", headings, tuple(rows)))
    return tuple(tables)
