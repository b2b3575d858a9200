"""The calibration of one recording: detect, forward kinematics, associate, solve, choose again, check, advise."""

from dataclasses import replace

import numpy as np
import torch

from rmis_calib.config import CalibrationConfig
from rmis_calib.geometry.rigid import RigidTransform
from rmis_calib.io import Recording
from rmis_calib.pipeline.answer.advice.next_motions import with_next_motions
from rmis_calib.pipeline.answer.estimation import raise_unless_trustworthy
from rmis_calib.pipeline.answer.rolling_shutter import with_rows_at_one_instant
from rmis_calib.pipeline.answer.run import CalibrationRun
from rmis_calib.pipeline.arms.poses import MotionPoses, motion_poses
from rmis_calib.pipeline.checks.findings import about_motions, about_order
from rmis_calib.pipeline.checks.misfit import with_misfit_named
from rmis_calib.pipeline.checks.picture_check import with_picture_check
from rmis_calib.pipeline.device import require_device
from rmis_calib.pipeline.first_answer import first_answer, solve, solve_again
from rmis_calib.pipeline.motions.association import read_prior
from rmis_calib.pipeline.pictures.detection import (
    OWN_DETECTORS,
    Detectors,
    Progress,
    View,
    detect_recording,
    no_progress,
)
from rmis_calib.results import CalibrationResult
from rmis_calib.solver.problem import stands_still
from rmis_calib.vision.masks import Segmenter


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
    poses = motion_poses(recording, config.device)
    views = detect_recording(recording, config, progress, segment=segment, detectors=detectors)
    own_masks = segment is not None or config.masks is not None
    return calibrate_views(recording, config, poses, views, prior, progress, own_masks)


def calibrate_views(
    recording: Recording,
    config: CalibrationConfig,
    poses: MotionPoses,
    views: tuple[View, ...],
    prior: RigidTransform | None = None,
    progress: Progress = no_progress,
    own_masks: bool = False,
) -> CalibrationRun:
    """The calibration from shafts that are detected already.

    Args:
        recording: cameras, arms and joints.
        config: the configuration.
        poses: kinematics of the motions.
        views: detections of every frame, one entry a camera.
        prior: from `read_prior`.
        progress: called with (stage, done, total).
        own_masks: whether masks told the shaft: it need not look like one then.
    """
    recording, poses = _without_unknown_arm(recording, poses)
    draft = _without_joint_offsets(config)
    look_again = config.look_again and not own_masks
    first = first_answer(recording, draft, poses, views, prior, progress, look_again)
    run = first.run
    checked = (*about_motions(recording, poses, config), *about_order(recording, poses, first.searched, first.surest))
    doubts = [f"{finding.topic}: {finding.sentence}" for finding in checked if finding.is_doubt]
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
    run = run.with_notes((*recording.notes, *first.about_views, *doubts, *first.about_looks, *about_rows))
    run = with_next_motions(run, config)
    progress("checking", 1, 1)
    return with_picture_check(run, own_masks)


def _without_unknown_arm(recording: Recording, poses: MotionPoses) -> tuple[Recording, MotionPoses]:
    """Without the laparoscope's arm where it stands still, and where the arms' bases are is stated with a sigma or not
    at all: the pose of the instrument's base in the camera is then all that there is to know."""
    told = poses.setup_is_stated and not any(poses.setup_sigma or ())
    if told or poses.laparoscope_base_T_arm is None or not stands_still(poses.laparoscope_base_T_arm):
        return recording, poses
    return replace(recording, laparoscope_arm=None, robot=recording.robot.without_bases()), poses.in_instrument_base()


def _without_joint_offsets(config: CalibrationConfig) -> CalibrationConfig:
    """A shaft is told from another one well enough without asking whether the encoders have offsets."""
    return config if config.solver.unknowns.joint_offsets != "auto" else _asking(config, joint_offsets="never")


def _asking(config: CalibrationConfig, **unknowns: bool | str | float) -> CalibrationConfig:
    """The settings with these of its unknowns changed."""
    asked = replace(config.solver.unknowns, **unknowns)
    return replace(config, solver=replace(config.solver, unknowns=asked))


def _with_rows_at_one_instant(
    run: CalibrationRun, config: CalibrationConfig, progress: Progress
) -> tuple[CalibrationRun, tuple[str, ...]]:
    """The same choice solved with the rows of each picture put to one instant, and a note on it."""

    def at_one_instant(views: tuple[View, ...]) -> CalibrationRun:
        return solve_again(replace(run, views=views), config, run.choices, progress)

    run, note = with_rows_at_one_instant(run, at_one_instant)
    return run, (note,) if note else ()


def _with_joint_offsets(run: CalibrationRun, config: CalibrationConfig, progress: Progress) -> CalibrationRun:
    """The same choice solved as configured, where the attempts before left the joint offsets out."""
    if _without_joint_offsets(config) == config:
        return run
    return solve_again(run, config, run.choices, progress)


def _with_cameras_as_given(run: CalibrationRun, config: CalibrationConfig) -> CalibrationRun:
    """The same choice solved without corrections of the cameras."""
    return solve_again(run, _asking(config, intrinsics=False), run.choices, no_progress)


def _with_clock(run: CalibrationRun, config: CalibrationConfig) -> CalibrationRun:
    """The same choice solved with the clock among the unknowns, wherever it may be."""
    return solve(run.recording, _asking(config, clock=True), run.views, run.told, run.choices, no_progress)


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
    return solve(recording, config, run.views, told, tuple(each.at(rows) for each in run.choices), no_progress)
