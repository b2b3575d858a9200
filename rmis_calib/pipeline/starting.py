"""Which candidates a calibration starts with: as a prior has it, as the user points, or each instrument in turn."""

from pathlib import Path

import numpy as np
import torch

from rmis_calib.config import CalibrationConfig
from rmis_calib.errors import InputError
from rmis_calib.geometry import RigidTransform
from rmis_calib.io import Recording
from rmis_calib.pipeline.choosing import Choice, consistent_choice, first_choice, pointed_at
from rmis_calib.pipeline.evaluation import read_reference
from rmis_calib.pipeline.observing import predict_contours, select_frames
from rmis_calib.pipeline.poses import MotionPoses
from rmis_calib.vision import ShaftDetections

_PRIOR_REACH = 0.05
"""How far off a shaft may be from where a prior puts it, normalised units, where pictures show several: 3 deg, or 5 mm
at 100 mm. Farther off lie other instruments, and halves and shadows of shafts."""


def read_prior(config: CalibrationConfig) -> RigidTransform | None:
    """The prior, if there is one: to be read before any picture is, as mistakes should be told at once.

    Raises:
        FileError, InputError: `config.prior` holds no transform.
    """
    return None if config.prior is None else read_reference(Path(config.prior)).camera_right_T_arm


def first_choices(
    recording: Recording,
    config: CalibrationConfig,
    poses: MotionPoses,
    detections: tuple[ShaftDetections, ...],
    instruments: list[tuple[Choice, ...]],
    prior: RigidTransform | None,
) -> list[tuple[Choice, ...]]:
    """Candidates to solve with at first, one entry an attempt: as a prior or `config.instrument_at` has it; else the
    surest ones and, where pictures show several instruments, each of these.

    Args:
        recording: for the cameras.
        config: what is known beforehand.
        poses: kinematics of the motions.
        detections: of the motions, one entry a camera.
        instruments: from `choices_by_instrument`.
        prior: from `read_prior`.
    Raises:
        InputError: there is no shaft where `config.instrument_at` points, or not enough of it to tell which one it is.
    """
    if prior is not None:
        return [_near_prior(recording, prior, poses, detections, several=bool(instruments))]
    surest = tuple(first_choice(found) for found in detections)
    if config.instrument_at is None:
        others = [choices for choices in instruments if not all(map(Choice.same_as, choices, surest))]
        return [surest, *others]
    frame, u, v = config.instrument_at
    motion = np.flatnonzero(poses.frames == frame)
    xy, _ = recording.stereo.right.undistort_points(torch.tensor([u, v], dtype=torch.float64))
    shown = pointed_at(select_frames(detections[0], motion), xy) if len(motion) else -1
    if shown < 0:
        found = f"none there in frame {frame}"
        raise InputError(
            where="instrument_at", expected="a point on a shaft that is detected (see `detect`)", found=found
        )
    if not instruments:
        return [surest]
    own = [choices for choices in instruments if int(choices[0].candidate[motion[0]]) == shown]
    if not own:
        expected = "a shaft that enters the picture, its tip's side in view"
        raise InputError(where="instrument_at", expected=expected, found=f"another strip in frame {frame}")
    return own


def _near_prior(
    recording: Recording,
    prior: RigidTransform,
    poses: MotionPoses,
    detections: tuple[ShaftDetections, ...],
    several: bool,
) -> tuple[Choice, ...]:
    """The candidates nearest to where a prior puts the shaft."""
    camera_T_arm = [prior.matrix]
    extrinsics = recording.stereo.camera_left_T_camera_right
    if extrinsics is not None and len(detections) == 2:
        camera_T_arm.append(extrinsics.matrix @ camera_T_arm[0])
    reach = _PRIOR_REACH if several else torch.inf
    radius_mm = recording.shaft_diameter_mm / 2
    return tuple(
        consistent_choice(found, predict_contours(matrix.to(poses.arm_T_rcm), poses, radius_mm), reach)
        for found, matrix in zip(detections, camera_T_arm, strict=True)
    )
