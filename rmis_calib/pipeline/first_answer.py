"""The first answer: which candidates are the shaft, and where they put it; what every calibration sets out from, a live
session and a check among them. Joint offsets and all checks come later (`calibration`).
"""

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
import torch

from rmis_calib.config import CalibrationConfig
from rmis_calib.errors import InsufficientDataError
from rmis_calib.geometry.rigid import RigidTransform
from rmis_calib.io import Recording, ShaftObservations
from rmis_calib.pipeline.answer.estimation import estimate
from rmis_calib.pipeline.answer.guided_look import about_looks, expected_contours, look_along
from rmis_calib.pipeline.answer.motion_names import MotionNames
from rmis_calib.pipeline.answer.offsets import estimate_with_kinematics
from rmis_calib.pipeline.answer.records.ends import with_unmeasured
from rmis_calib.pipeline.answer.records.residuals import residual_of, residuals_px
from rmis_calib.pipeline.answer.result import insufficient_data, make_result, motions_of
from rmis_calib.pipeline.answer.run import CalibrationRun
from rmis_calib.pipeline.arms.found_offsets import with_rcm_offset, with_setup
from rmis_calib.pipeline.arms.kinematic_unknowns import recording_unknowns
from rmis_calib.pipeline.arms.offset_unknowns import estimated_offsets
from rmis_calib.pipeline.arms.poses import MotionPoses, frame_of
from rmis_calib.pipeline.evaluation import head_point_errors, summarise_head_points
from rmis_calib.pipeline.motions.association import Choice, associate, association_gate, consistent_choice
from rmis_calib.pipeline.motions.consensus import with_consensus
from rmis_calib.pipeline.motions.observations import assemble
from rmis_calib.pipeline.pictures.background import about_background, without_background
from rmis_calib.pipeline.pictures.detection import Progress, View, no_progress
from rmis_calib.pipeline.pictures.frozen import about_repeats, repeated_motions, without_frames

LOOKS = 2
"""Looks at the pictures along the prediction at most."""
CHOICE_ROUNDS = 3
"""Solves at most: a choice of candidates that has not settled by then alternates between equals."""


@dataclass(frozen=True, eq=False)
class FirstAnswer:
    """What every calibration sets out from.

    Attributes:
        run: with the views as they are after all looks.
        searched: the views before them.
        surest: the choice in each of these that was tried first.
        about_views: notes on what the pictures showed that is left out.
        about_looks: notes on what was found by looking again.
    """

    run: CalibrationRun
    searched: tuple[View, ...]
    surest: tuple[Choice, ...]
    about_views: tuple[str, ...]
    about_looks: tuple[str, ...]


def first_answer(
    recording: Recording,
    config: CalibrationConfig,
    poses: MotionPoses,
    views: tuple[View, ...],
    prior: RigidTransform | None = None,
    progress: Progress = no_progress,
    with_pictures: bool = False,
) -> FirstAnswer:
    """Choose candidates, solve, look again where the answer puts the shaft, choose again.

    Every call starts from the views as they are given: what a look along an earlier answer found is no evidence for the
    next one.

    Args:
        recording: cameras, arms and joints.
        config: the configuration.
        poses: kinematics of the motions.
        views: detections of every frame, one entry a camera.
        prior: from `read_prior`.
        progress: called with (stage, done, total).
        with_pictures: the views' pictures can be read, to look at them again.
    """
    views, about_views = without_false_candidates(views, poses)
    attempts, several = associate(recording, config, poses, views, prior)
    if prior is None and config.instrument_at is None:
        attempts = with_consensus(recording, poses, views, attempts)
    run = solve_choices(recording, config, views, poses, attempts, progress)
    run, looks = _look_again(run, config, several, progress) if with_pictures else (run, ())
    run = _choose_again(run, config, several, progress)
    return FirstAnswer(run, views, attempts[0], about_views, looks)


