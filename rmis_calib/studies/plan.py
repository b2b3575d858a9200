"""How many motions a wanted accuracy takes, answered before a recording is made."""

from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from rmis_calib.studies.cells import make_cells
from rmis_calib.studies.engine import Watcher, run_cells, study_folder
from rmis_calib.studies.output import StudyResult, output_names, write_record, write_study
from rmis_calib.studies.page import Table
from rmis_calib.studies.plots import Figure, Panel, Series, Style, axis_label, method_curves
from rmis_calib.studies.prepare import Ready, prepare
from rmis_calib.studies.settings import PlanSettings
from rmis_calib.studies.simulation import Condition
from rmis_calib.studies.summary import Group, summarise

if TYPE_CHECKING:
    import pyarrow

TITLE = "Motions for a wanted accuracy"
FIGURE = "plan"
_LEVELS = ("kinematics_noise_mm", "kinematics_noise_deg", "stereo_noise_mm", "stereo_noise_deg")
_BETWEEN = 3
"""Numbers of motions that are tried between the last that does not suffice and the first that does."""


def study_plan(
    out: str | Path,
    settings: PlanSettings | None = None,
    *,
    progress: Watcher = lambda _: None,
    command: str | None = None,
) -> StudyResult:
    """The least number of random motions with which a wanted share of recordings is as accurate as wanted.

    It counts independent noise alone. Errors that motions share (encoder offsets, lens, a bent shaft) do not average
    out, and are not in it.

    Args:
        out: folder; new, or of the same kind of study.
        settings: defaults when None.
        progress: called when a cell ends.
        command: how the study was started, for its outputs.

    Returns:
        the study; `reached` tells whether any number of motions up to the largest suffices, the first sentence which.

    Raises:
        InputError: settings that cannot be, an extension or a method that does not work.
        OutputError: a folder that may not be written.
    """
    settings, out = settings or PlanSettings(), Path(out)
    ready = prepare(settings, [] if settings.source is None else [settings.source])
    with study_folder(out, "plan", output_names([FIGURE])) as store:
        about = write_record(out, "plan", settings, command)

        def run(counts: Sequence[int]) -> "pyarrow.Table":
            cells = make_cells(
                store, [_condition(settings, n) for n in counts], settings.methods, ready.cameras, settings.setup,
                settings.run.extensions, settings.n_trials, settings.run.seed,
            )  # fmt: skip
            return run_cells(cells, settings.run, progress)

        counts = _ladder(settings.most_motions)
        table = run(counts)
        enough = _least_enough(table, ready, settings)
        between = _between(counts, enough)
        if between:
            counts = sorted({*counts, *between})
            table = run(counts)  # what is stored is not done again
            enough = _least_enough(table, ready, settings)
        groups = summarise(table)
        result = StudyResult(
            "plan", table, tuple(group.row() for group in groups), tuple(_sentences(table, enough, ready, settings)),
            (_figure(table, groups, ready, settings),), (_table(table, groups, ready, settings),), out,
            reached=enough is not None,
        )  # fmt: skip
        write_study(result, TITLE, about)
    return result


def _condition(settings: PlanSettings, motions: int) -> Condition:
    levels = tuple((name, float(getattr(settings, name))) for name in _LEVELS)
    moving = 2 if settings.laparoscope == "moves" else 1
    coefficient = 0.0 if settings.source is None else settings.coefficient
    return Condition(settings.source or "", coefficient, moving, 0, motions, motion="random", levels=levels)


def _ladder(most: int) -> list[int]:
    """4, 6, 8, 12, 16, ... up to the largest."""
    steps = [n for k in range(2, 30) for n in (2**k, 3 * 2 ** (k - 1)) if n < most]
    return [*steps, most]


def _between(counts: Sequence[int], enough: int | None) -> list[int]:
    """Numbers of motions between the one that suffices and the one before."""
    if enough is None or enough == counts[0]:
        return []
    before = counts[counts.index(enough) - 1]
    return sorted({round(n) for n in np.linspace(before, enough, _BETWEEN + 2)} - {before, enough})


def _reached(table: "pyarrow.Table", motions: int, ready: Ready, settings: PlanSettings) -> tuple[float, float]:
    """Error at the working point and of the rotation that the wanted share of recordings does not exceed, mm and deg;
    of the first method and number of cameras."""
    columns = {name: table.column(name).to_numpy() for name in ("motions", "method", "cameras")}
    own = (columns["motions"] == motions) & (columns["method"] == ready.methods[0].name)
    own &= columns["cameras"] == ready.cameras[0]
    mm, deg = (table.column(name).to_numpy()[own] for name in ("working_point_error_mm", "rotation_error_deg"))
    quantile = [float(np.quantile(error, settings.confidence, method="higher")) for error in (mm, deg)]
    return quantile[0], quantile[1]


def _least_enough(table: "pyarrow.Table", ready: Ready, settings: PlanSettings) -> int | None:
    """The least number of motions that suffices, as do all larger ones that were tried."""
    enough = None
    for motions in sorted(set(table.column("motions").to_pylist()), reverse=True):
        mm, deg = _reached(table, motions, ready, settings)
        if mm > settings.wanted_mm or (settings.wanted_deg is not None and deg > settings.wanted_deg):
            break
        enough = motions
    return enough


