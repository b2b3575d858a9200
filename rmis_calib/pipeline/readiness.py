"""`rc.check`: everything that can be said of a recording before it is calibrated, within seconds.

A few frames are searched; the pose that they give predicts what all motions would tell.
"""

from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import torch
from jaxtyping import UInt8
from torch import Tensor

from rmis_calib.config import CalibrationConfig
from rmis_calib.geometry.cameras import Camera
from rmis_calib.io import FrameBatch, FrameSource, Recording, load_recording
from rmis_calib.pipeline.answer.advice.candidates import at_found_setup
from rmis_calib.pipeline.answer.advice.next_motions import camera_view, may_advise
from rmis_calib.pipeline.answer.run import CalibrationRun
from rmis_calib.pipeline.arms.kinematic_unknowns import KinematicUnknowns
from rmis_calib.pipeline.arms.poses import MotionPoses, motion_poses
from rmis_calib.pipeline.checks.findings import Finding, about_motions, about_order, about_pictures
from rmis_calib.pipeline.device import require_device
from rmis_calib.pipeline.first_answer import FirstAnswer, rough_answer
from rmis_calib.pipeline.motions.association import read_prior
from rmis_calib.pipeline.motions.observations import problem_of
from rmis_calib.pipeline.pictures.detection import View, over_all
from rmis_calib.pipeline.pictures.frozen import ChangeMeter, about_repeats, repeated_motions, without_frames
from rmis_calib.pipeline.pictures.masks import MaskReader, open_masks
from rmis_calib.solver.assess.information import inverse
from rmis_calib.solver.assess.next_motion import measured_alike, predicted_information
from rmis_calib.solver.assess.observability import assess
from rmis_calib.solver.observability import Verdict
from rmis_calib.vision import ShaftDetections, ShaftDetector

_PLACES = 10
"""Places in the recording that are looked at."""
_PREDICTED_MOTIONS = 60
"""Motions, spread over the recording, that the expected accuracy counts: neighbours say little more than one."""


@dataclass(frozen=True)
class RecordingCheck:
    """What was found in a recording.

    Attributes:
        findings: everything that was looked at, in this order.
        notes: what was guessed or mended while the files were read.
        expected_sigma_mm, expected_sigma_deg: predicted error of a calibration at the working point, 1 sigma, for
            encoders without constant offsets; None where the frames looked at predict nothing.
    """

    findings: tuple[Finding, ...]
    notes: tuple[str, ...]
    expected_sigma_mm: float | None = None
    expected_sigma_deg: float | None = None

    @property
    def doubts(self) -> tuple[Finding, ...]:
        """What would make a calibration untrustworthy."""
        return tuple(finding for finding in self.findings if finding.is_doubt)

    @property
    def fit(self) -> bool:
        """Whether nothing speaks against calibrating it."""
        return not self.doubts


def check(recording: Recording | str | Path, config: CalibrationConfig | None = None) -> RecordingCheck:
    """Look a recording over: files, clocks, motion, a few pictures, and the accuracy to expect of a calibration.

    Args:
        recording: the recording, or its folder.
        config: as for `calibrate`.
    Raises:
        FileError, VideoError, RecordingError, RobotError, InputError: it breaks its format (`load_recording`).
    """
    config = config or CalibrationConfig()
    require_device(config.device)
    opened = recording if isinstance(recording, Recording) else load_recording(recording)
    poses = motion_poses(opened, config.device)
    findings = [_about_files(opened), *about_motions(opened, poses, config)]
    if not len(poses.frames):
        return RecordingCheck(tuple(findings), opened.notes)
    looked, views, repeats = _look(opened, poses, config)
    first = _rough(opened, config, poses, views, looked)
    run = first.run
    findings += about_pictures(first.searched, run.views, looked, repeats)
    findings += about_order(opened, run.poses, run.views, run.choices)
    if any(finding.is_doubt and finding.topic != "clocks" for finding in findings):
        return RecordingCheck(tuple(findings), opened.notes)
    expected, sigma = _expected(run, config)
    return RecordingCheck((*findings, expected), opened.notes, *sigma)


def _about_files(recording: Recording) -> Finding:
    times, (height, width) = recording.frame_times_s, recording.right.size
    kind = "stereo pairs" if recording.left is not None else "frames of one camera"
    count = recording.n_frames
    rate = f", {(count - 1) / (times[-1] - times[0]):.3g} a second" if count > 1 and times[-1] > times[0] else ""
    return Finding("files", f"{count} {kind}, {width} x {height} px{rate}; joints over {_span(recording)}")


def _span(recording: Recording) -> str:
    times_s = recording.joints.timestamps_s
    return f"{times_s[-1] - times_s[0]:.1f} s"


