"""The calibration of one recording: detect, forward kinematics, associate, solve, choose again, check, advise."""

from collections.abc import Sequence
from dataclasses import replace

import numpy as np
import torch

from rmis_calib.config import CalibrationConfig
from rmis_calib.errors import InsufficientDataError
from rmis_calib.geometry.rigid import RigidTransform
from rmis_calib.io import Recording, ShaftObservations
from rmis_calib.pipeline.answer.advice.next_motions import with_next_motions
from rmis_calib.pipeline.answer.estimation import estimate, raise_unless_trustworthy
from rmis_calib.pipeline.answer.guided_look import about_looks, expected_contours, look_along
from rmis_calib.pipeline.answer.motion_names import MotionNames
from rmis_calib.pipeline.answer.offsets import estimate_with_kinematics
from rmis_calib.pipeline.answer.records.ends import with_unmeasured
from rmis_calib.pipeline.answer.records.residuals import residual_of, residuals_px
from rmis_calib.pipeline.answer.result import insufficient_data, make_result, motions_of
from rmis_calib.pipeline.answer.rolling_shutter import with_rows_at_one_instant
from rmis_calib.pipeline.answer.run import CalibrationRun
from rmis_calib.pipeline.arms.found_offsets import with_rcm_offset, with_setup
from rmis_calib.pipeline.arms.kinematic_unknowns import recording_unknowns
from rmis_calib.pipeline.arms.offset_unknowns import estimated_offsets
from rmis_calib.pipeline.arms.poses import MotionPoses, frame_of, motion_poses
from rmis_calib.pipeline.checks.findings import about_motions, about_order
from rmis_calib.pipeline.checks.misfit import with_misfit_named
from rmis_calib.pipeline.checks.picture_check import with_picture_check
from rmis_calib.pipeline.device import require_device
from rmis_calib.pipeline.evaluation import head_point_errors, summarise_head_points
from rmis_calib.pipeline.motions.association import Choice, associate, association_gate, consistent_choice, read_prior
from rmis_calib.pipeline.motions.consensus import with_consensus
from rmis_calib.pipeline.motions.observations import assemble
from rmis_calib.pipeline.pictures.background import about_background, without_background
from rmis_calib.pipeline.pictures.detection import (
    OWN_DETECTORS,
    Detectors,
    Progress,
    View,
    detect_recording,
    no_progress,
)
from rmis_calib.pipeline.pictures.frozen import about_repeats, repeated_motions, without_frames
from rmis_calib.results import CalibrationResult
from rmis_calib.solver.problem import stands_still
from rmis_calib.vision.masks import Segmenter

LOOKS = 2
"""Looks at the pictures along the prediction at most."""
CHOICE_ROUNDS = 3
"""Solves at most: a choice of candidates that has not settled by then alternates between equals."""


def calibrate(
    recording: Recording,
    config: CalibrationConfig | None = None,
    *,
    progress: Progress = no_progress,
    throw: bool = True,
    segment: Segmenter | None = None,
) -> CalibrationResult:
    """Find `camera_right_T_arm` of a recording.

    Args:
        recording: from `load_recording`.
        config: the defaults when None.
        progress: called with (stage, done, total).
        throw: raise when the result is not trustworthy; otherwise its `status` and `message` say so.
        segment: maps pictures (b, 3, h, w) in [0, 1] to masks of shafts, in place of `config.masks`.

    Raises:
        CalibrationFailed: no trustworthy result (with `throw`); its `result` holds what there is.
        InputError, FileError: the recording breaks its format.
    """
    result = run_calibration(recording, config, progress, segment).result
    if throw:
        raise_unless_trustworthy(result)
    return result


def run_calibration(
    recording: Recording,
    config: CalibrationConfig | None = None,
    progress: Progress = no_progress,
    segment: Segmenter | None = None,
    detectors: Detectors = OWN_DETECTORS,
) -> CalibrationRun:
    """The whole calibration, keeping what each step made; `detectors` says who looks for shafts.

    Source: paper, Algorithm 1, with detection before it and a check of the answer after it.
    """
    config = config or CalibrationConfig()
    require_device(config.device)
    prior = read_prior(config)
    recording, poses = _without_unknown_arm(recording, motion_poses(recording, config.device))
    views, notes = _detect(recording, config, poses, progress, segment, detectors)
    own_masks = segment is not None or config.masks is not None
    with_pictures = config.look_again and not own_masks
    run = calibrate_views(recording, config, poses, views, prior, notes, progress, with_pictures)
    return with_picture_check(run, own_masks)


def calibrate_views(
    recording: Recording,
    config: CalibrationConfig,
    poses: MotionPoses,
    views: tuple[View, ...],
    prior: RigidTransform | None = None,
    notes: tuple[str, ...] = (),
    progress: Progress = no_progress,
    with_pictures: bool = False,
) -> CalibrationRun:
    """The calibration from shafts that are detected already.

    Args:
        recording: cameras, arms and joints.
        config: the configuration.
        poses: kinematics of the motions.
        views: detections of every frame, one entry a camera.
        prior: from `read_prior`.
        notes: on what was detected.
        progress: called with (stage, done, total).
        with_pictures: the views' pictures can be read, to look at them again along what a first answer predicts.
    """
    attempts, several = associate(recording, config, poses, views, prior)
    if prior is None and config.instrument_at is None:
        attempts = with_consensus(recording, poses, views, attempts)
    checked = (*about_motions(recording, poses, config), *about_order(recording, poses, views, attempts[0]))
    notes += tuple(f"{finding.topic}: {finding.sentence}" for finding in checked if finding.is_doubt)
    draft = _without_joint_offsets(config)
    run = solve_choices(recording, draft, views, poses, attempts, progress)
    run, looks = _look_again(run, draft, several, progress) if with_pictures else (run, ())
    run = _choose_again(run, draft, several, progress)
    run, about_rows = _with_rows_at_one_instant(run, draft, progress)
    run = _with_joint_offsets(run, config, progress)
    progress("checking", 0, 1)
    run = with_misfit_named(
        run,
        config,
        plainly=lambda: _with_cameras_as_given(run, config),
        with_clock=lambda: _with_clock(run, config),
        supposing=lambda other, quickly: _supposing(other or recording, run, config, quickly),
    )
    run = run.with_notes((*recording.notes, *notes, *looks, *about_rows))
    run = with_next_motions(run, config)
    progress("checking", 1, 1)
    return run


