"""Head-point reprojection error against the number of motions, from rendered pictures: the paper's Fig. 5."""

from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from rmis_calib.studies.engine import Watcher, run_cells, study_folder
from rmis_calib.studies.experiment import make_experiments, run_experiment
from rmis_calib.studies.output import StudyResult, output_names, write_record, write_study
from rmis_calib.studies.page import Table
from rmis_calib.studies.plots import Figure, Panel, axis_label, method_curves
from rmis_calib.studies.prepare import prepare_pictures
from rmis_calib.studies.registry import Method, find_noise_source
from rmis_calib.studies.settings import Cameras, PictureSettings, ReprojectionStudySettings
from rmis_calib.studies.summary import Group, summarise

if TYPE_CHECKING:
    import pyarrow

TITLE = "Reprojection error against the number of motions"
FIGURE = "reprojection"
QUICK = (8, 16, 32)
FULL = (8, 16, 32, 64, 128, 216, 343)
KEYS = ("target", "motions", "cameras", "method")
MEASURES = ("reprojection", "rotation", "translation")


def study_reprojection(
    out: str | Path,
    settings: ReprojectionStudySettings | None = None,
    *,
    progress: Watcher = lambda _: None,
    command: str | None = None,
) -> StudyResult:
    """Head-point error in the right camera's pixels, and errors of the transform, from rendered pictures through
    detection, association and estimation.

    A set-up is rendered once, with as many motions as the largest number; each trial takes some of them at random, and
    draws the noise of both arms. Trials of large numbers therefore share most of their pictures.

    Args:
        out: folder; new, or of the same kind of study.
        settings: defaults when None.
        progress: called when a cell ends.
        command: how the study was started, for its outputs.

    Raises:
        InputError: settings that cannot be, an extension or a method that does not work.
        OutputError: a folder that may not be written.
    """
    settings, out = settings or ReprojectionStudySettings(), Path(out)
    methods, cameras = prepare_pictures(settings, settings.cameras)
    counts = settings.motions or (QUICK if settings.run.quick else FULL)
    with study_folder(out, "reprojection", output_names([FIGURE])) as store:
        about = write_record(out, "reprojection", settings, command)
        cells = make_experiments(store, 1, settings.methods, (), cameras, counts, (), settings)
        table = run_cells(cells, settings.run, progress, run_experiment)
        groups = summarise(table, KEYS)
        result = StudyResult(
            "reprojection", table, tuple(group.row() for group in groups), (),
            (_figure(groups, methods, cameras, settings, truth_px(table)),), _tables(groups, methods, cameras), out,
        )  # fmt: skip
        write_study(result, TITLE, about)
    return result


def _figure(
    groups: Sequence[Group],
    methods: Sequence[Method],
    cameras: Sequence[Cameras],
    settings: ReprojectionStudySettings,
    floor_px: float,
) -> Figure:
    rows = []
    for measure in MEASURES:
        row = []
        for view in cameras:
            own = [group for group in groups if group.keys["cameras"] == view]
            curves = method_curves(own, measure, "motions", methods)
            level = (floor_px, "the true transform") if measure == "reprojection" else None
            row.append(Panel(view, "motions", axis_label(measure), True, curves, level))
        rows.append(tuple(row))
    caption = (
        f"Rendered pictures through the whole pipeline; {noise_in_words(settings.pictures)}. Medians and quartiles of "
        f"{settings.n_trials} trials; reprojection: mean of {settings.pictures.validation} "
        "further poses, whose kinematics are as noisy, so that even the true transform has an error."
    )
    return Figure(FIGURE, TITLE, caption, tuple(rows))


def _tables(groups: Sequence[Group], methods: Sequence[Method], cameras: Sequence[Cameras]) -> tuple[Table, ...]:
    counts = sorted({group.keys["motions"] for group in groups})
    rows = []
    for view in cameras:
        for method in methods:
            of = {g.keys["motions"]: g for g in groups if (g.keys["cameras"], g.keys["method"]) == (view, method.name)}
            rows.append((view, method.title, *(triple(of[n]) for n in counts)))
    headings = ("cameras", "method", *(f"{n:,}" for n in counts))
    return (Table("Median head-point error, px / deg / mm", headings, tuple(rows)),)


def noise_in_words(pictures: PictureSettings) -> str:
    """For captions."""
    if pictures.source is not None:
        return f"noise {find_noise_source(pictures.source).title}, coefficient {pictures.coefficient:g}"
    return f"{pictures.kinematics_noise_mm:g} mm and {pictures.kinematics_noise_deg:g} deg of noise in each arm"


def triple(group: Group) -> str:
    """Medians of a group, px / deg / mm."""
    return " / ".join(f"{group.quartiles[measure][1]:.3g}" for measure in MEASURES)


def truth_px(table: "pyarrow.Table") -> float:
    """Median reprojection error of the true transform: what the noise of the validation poses alone makes."""
    return float(np.median(table.column("reprojection_of_truth_px").to_numpy()))
