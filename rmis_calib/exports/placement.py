"""Where both arms stood at one frame of the recording, with the offsets that the calibration found."""

from dataclasses import dataclass

import numpy as np
import torch
from jaxtyping import Float

from rmis_calib.errors import InputError
from rmis_calib.exports.hand_eye import in_metres, rigid_inverse
from rmis_calib.geometry.cameras import StereoRig
from rmis_calib.io import Recording
from rmis_calib.io.recording import log_times_s
from rmis_calib.kinematics import RobotKinematics
from rmis_calib.results import CalibrationResult, KinematicOffsets
from rmis_calib.robot import Robot


@dataclass(frozen=True, eq=False)
class Placement:
    """Arms and cameras of a recording at one frame; m."""

    frame: int
    base_T_arm: Float[np.ndarray, "4 4"] | None
    """None where the camera stands still, and `arm` is `base`."""
    base_T_laparoscope_base: Float[np.ndarray, "4 4"] | None
    base_T_instrument_base: Float[np.ndarray, "4 4"]
    stereo: StereoRig
    """As the calibration corrected it."""
    clock_offset_s: float
    """Of the recording: joint time = frame time + this, beside what the calibration found."""

    def arm_T_instrument_base(self) -> Float[np.ndarray, "4 4"]:
        """Base of the instrument's arm in `arm`."""
        if self.base_T_arm is None:
            return self.base_T_instrument_base  # frames: base = arm
        return rigid_inverse(self.base_T_arm) @ self.base_T_instrument_base

    def laparoscope_base_T_arm(self) -> Float[np.ndarray, "4 4"] | None:
        """The laparoscope's arm on its own base, as the dVRK's `local/measured_cp`; None where it stands still."""
        if self.base_T_arm is None or self.base_T_laparoscope_base is None:
            return None
        return rigid_inverse(self.base_T_laparoscope_base) @ self.base_T_arm


def placement(recording: Recording, result: CalibrationResult, frame: int | None) -> Placement:
    """Both arms at a frame; the last one whose joints are known where none is named.

    Raises:
        InputError: the recording has no such frame, or its joints are not known.
    """
    offsets = result.kinematic_offsets
    arm, instrument = None if offsets.arm_is_instrument_base else recording.laparoscope_arm, recording.instrument_arm
    columns = () if arm is None else recording.robot.columns(arm)
    times_s = log_times_s(recording.joint_times_s, recording.middle_s, *offsets.clock)
    readings, known = recording.joints.select(columns).at(times_s) if columns else (np.empty((len(times_s), 0)), None)
    usable = np.arange(len(times_s)) if known is None else np.flatnonzero(known)
    if frame is None and len(usable):
        frame = int(usable[-1])
    if frame is None or frame not in usable:
        expected = f"a frame with known joints (0 to {len(times_s) - 1})"
        raise InputError(where="frame", expected=expected, found="none" if frame is None else frame)
    base_T_arm = None
    if arm is not None:
        kinematics = RobotKinematics(recording.robot, arm, instrument)
        offset = np.array([offsets.joints.get(column, 0.0) for column in columns])
        base_T_arm = in_metres(kinematics.base_T_arm(torch.as_tensor(readings[frame] + offset)).numpy())
    base_T_laparoscope_base, base_T_instrument_base = _bases(recording.robot, arm, instrument, offsets)
    return Placement(
        frame=frame,
        base_T_arm=base_T_arm,
        base_T_laparoscope_base=None if base_T_laparoscope_base is None else in_metres(base_T_laparoscope_base),
        base_T_instrument_base=in_metres(base_T_instrument_base),
        stereo=_as_corrected(recording.stereo, result),
        clock_offset_s=recording.clock_offset_s,
    )


def _bases(
    robot: Robot, arm: str | None, instrument: str, offsets: KinematicOffsets
) -> tuple[Float[np.ndarray, "4 4"] | None, Float[np.ndarray, "4 4"]]:
    """Both arms' bases, mm: as stated, but the instrument's where the calibration found it; `base` is the laparoscope's
    arm's own, or the instrument's where there is none, where nobody states them."""
    stated = [None if name is None else robot.arms[name].base_T_arm_base for name in (arm, instrument)]
    if offsets.arm_is_instrument_base or (arm is not None and any(base is None for base in stated)):
        stated = [None, None]
    of_arm, of_instrument = (np.eye(4) if base is None else np.asarray(base) for base in stated)
    if arm is None:
        return None, of_instrument
    return of_arm, of_instrument if offsets.setup is None else of_arm @ offsets.setup.matrix.numpy()


def _as_corrected(stereo: StereoRig, result: CalibrationResult) -> StereoRig:
    """The cameras that the transform belongs to."""
    right = stereo.right.corrected(*result.intrinsic_correction("right"))
    if stereo.left is None or result.camera_left_T_camera_right is None:
        return StereoRig(right)
    left = stereo.left.corrected(*result.intrinsic_correction("left"))
    return StereoRig(right, left, result.camera_left_T_camera_right)
