"""The calibration of one recording: detect, forward kinematics, assemble, solve, choose again, check."""

from dataclasses import replace
from typing import Any

import numpy as np
import torch

from rmis_calib.config import CalibrationConfig
from rmis_calib.errors import InsufficientDataError
from rmis_calib.io import Recording
from rmis_calib.pipeline.choosing import (
    Choice,
    association_gate,
    choices_by_instrument,
    consistent_choice,
)
from rmis_calib.pipeline.detection import Progress, View, detect_recording, no_progress
from rmis_calib.pipeline.device import require_device
from rmis_calib.pipeline.estimation import (
    estimate,
    estimate_with_kinematics,
    make_result,
    problem_of,
    raise_unless_trustworthy,
    residual_arrays,
    residual_record,
    used_motions,
)
from rmis_calib.pipeline.evaluation import head_point_errors, summarise_head_points
from rmis_calib.pipeline.frozen import about_repeats, repeated_motions, without_frames
from rmis_calib.pipeline.kinematic_unknowns import (
    KinematicUnknowns,
    poses_at,
    with_rcm_offset,
)
from rmis_calib.pipeline.misfit import with_misfit_named
from rmis_calib.pipeline.next_motion import (
    advice_record,
    camera_view,
    joint_candidates,
    limits_in_words,
    may_advise,
)
from rmis_calib.pipeline.observing import assemble, reasons_for, select_frames
from rmis_calib.pipeline.offset_unknowns import estimated_offsets
from rmis_calib.pipeline.poses import MotionPoses, motion_poses
from rmis_calib.pipeline.run import CalibrationRun
from rmis_calib.pipeline.starting import first_choices, read_prior
from rmis_calib.results import STATUS_SENTENCES, CalibrationResult, Motions
from rmis_calib.solver import Solution
from rmis_calib.vision import ShaftDetections
from rmis_calib.vision.masks import Segmenter

JOINTS_UNKNOWN = "the joint log does not cover this time"
TOO_FEW = "usable, but there are too few"
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
) -> CalibrationRun:
    """The whole calibration, keeping what each step made.

    Source: paper, Algorithm 1, with detection before it and a check of the answer after it.
    """
    config = config or CalibrationConfig()
    require_device(config.device)
    prior = read_prior(config)
    poses = motion_poses(recording, config.device)
    views = detect_recording(recording, config, progress, segment=segment)
    views, notes = _without_repeats(views, poses)
    draft = _without_joint_offsets(config)
    detections = tuple(select_frames(view.detections, poses.frames) for view in views)
    instruments = choices_by_instrument(detections)
    starts = first_choices(recording, config, poses, detections, instruments, prior)
    run = _surest([_solve_choice(recording, draft, views, poses, choices, progress) for choices in starts])
    for _ in range(CHOICE_ROUNDS - 1):
        better = _choose_again(run, detections, several=bool(instruments))
        if better is None or all(new.same_as(old) for new, old in zip(better, run.choices, strict=True)):
            break
        run = _solve_choice(recording, draft, views, poses, better, progress, run.clock_s)
    if draft != config:
        run = _solve_choice(recording, config, views, poses, run.choices, progress, run.clock_s)
    result = with_misfit_named(run, config)
    run = replace(run, result=replace(result, notes=recording.notes + notes + result.notes))
    return _advised(run, config)


def _without_repeats(views: tuple[View, ...], poses: MotionPoses) -> tuple[tuple[View, ...], tuple[str, ...]]:
    """The views without pictures that repeat the one before while the joints moved, and a note for each such view."""
    kept, notes = [], []
    for view in views:
        frames = poses.frames[repeated_motions(view.change, poses)]
        if len(frames):
            view = replace(view, detections=without_frames(view.detections, frames))
            notes.append(about_repeats(view.side, frames))
        kept.append(view)
    return tuple(kept), tuple(notes)


def _surest(runs: list[CalibrationRun]) -> CalibrationRun:
    """The run whose answer is predicted best: what does not move with the joints looks like noise of many pixels."""

    def rank(run: CalibrationRun) -> tuple[bool, float]:
        told = run.result.status in ("ok", "weak")
        return not told, run.result.observability["working_point_sigma_mm"] if told else np.inf

    return min(runs, key=rank)


def _without_joint_offsets(config: CalibrationConfig) -> CalibrationConfig:
    """A shaft is told from another one well enough without asking whether the encoders have offsets."""
    unknowns = config.solver.unknowns
    if unknowns.joint_offsets != "auto":
        return config
    return replace(config, solver=replace(config.solver, unknowns=replace(unknowns, joint_offsets="never")))


