"""What can be said of a recording before it is calibrated, in words: of its motions, and of what pictures show."""

import math
from dataclasses import dataclass

import numpy as np
import torch
from jaxtyping import Float
from torch import Tensor

from rmis_calib.config import CalibrationConfig
from rmis_calib.io import Recording
from rmis_calib.pipeline.arms.poses import MotionPoses
from rmis_calib.pipeline.checks.stereo_order import looks_swapped, median_inverse_depth
from rmis_calib.pipeline.motions.association import Choice
from rmis_calib.pipeline.pictures.detection import View
from rmis_calib.pipeline.words import joined
from rmis_calib.robot import split_joint_column

_FEW_KNOWN = 0.5
"""Share of frames with known joints below which the clocks, or the log, are in doubt."""
_LEAST_TURN_DEG, _LEAST_SHIFT_MM = 2.0, 5.0
"""Motion of the shaft below which nothing but noise is measured; the simulations have 10 deg and 20 mm."""
_SAME_RAD, _SAME_MM = 0.01, 2.0
"""Motions nearer to each other are one: half a degree, and what noise of kinematics is."""
_RARELY_FOUND = 0.25
_STANDS = {"rad": 1e-3, "mm": 0.1}
"""Range of a joint that stands still."""


@dataclass(frozen=True)
class Finding:
    """One thing that was looked at.

    Attributes:
        topic: one or two words.
        sentence: what was found.
        is_doubt: whether it would make a calibration untrustworthy.
    """

    topic: str
    sentence: str
    is_doubt: bool = False


def about_motions(recording: Recording, poses: MotionPoses, config: CalibrationConfig) -> list[Finding]:
    """Clocks, and what moved how far."""
    known, n = len(poses.frames), recording.n_frames
    found = [Finding("clocks", f"joints are known at {known} of {n} frames", known < _FEW_KNOWN * n)]
    found.append(Finding("joints", _ranges(recording, poses)))
    distinct = distinct_motions(poses)
    if distinct < config.min_motions:
        sentence = f"{distinct} distinct motions: at least {config.min_motions} are needed, 30 or more are better"
        return [*found, Finding("motion", sentence, is_doubt=True)]
    turn_deg, shift_mm = shaft_motion(poses)
    sentence = f"{distinct} distinct motions; the shaft turned by {turn_deg:.1f} deg and slid by {shift_mm:.0f} mm"
    too_small = turn_deg < _LEAST_TURN_DEG and shift_mm < _LEAST_SHIFT_MM
    found.append(Finding("motion", sentence + ("; move it by 10 deg or more" if too_small else ""), too_small))
    return found


def about_pictures(
    searched: tuple[View, ...], views: tuple[View, ...], looked: np.ndarray, repeats: list[str]
) -> list[Finding]:
    """Whether the shaft is found and pictures repeat.

    Args:
        searched: detections of every frame.
        views: the same after looking again where a first answer puts the shaft.
        looked: numbers of the frames that were searched.
        repeats: notes about pictures that repeat others (`about_repeats`).
    """
    found = [Finding("repeated", note, is_doubt=True) for note in repeats]
    for first, second in zip(searched, views, strict=True):
        index = torch.as_tensor(looked, device=first.found.device)
        alone, shows = (int(view.found[index].sum()) for view in (first, second))
        sentence = f"camera_{first.side}: found in {shows} of {len(looked)} frames looked at"
        if shows > alone:
            sentence += f", in {shows - alone} of them only by looking again where a first answer puts it"
        found.append(Finding("shaft", sentence, shows < _RARELY_FOUND * len(looked)))
    return found


def about_order(
    recording: Recording, poses: MotionPoses, views: tuple[View, ...], choices: tuple[Choice, ...]
) -> list[Finding]:
    """Whether the right pictures are the right camera's."""
    at = [view.at(poses.frames) for view in views]
    inverse_depth = median_inverse_depth(recording.stereo.camera_left_T_camera_right, at, choices)
    if inverse_depth is None:
        return []
    if looks_swapped(inverse_depth):
        sentence = (
            "the disparity puts the shaft behind the cameras: the right and the left pictures look swapped, or "
            "camera_left_T_camera_right is the inverse of what it should be"
        )
        return [Finding("stereo", sentence, is_doubt=True)]
    depth = f"{1.0 / inverse_depth:.0f} mm" if inverse_depth > 1e-3 else "a metre or more"
    return [Finding("stereo", f"the disparity puts the shaft {depth} in front of the cameras")]


def shaft_motion(poses: MotionPoses) -> tuple[float, float]:
    """Largest turn of the shaft between two motions, deg, and its range along itself, mm, both as `arm` sees them."""
    d, along = _directions(poses), poses.rcm_s_end_mm
    centre = d.mean(0)
    far = d[(d @ centre).argmin()]
    turn = float(torch.rad2deg((d @ far).clamp(-1.0, 1.0).acos().amax()))
    return turn, float(along.amax() - along.amin())


def distinct_motions(poses: MotionPoses) -> int:
    """Number of motions that differ by more than noise: frames of an arm that rests are one."""
    if not len(poses.frames):
        return 0
    cells = torch.cat(
        [_directions(poses) / _SAME_RAD, poses.arm_T_rcm[:, :3, 3] / _SAME_MM, poses.rcm_s_end_mm[:, None] / _SAME_MM],
        dim=-1,
    )
    return len(torch.unique(cells.round(), dim=0))


def _directions(poses: MotionPoses) -> Float[Tensor, "m 3"]:
    """Direction of the shaft in `arm`."""
    return (poses.arm_T_rcm[:, :3, :3] @ poses.rcm_v_axis[..., None])[..., 0]


def _ranges(recording: Recording, poses: MotionPoses) -> str:
    """How far each joint went, those that stood still named together."""
    moved, still = [], []
    for arm in (recording.laparoscope_arm, recording.instrument_arm):
        if arm is None or not len(poses.frames):
            continue
        readings, _ = recording.joints_at_frames(arm)
        spans = np.ptp(readings[poses.frames], axis=0)
        for column, span in zip(recording.robot.columns(arm), spans, strict=True):
            name, unit = split_joint_column(column)
            if span < _STANDS[unit]:
                still.append(name)
            else:
                moved.append(f"{name} {span:.0f} mm" if unit == "mm" else f"{name} {math.degrees(span):.1f} deg")
    if recording.laparoscope_arm is None:
        still.append("the camera (on no logged arm)")
    parts = [f"ranges: {', '.join(moved)}"] if moved else []
    return "; ".join([*parts, f"standing still: {joined(still)}"] if still else parts) or "none known"