def rough_answer(
    recording: Recording,
    config: CalibrationConfig,
    poses: MotionPoses,
    views: tuple[View, ...],
    prior: RigidTransform | None = None,
    with_pictures: bool = False,
) -> FirstAnswer:
    """The first answer at nominal noise (`quick`), for who does not want to wait; arguments as in `first_answer`.

    A robot less exact than assumed fits nothing then: its noise is estimated, as `calibrate` does.
    """
    rough = quick(config)
    first = first_answer(recording, rough, poses, views, prior, with_pictures=with_pictures)
    if first.run.result.status != "solver_failed":
        return first
    rough = replace(rough, solver=replace(rough.solver, noise=config.solver.noise))
    return first_answer(recording, rough, poses, views, prior, with_pictures=with_pictures)


def quick(config: CalibrationConfig) -> CalibrationConfig:
    """The configuration of a rough estimate: nominal noise, no offsets, none of the checks."""
    solver = config.solver
    plain = replace(
        solver,
        unknowns=replace(solver.unknowns, joint_offsets="never", clock=False),
        noise=replace(solver.noise, estimate="never"),
        groups=0,
        bias_correction=False,
    )
    return replace(config, solver=plain)


def without_false_candidates(views: tuple[View, ...], poses: MotionPoses) -> tuple[tuple[View, ...], tuple[str, ...]]:
    """The views without pictures that repeat the one before while the joints moved, and without candidates that stand
    still while the instrument moves; a note for each such view."""
    kept, notes = [], []
    for view in views:
        frames = poses.frames[repeated_motions(view.change, poses)]
        if len(frames):
            view = replace(view, detections=without_frames(view.detections, frames))
            notes.append(about_repeats(view.side, frames))
        detections, count = without_background(view.detections, poses)
        if count:
            notes.append(about_background(view.side, count))
        kept.append(replace(view, detections=detections))
    return tuple(kept), tuple(notes)


def solve_choices(
    recording: Recording,
    config: CalibrationConfig,
    views: tuple[View, ...],
    poses: MotionPoses,
    attempts: Sequence[tuple[Choice, ...]],
    progress: Progress,
) -> CalibrationRun:
    """The attempt that is predicted best: what does not move with the joints looks like noise of many pixels."""

    def rank(run: CalibrationRun) -> tuple[bool, float]:
        told = run.result.status in ("ok", "weak")
        sigma_mm = run.result.observability.working_point_sigma_mm
        return not told, sigma_mm if told and sigma_mm is not None else np.inf

    return min((solve(recording, config, views, poses, choices, progress) for choices in attempts), key=rank)


def _choose_again(run: CalibrationRun, config: CalibrationConfig, several: bool, progress: Progress) -> CalibrationRun:
    """Solve with the candidates nearest to what the answer before predicts, until these stay."""
    for _ in range(CHOICE_ROUNDS - 1):
        better = better_choices(run, several)
        if better is None or all(new.same_as(old) for new, old in zip(better, run.choices, strict=True)):
            break
        run = solve_again(run, config, better, progress)
    return run


def _look_again(
    run: CalibrationRun, config: CalibrationConfig, several: bool, progress: Progress
) -> tuple[CalibrationRun, tuple[str, ...]]:
    """The run with what looks at the pictures along its prediction find, and notes on it.

    What a first look finds makes the prediction better, and another one finds more.
    """
    before = run
    for _ in range(LOOKS):
        views = look_along(run, config, progress) if run.result.status in ("ok", "weak") else None
        choices = None if views is None else better_choices(replace(run, views=views), several)
        if views is None or choices is None:
            break
        again = solve_again(replace(run, views=views), config, choices, progress)
        if again.result.status not in ("ok", "weak"):
            break
        run = again
    return run, about_looks(before.views, run.views)