def _solve_choice(
    recording: Recording,
    config: CalibrationConfig,
    views: tuple[View, ...],
    poses: MotionPoses,
    choices: tuple[Choice, ...],
    progress: Progress,
    clock_s: float | None = None,
) -> CalibrationRun:
    """Assemble the chosen candidates, solve, and say what came out; `clock_s` saves the search for the clock."""
    seen = torch.stack([choice.taken for choice in choices]).any(dim=0)
    if int(seen.sum()) < config.min_motions:
        motions = _motions(recording, views, poses, choices, None)
        return CalibrationRun(_insufficient(config, motions), recording, views, poses, choices, None, None)
    progress("solving", 0, 1)
    observations = assemble(recording, poses, views, choices, config)
    unknowns = _kinematic_unknowns(recording, poses, config)
    try:
        if unknowns is None:
            solution, notes = estimate(observations, config), ()
        else:
            solution, notes = estimate_with_kinematics(observations, config, unknowns, clock_s)
            offsets = estimated_offsets(solution, unknowns.columns, poses.rcm_s_end_mm)
            poses, known = unknowns.motion_poses(poses.frames, *offsets)
            observations = assemble(recording, poses, views, tuple(c.where(known) for c in choices), config)
            observations = replace(observations, **unknowns.displacements(*offsets))
    except InsufficientDataError as error:
        motions = _motions(recording, views, poses, choices, None)
        result = _insufficient(config, motions, str(error))
        return CalibrationRun(result, recording, views, poses, choices, observations, None)
    progress("solving", 1, 1)
    motions = _motions(recording, views, poses, choices, solution)
    columns = () if unknowns is None else unknowns.columns
    result = make_result(
        solution, motions, _residuals_px(recording, poses, solution, motions.used), config, columns, notes
    )
    poses = with_rcm_offset(poses, result.kinematic_offsets.rcm_mm)
    errors = head_point_errors(result, recording, poses_at(recording, result.kinematic_offsets, config.device))
    residuals = result.residuals | {
        f"head_{side}": residual_record(distance, "px", np.isfinite(distance))
        for side, distance in (errors or {}).items()
    }
    result = replace(result, residuals=residuals, head_point_error_px=summarise_head_points(errors))
    return CalibrationRun(result, recording, views, poses, choices, observations, solution)


def _advised(run: CalibrationRun, config: CalibrationConfig) -> CalibrationRun:
    """The run with the motions in its result that would help most."""
    if run.observations is None or run.solution is None or not may_advise(run.solution, config):
        return run
    problem = problem_of(run.observations, config)
    used, _ = used_motions(run.solution)
    unknowns = KinematicUnknowns(run.recording, run.poses.frames, config.device)
    settings = config.solver.advice
    candidates = joint_candidates(
        run.recording, unknowns, problem, run.solution, used, settings, seed=config.solver.seed
    )
    stereo = run.recording.stereo
    cameras = [camera for camera in (stereo.right, stereo.left) if camera is not None][: problem.n_cameras]
    view = torch.stack([camera_view(camera) for camera in cameras]).to(config.device)
    record = advice_record(run.solution, candidates, view, config, limits_in_words(settings))
    result = replace(run.result, observability=run.result.observability | record)
    return replace(run, result=result)


def _kinematic_unknowns(
    recording: Recording, poses: MotionPoses, config: CalibrationConfig
) -> KinematicUnknowns | None:
    """The kinematics as a function of joint and clock offsets, where these are asked for."""
    asked = config.solver.unknowns
    if config.solver.method != "joint" or (asked.joint_offsets == "never" and not asked.clock):
        return None
    return KinematicUnknowns(recording, poses.frames, config.device)


def _choose_again(
    run: CalibrationRun, detections: tuple[ShaftDetections, ...], several: bool
) -> tuple[Choice, ...] | None:
    """Candidates nearest to what the first answer predicts; None when there is no answer to predict from.

    Only of pictures that show several instruments any is passed over: in others, what does not fit speaks against the
    answer.
    """
    if run.result.status not in ("ok", "weak"):
        return None
    used = torch.as_tensor(run.result.motions.used[run.poses.frames], device=run.poses.arm_T_rcm.device)
    better = []
    for view, found, choice in zip(run.views, detections, run.choices, strict=True):
        prediction = run.predicted_contours(view)
        if prediction is None:
            return None
        reach = association_gate(choice, found, prediction, used) if several else torch.inf
        better.append(consistent_choice(found, prediction, reach))
    return tuple(better)


def _motions(
    recording: Recording,
    views: tuple[View, ...],
    poses: MotionPoses,
    choices: tuple[Choice, ...],
    solution: Solution | None,
) -> Motions:
    """Used and rejected frames, each rejected one with its first reason."""
    used = np.zeros(recording.n_frames, dtype=bool)
    reasons = [JOINTS_UNKNOWN] * recording.n_frames
    by_view = [reasons_for(view, poses, choice) for view, choice in zip(views, choices, strict=True)]
    solved, solver_reasons = (None, None) if solution is None else used_motions(solution)
    for motion, frame in enumerate(poses.frames):
        missing = [view_reasons[motion] for view_reasons in by_view]
        if all(missing):
            reasons[frame] = missing[0]
        elif solved is None or solver_reasons is None:
            reasons[frame] = TOO_FEW
        else:
            used[frame], reasons[frame] = bool(solved[motion]), solver_reasons[motion]
    return Motions(used, tuple(reasons), recording.frame_times_s)


def _residuals_px(
    recording: Recording, poses: MotionPoses, solution: Solution, used: np.ndarray
) -> dict[str, dict[str, Any]]:
    """Residuals of each kind and camera in pixels, by frame."""
    left = recording.stereo.left
    arrays = residual_arrays(
        solution, float(recording.stereo.right.focal), float(left.focal) if left is not None else 1.0
    )
    records = {}
    for name, by_motion in arrays.items():
        by_frame = np.full(recording.n_frames, np.nan)
        by_frame[poses.frames] = by_motion
        records[name] = residual_record(by_frame, "px", used)
    return records


def _insufficient(config: CalibrationConfig, motions: Motions, why: str | None = None) -> CalibrationResult:
    usable = sum(reason == TOO_FEW for reason in motions.reasons)
    why = why or f"{usable} of {len(motions.used)} motions are usable, {config.min_motions} are needed"
    return CalibrationResult(
        status="insufficient_data",
        message=f"{STATUS_SENTENCES['insufficient_data']}: {why}",
        method=config.solver.method,
        camera_right_T_arm=None,
        camera_left_T_camera_right=None,
        covariance=None,
        observability={"verdict": "unobservable", "sentences": [why]},
        motions=motions,
        config=config.to_dict(),
    )