def _look(
    recording: Recording, poses: MotionPoses, config: CalibrationConfig
) -> tuple[np.ndarray, tuple[View, ...], list[str]]:
    """Some frames searched: their numbers, each camera's view, and notes on pictures that repeat others."""
    places = np.unique(np.linspace(0, len(poses.frames) - 1, _PLACES).astype(int))
    looked = poses.frames[places]
    before = np.maximum(places - 1, 0)
    shown = np.unique(np.concatenate([places, before]))
    few = poses.select(torch.isin(torch.arange(len(poses.frames)), torch.as_tensor(shown)))
    sources: dict[str, tuple[FrameSource, Camera | None]] = {"right": (recording.right, recording.stereo.right)}
    if recording.left is not None:
        sources["left"] = (recording.left, recording.stereo.left)
    masks = open_masks(
        config.masks, {side: source for side, (source, _) in sources.items()}, config.device, config.mask_labels
    )
    is_looked, index = torch.as_tensor(np.isin(few.frames, looked)), torch.as_tensor(looked)
    views, repeats, jobs = [], [], {}
    # The search of one camera's pictures goes on while the other's are decoded.
    with ThreadPoolExecutor(len(sources), thread_name_prefix="rmis-check") as executor:
        for side, (source, camera) in sources.items():
            images = source.frames(few.frames.tolist()).to(config.device)
            jobs[side] = (
                executor.submit(_detections, images[is_looked], looked, camera, masks.get(side), config),
                ChangeMeter()(images).cpu(),
            )
        for side, (source, camera) in sources.items():
            found, change = jobs[side][0].result(), torch.full((source.count,), torch.inf)
            change[torch.as_tensor(few.frames)] = jobs[side][1]
            frames = few.frames[repeated_motions(change, few)]
            repeats += [about_repeats(side, frames)] if len(frames) else []
            detections = without_frames(over_all(found, source.count, index), frames)
            # Of the frames looked at, none is the one before another: their change says nothing of these alone.
            views.append(View(side, source, camera, detections, torch.full_like(change, torch.inf)))
    return looked, tuple(views), repeats


def _detections(
    images: UInt8[Tensor, "n 3 h w"],
    looked: np.ndarray,
    camera: Camera | None,
    masks: MaskReader | None,
    config: CalibrationConfig,
) -> ShaftDetections:
    """Shafts of the pictures looked at."""
    detector = ShaftDetector(config.detector, None if camera is None else camera.to(torch.float64, config.device))
    batch = FrameBatch(torch.as_tensor(looked), images)
    return detector.detect(images, None if masks is None else masks(batch))


def _rough(
    recording: Recording, config: CalibrationConfig, poses: MotionPoses, views: tuple[View, ...], looked: np.ndarray
) -> FirstAnswer:
    """A calibration from the frames looked at: good enough to predict what all would tell."""
    known = torch.as_tensor(np.isin(poses.frames, looked), device=poses.arm_T_rcm.device)
    look_again = config.look_again and config.masks is None
    return rough_answer(recording, config, poses.select(known), views, read_prior(config), look_again)


def _expected(run: CalibrationRun, config: CalibrationConfig) -> tuple[Finding, tuple[float | None, float | None]]:
    """What all motions would tell, as the rough calibration predicts it.

    Source: the information of noise-free measurements adds to that of the frames looked at (solver/assess).
    """
    solution, recording = run.solution, run.recording
    if solution is None or solution.posterior is None or run.observations is None or not may_advise(solution, config):
        why = run.result.message
        return Finding("expected", f"the frames examined do not predict the accuracy ({why})"), (None, None)
    all_poses = motion_poses(recording, config.device)
    spread = np.unique(np.linspace(0, len(all_poses.frames) - 1, _PREDICTED_MOTIONS).astype(int))
    unknowns = KinematicUnknowns(recording, all_poses.frames[spread], config.device)
    problem = at_found_setup(problem_of(run.observations, config).flatten_batch(), solution)
    readings = unknowns.readings_of_motions()
    at = unknowns.resting_at(measured_alike(problem, len(spread)), readings, torch.zeros_like(readings[0]))
    cameras = [camera for camera in (recording.stereo.right, recording.stereo.left) if camera is not None]
    view = torch.stack([camera_view(camera) for camera in cameras[: problem.n_cameras]]).to(config.device)
    gain, visible = predicted_information(at, solution.posterior, view, config.solver)
    is_new = torch.as_tensor(~np.isin(all_poses.frames[spread], run.poses.frames), device=gain.device)
    covariance = inverse(solution.posterior.information[0] + gain[visible & is_new].sum(0))[None, :6, :6]
    state, flags = solution.posterior.state, solution.observability.degeneracy
    seen = assess(problem, state.R, state.t, covariance, config.solver.verdict, flags)
    in_view = f"the shaft in view in {int(visible.sum())} of {len(spread)} motions"
    sigma = (float(seen.working_point_sigma_mm[0]), float(seen.rotation_sigma_deg[0]))
    doubtful = Verdict.of(seen.verdict[0]) is not Verdict.TRUSTWORTHY
    sentence = f"{seen.describe().sentences[0]}; {in_view}. Predicted for encoders without constant offsets."
    return Finding("expected", sentence, doubtful), sigma