def better_choices(run: CalibrationRun, several: bool) -> tuple[Choice, ...] | None:
    """Candidates nearest to what the first answer predicts; None when there is no answer to predict from.

    Only of pictures that show several instruments any is passed over: in others, what does not fit speaks against the
    answer. An answer that the data do not determine still predicts these motions: what is open moves no contour.
    """
    if run.result.status not in ("ok", "weak", "unobservable"):
        return None
    used = torch.as_tensor(run.result.motions.used[run.poses.frames], device=run.poses.arm_T_rcm.device)
    better = []
    for view, choice in zip(run.views, run.choices, strict=True):
        prediction = expected_contours(run, view)
        if prediction is None:
            return None
        found = view.at(run.poses.frames)
        reach = association_gate(choice, found, prediction, used) if several else torch.inf
        better.append(consistent_choice(found, prediction, reach))
    return tuple(better)


def solve_again(
    run: CalibrationRun, config: CalibrationConfig, choices: tuple[Choice, ...], progress: Progress
) -> CalibrationRun:
    """The same recording solved with other choices or settings, at the clock that was found."""
    return solve(run.recording, config, run.views, run.told, choices, progress, run.clock)


def solve(
    recording: Recording,
    config: CalibrationConfig,
    views: tuple[View, ...],
    told: MotionPoses,
    choices: tuple[Choice, ...],
    progress: Progress,
    clock: tuple[float, float] | None = None,
) -> CalibrationRun:
    """Assemble the chosen candidates, solve, and say what came out; `clock` saves the search for it.

    Every solve sets out from the kinematics as the recording tells them: a run's poses are at what it found, which must
    not be taken for what is stated.
    """
    poses, known = told, torch.ones_like(told.rcm_s_end_mm, dtype=torch.bool)

    def refused(why: str, observations: ShaftObservations | None) -> CalibrationRun:
        result = insufficient_data(config, motions_of(recording, views, told, choices, None), why)
        return CalibrationRun(result, recording, views, told, told, choices, observations, None)

    seen = int(torch.stack([choice.taken for choice in choices]).any(dim=0).sum())
    if seen < config.min_motions:
        return refused(f"{seen} of {recording.n_frames} motions are usable, {config.min_motions} are needed", None)
    progress("solving", 0, 1)
    observations = assemble(recording, poses, views, choices, config)
    unknowns = recording_unknowns(recording, poses, config.solver, config.device)
    try:
        if unknowns is None:
            solution, notes = estimate(observations, config), ()
        else:
            solution, notes = estimate_with_kinematics(observations, config, unknowns, clock)
            offsets = estimated_offsets(solution, unknowns.columns, poses.rcm_s_end_mm)
            poses, known = unknowns.motion_poses(poses.frames, *offsets)
            observations = assemble(recording, poses, views, tuple(c.where(known) for c in choices), config)
            observations = replace(observations, **unknowns.displacements(*offsets))
    except InsufficientDataError as error:
        return refused(str(error), observations)
    progress("solving", 1, 1)
    motions = motions_of(recording, views, poses, choices, solution)
    residuals = residuals_px(recording, poses, solution, motions.used)
    columns, names = (), MotionNames(poses.frames)
    if unknowns is not None:
        columns = unknowns.columns
        names = MotionNames(poses.frames, columns, unknowns.readings_of_motions().cpu().numpy())
    result = make_result(solution, motions, residuals, config, columns, notes, frame_of(recording), names)
    poses = with_rcm_offset(with_setup(poses, result.kinematic_offsets), result.kinematic_offsets.rcm_mm)
    errors = head_point_errors(result, recording, poses.select(known))
    residuals = result.residuals | {
        f"head_{side}": residual_of(distance, "px", np.isfinite(distance)) for side, distance in (errors or {}).items()
    }
    ends = with_unmeasured(result.ends, views, told, choices)
    result = replace(result, residuals=residuals, head_point_error_px=summarise_head_points(errors), ends=ends)
    return CalibrationRun(result, recording, views, told, poses, choices, observations, solution)
