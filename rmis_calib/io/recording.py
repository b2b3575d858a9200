"""A recording folder: stereo video, joint log, cameras and robot, read strictly (docs/recording.md)."""

from dataclasses import dataclass
from pathlib import Path

import numpy as np
import torch
from jaxtyping import Bool, Float

from rmis_calib.geometry.cameras import Camera, StereoRig
from rmis_calib.geometry.rigid import RigidTransform
from rmis_calib.io.description import RecordingDescription, read_description
from rmis_calib.io.intrinsics import Intrinsics, StereoFile
from rmis_calib.io.joints import JointLog
from rmis_calib.io.tables import HeadPoints
from rmis_calib.io.video import FrameSource
from rmis_calib.robot import Robot


@dataclass(frozen=True, eq=False)
class Recording:
    """What a calibration reads. Millimetres, radians, pixels, seconds."""

    path: Path
    robot: Robot
    stereo: StereoRig
    """float64; of the pictures as the files show them, crops applied."""
    right: FrameSource
    left: FrameSource | None
    """None for one camera."""
    joints: JointLog
    """The joints of the arms in use."""
    frame_times_s: np.ndarray
    """(N,), increasing, on the clock of the video."""
    laparoscope_arm: str | None
    """None: the camera stands still, and the frame `arm` is `base`."""
    instrument_arm: str
    shaft_diameter_mm: float
    clock_offset_s: float
    """Joint time = frame time + this."""
    head_points: HeadPoints | None
    notes: tuple[str, ...] = ()
    """What was guessed or mended while the files were read, a sentence each."""
    rolling_shutter_s: float = 0.0
    """Time from reading the first row of a picture, which is the frame's time, to reading the last."""

    @property
    def n_frames(self) -> int:
        """Number of frames of each camera."""
        return len(self.frame_times_s)

    @property
    def joint_times_s(self) -> Float[np.ndarray, " n"]:
        """When the middle row of each frame was read, on the clock of the joint log as far as the recording tells."""
        return self.frame_times_s + self.clock_offset_s + 0.5 * self.rolling_shutter_s

    @property
    def middle_s(self) -> float:
        """Middle of `joint_times_s`: where the rate of a clock does nothing."""
        times_s = self.joint_times_s
        return 0.5 * float(times_s[0] + times_s[-1]) if len(times_s) else 0.0

    def joints_at_frames(self, arm: str | None) -> tuple[Float[np.ndarray, "n j"], Bool[np.ndarray, " n"]]:
        """Readings of an arm at each frame, rad and mm in the order of its joints, and where the log knows them.

        Args:
            arm: `laparoscope_arm` or `instrument_arm`; None, an arm that is not there, has no joints and is valid.

        Raises:
            RobotError: the robot has no such arm.
            RecordingError: the log does not hold it.
        """
        if arm is None:
            return np.empty((self.n_frames, 0)), np.ones(self.n_frames, dtype=bool)
        return self.joints.select(self.robot.columns(arm)).at(self.joint_times_s)


def log_times_s(
    joint_times_s: Float[np.ndarray, "*n"], middle_s: float, offset_s: float | np.ndarray, rate: float | np.ndarray
) -> Float[np.ndarray, "*m"]:
    """Times on the clock of the joint log, with what a calibration found to be off in it.

    Args:
        joint_times_s: as the recording tells (`Recording.joint_times_s`).
        middle_s: `Recording.middle_s`.
        offset_s: added everywhere.
        rate: added a second from the middle of the recording.
    """
    return joint_times_s + offset_s + rate * (joint_times_s - middle_s)


def load_recording(path: str | Path | RecordingDescription, clock_offset_s: float | None = None) -> Recording:
    """Read a recording folder. Videos are opened and counted, not decoded.

    Args:
        path: the folder, or its recording.yaml; or what `read_description` has already read of it.
        clock_offset_s: in place of what recording.yaml says; joint time = frame time + this.

    Raises:
        FileError: a file is absent or unreadable.
        VideoError: a video is truncated, or of another length or size than promised.
        RecordingError, RobotError: an entry is missing, unknown, not finite, out of range or in another unit. Each
            names file, line or key, expected and found.
    """
    read = path if isinstance(path, RecordingDescription) else read_description(path, clock_offset_s)
    return Recording(
        read.path, read.robot, camera_rig(read.stereo), FrameSource(read.right),
        None if read.left is None else FrameSource(read.left), read.joints, read.frame_times_s, read.laparoscope_arm,
        read.instrument_arm, read.shaft_diameter_mm, read.clock_offset_s, read.head_points, read.notes,
        read.rolling_shutter_s,
    )  # fmt: skip


def camera_rig(stereo: StereoFile) -> StereoRig:
    """The cameras of a file as tensors, float64."""
    if stereo.left is None or stereo.camera_left_T_camera_right is None:
        return StereoRig(_camera(stereo.right))
    matrix = torch.from_numpy(stereo.camera_left_T_camera_right)
    extrinsics = RigidTransform("camera_left", "camera_right", matrix)
    return StereoRig(_camera(stereo.right), _camera(stereo.left), extrinsics)


def _camera(values: Intrinsics) -> Camera:
    distortion = list(values.distortion)
    numbers = (values.fx, values.fy, values.cx, values.cy)
    return Camera.from_values(*numbers, distortion, image_size=values.image_size, model=values.model)