def _sentences(table: "pyarrow.Table", enough: int | None, ready: Ready, settings: PlanSettings) -> list[str]:
    wanted = f"{settings.wanted_mm:g} mm at the working point"
    wanted += "" if settings.wanted_deg is None else f" and {settings.wanted_deg:g} deg"
    at = enough or settings.most_motions
    mm, deg = _reached(table, at, ready, settings)
    share = f"{100 * settings.confidence:g} % of {settings.n_trials} simulated recordings ({ready.cameras[0]})"
    found = f"in {share} the error is below {mm:.2g} mm and {deg:.2g} deg"
    answer = f"{at} motions are {'not enough' if enough is None else 'enough'} for {wanted}: {found}."
    if enough is None and np.isfinite(mm):
        excess = max(mm / settings.wanted_mm, deg / (settings.wanted_deg or np.inf))
        answer += (
            f" Errors fall with the square root of the number: expect to need about {_two_digits(at * excess**2):,}."
        )
    return [
        answer,
        f"Assumed noise, 1 sigma per axis: {_noise_in_words(ready, settings)}.",
        "Errors that all motions share (encoder offsets, lens, a bent shaft) are not simulated and do not average out: "
        "take this number as the minimum.",
    ]


def _two_digits(number: float) -> int:
    """A whole number with two digits that count."""
    return int(round(number, 1 - int(np.log10(number))))


def _noise_in_words(ready: Ready, settings: PlanSettings) -> str:
    points = f"image points {settings.setup.pixel_noise_px:g} px"
    if ready.sources:
        return f"{points}; {ready.sources[0].title}, coefficient {settings.coefficient:g}"
    kinematics = f"kinematics {settings.kinematics_noise_mm:g} mm, {settings.kinematics_noise_deg:g} deg"
    stereo = f"stereo extrinsics {settings.stereo_noise_mm:g} mm, {settings.stereo_noise_deg:g} deg"
    return f"{kinematics}; {points}; {stereo}"


def _figure(table: "pyarrow.Table", groups: Sequence[Group], ready: Ready, settings: PlanSettings) -> Figure:
    wanted: dict[str, tuple[float, str] | None] = {
        "working_point": (settings.wanted_mm, f"wanted, {settings.wanted_mm:g} mm"),
        "rotation": None
        if settings.wanted_deg is None
        else (settings.wanted_deg, f"wanted, {settings.wanted_deg:g} deg"),
    }
    rows = []
    for view in ready.cameras:
        own = [group for group in groups if group.keys["cameras"] == view]
        for measure, level in wanted.items():
            curves = method_curves(own, measure, "motions", ready.methods)
            if view == ready.cameras[0]:
                curves += (_share_curve(table, measure, ready, settings),)
            rows.append((Panel(view, "motions", axis_label(measure), True, curves, level),))
    caption = (
        f"Medians and quartiles of {settings.n_trials} trials of random motions, laparoscope "
        f"{'moving' if settings.laparoscope == 'moves' else 'still'}. Dash-dotted: what decides, the error below which "
        f"{100 * settings.confidence:g} % of them are ({ready.methods[0].title}). The bound is the median error of an "
        "unbiased estimate that attains the Cramér-Rao bound."
    )
    return Figure(FIGURE, TITLE, caption, tuple(rows))


def _share_curve(table: "pyarrow.Table", measure: str, ready: Ready, settings: PlanSettings) -> Series:
    """The error that the wanted share of recordings does not exceed."""
    counts = sorted(set(table.column("motions").to_pylist()))
    reached = [_reached(table, motions, ready, settings) for motions in counts]
    errors = tuple(mm if measure == "working_point" else deg for mm, deg in reached)
    name = f"{100 * settings.confidence:g} % of recordings are below"
    notes = tuple(f"{motions} motions" for motions in counts)
    return Series(name, Style(3, is_bound=True), tuple(map(float, counts)), errors, errors, errors, notes)


def _table(table: "pyarrow.Table", groups: Sequence[Group], ready: Ready, settings: PlanSettings) -> Table:
    first = [g for g in groups if g.keys["method"] == ready.methods[0].name and g.keys["cameras"] == ready.cameras[0]]
    rows = []
    for group in sorted(first, key=lambda group: group.keys["motions"]):
        n = group.keys["motions"]
        mm, deg = _reached(table, n, ready, settings)
        medians = (group.quartiles["working_point"][1], mm, group.bound_median["working_point"], deg)
        rows.append((f"{n:,}", *(f"{value:.3g}" for value in medians)))
    share = f"{100 * settings.confidence:g} %"
    headings = (
        "motions",
        "working point, mm, median",
        f"{share} below",
        "bound, median",
        f"rotation, deg, {share} below",
    )
    return Table(f"{ready.methods[0].title}, {ready.cameras[0]}", headings, tuple(rows))