def _without_unknown_arm(recording: Recording, poses: MotionPoses) -> tuple[Recording, MotionPoses]:
    """Without the laparoscope's arm where it stands still, and where the arms' bases are is stated with a sigma or not
    at all: the pose of the instrument's base in the camera is then all that there is to know."""
    told = poses.setup_is_stated and not any(poses.setup_sigma or ())
    if told or poses.laparoscope_base_T_arm is None or not stands_still(poses.laparoscope_base_T_arm):
        return recording, poses
    return replace(recording, laparoscope_arm=None, robot=recording.robot.without_bases()), poses.in_instrument_base()


def _detect(
    recording: Recording,
    config: CalibrationConfig,
    poses: MotionPoses,
    progress: Progress,
    segment: Segmenter | None,
    detectors: Detectors,
) -> tuple[tuple[View, ...], tuple[str, ...]]:
    """The views without pictures that repeat the one before while the joints moved, and without candidates that stand
    still while the instrument moves; a note for each such view."""
    kept, notes = [], []
    for view in detect_recording(recording, config, progress, segment=segment, detectors=detectors):
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

    return min((_solve(recording, config, views, poses, choices, progress) for choices in attempts), key=rank)


def _without_joint_offsets(config: CalibrationConfig) -> CalibrationConfig:
    """A shaft is told from another one well enough without asking whether the encoders have offsets."""
    return config if config.solver.unknowns.joint_offsets != "auto" else _asking(config, joint_offsets="never")


def _asking(config: CalibrationConfig, **unknowns: bool | str | float) -> CalibrationConfig:
    """The settings with these of its unknowns changed."""
    asked = replace(config.solver.unknowns, **unknowns)
    return replace(config, solver=replace(config.solver, unknowns=asked))


def _choose_again(run: CalibrationRun, config: CalibrationConfig, several: bool, progress: Progress) -> CalibrationRun:
    """Solve with the candidates nearest to what the answer before predicts, until these stay."""
    for _ in range(CHOICE_ROUNDS - 1):
        better = better_choices(run, several)
        if better is None or all(new.same_as(old) for new, old in zip(better, run.choices, strict=True)):
            break
        run = _solve_again(run, config, better, progress)
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
        again = _solve_again(replace(run, views=views), config, choices, progress)
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


def _with_rows_at_one_instant(
    run: CalibrationRun, config: CalibrationConfig, progress: Progress
) -> tuple[CalibrationRun, tuple[str, ...]]:
    """The same choice solved with the rows of each picture put to one instant, and a note on it."""

    def solve_again(views: tuple[View, ...]) -> CalibrationRun:
        return _solve_again(replace(run, views=views), config, run.choices, progress)

    run, note = with_rows_at_one_instant(run, solve_again)
    return run, (note,) if note else ()


def _with_joint_offsets(run: CalibrationRun, config: CalibrationConfig, progress: Progress) -> CalibrationRun:
    """The same choice solved as configured, where the attempts before left the joint offsets out."""
    if _without_joint_offsets(config) == config:
        return run
    return _solve_again(run, config, run.choices, progress)


def _with_cameras_as_given(run: CalibrationRun, config: CalibrationConfig) -> CalibrationRun:
    """The same choice solved without corrections of the cameras."""
    return _solve_again(run, _asking(config, intrinsics=False), run.choices, no_progress)


def _with_clock(run: CalibrationRun, config: CalibrationConfig) -> CalibrationRun:
    """The same choice solved with the clock among the unknowns, wherever it may be."""
    return _solve(run.recording, _asking(config, clock=True), run.views, run.told, run.choices, no_progress)


def _supposing(recording: Recording, run: CalibrationRun, config: CalibrationConfig, quickly: bool) -> CalibrationRun:
    """The same choice solved with what another recording says of joints and arms, and with few unknowns; `quickly` by
    its lines alone, at the assumed noise and without outliers, which tells only how far pictures and joints are
    apart."""
    config = _asking(config, joint_offsets="never", rcm_offset="never", compliance="never", readout="never", doubt=0.0)
    solver = replace(config.solver, groups=0, bias_correction=False)
    if quickly:
        noise = replace(solver.noise, estimate="never")
        solver = replace(solver, noise=noise, robust="off", max_iterations=20, tolerance_sigma=0.1)
        lines = tuple(kind for kind in config.measurements if kind in ("axis", "contours"))
        config = replace(config, measurements=lines or config.measurements)
    config, told = replace(config, solver=solver), motion_poses(recording, config.device)
    rows = torch.as_tensor(np.searchsorted(run.told.frames, told.frames), device=config.device)  # maybe fewer motions
    return _solve(recording, config, run.views, told, tuple(each.at(rows) for each in run.choices), no_progress)


def _solve_again(
    run: CalibrationRun, config: CalibrationConfig, choices: tuple[Choice, ...], progress: Progress
) -> CalibrationRun:
    """The same recording solved with other choices or settings, at the clock that was found."""
    return _solve(run.recording, config, run.views, run.told, choices, progress, run.clock)


def _solve(
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
