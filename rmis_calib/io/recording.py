"""A recording folder: stereo video, joint log, cameras and robot, read strictly (DESIGN.md 6.1)."""

from dataclasses import dataclass
from pathlib import Path

import numpy as np
from jaxtyping import Bool, Float

from rmis_calib.errors import FileError, InputError, RecordingError, RobotError, VideoError
from rmis_calib.geometry.cameras import Camera, StereoRig
from rmis_calib.io._schemas import RecordingSchema
from rmis_calib.io._validation import validate
from rmis_calib.io.configs import load_yaml
from rmis_calib.io.joints import JointLog, load_joints
from rmis_calib.io.robot import Robot, load_robot
from rmis_calib.io.stereo import load_stereo
from rmis_calib.io.tables import HeadPoints, read_frame_times, read_head_points
from rmis_calib.io.video import FrameSource, open_source

# Images of a stereo pair that are further apart than this part of a frame interval do not show one instant.
_STEREO_SLACK = 0.5


@dataclass(frozen=True, eq=False)
class Recording:
    """What a calibration reads. Millimetres, radians, pixels, seconds."""

    path: Path
    robot: Robot
    stereo: StereoRig
    """float64."""
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

    @property
    def n_frames(self) -> int:
        """Number of frames of each camera."""
        return len(self.frame_times_s)

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
        return self.joints.select(self.robot.columns(arm)).at(self.frame_times_s + self.clock_offset_s)


def load_recording(path: str | Path, clock_offset_s: float | None = None) -> Recording:
    """Read a recording folder. Videos are opened and counted, not decoded.

    Args:
        path: the folder, or its recording.yaml.
        clock_offset_s: in place of what recording.yaml says; joint time = frame time + this.

    Raises:
        FileError: a file is absent or unreadable.
        VideoError: a video is truncated, or of another length or size than promised.
        RecordingError, RobotError: an entry is missing, unknown, not finite, out of range or in another unit. Each
            names file, line or key, expected and found.
    """
    path = Path(path)
    folder = path.parent if path.name == "recording.yaml" else path
    if not folder.is_dir():
        raise FileError(where=str(folder), expected="a recording folder", found="nothing there")
    where = folder / "recording.yaml"
    schema = validate(RecordingSchema, load_yaml(where, RecordingError), str(where), RecordingError)
    offset = schema.clock_offset_s if clock_offset_s is None else clock_offset_s
    if not np.isfinite(offset):
        raise InputError(where="clock_offset_s", expected="a finite number of seconds", found=offset)

    notes: list[str] = []
    robot = _load_robot(schema, folder)
    stereo = load_stereo(folder / schema.stereo, notes.append)
    _check_cameras(schema, stereo, where)
    arms = tuple(arm for arm in (schema.laparoscope_arm, schema.instrument_arm) if arm is not None)
    joints = load_joints(folder / schema.joints, robot, arms, notes.append)
    right = _open_camera(folder / schema.right, stereo.right)
    left = None if schema.left is None or stereo.left is None else _open_camera(folder / schema.left, stereo.left)
    frame_times_s = _frame_times(schema, folder, right, left)
    _check_overlap(joints, frame_times_s + offset, folder / schema.joints)
    head_path = folder / "head_points.csv"
    size = stereo.right.image_size
    heads = read_head_points(head_path, len(frame_times_s), size, left is not None) if head_path.exists() else None
    return Recording(
        folder, robot, stereo, right, left, joints, frame_times_s, schema.laparoscope_arm, schema.instrument_arm,
        schema.shaft_diameter_mm, float(offset), heads, tuple(notes),
    )  # fmt: skip


def _load_robot(schema: RecordingSchema, folder: Path) -> Robot:
    """The robot, a preset or a file of the folder, with the arms that the recording names."""
    is_file = Path(schema.robot).suffix.lower() in (".yaml", ".yml")
    robot = load_robot(folder / schema.robot if is_file else schema.robot)
    where = f"{folder / 'recording.yaml'}"
    for key, arm in (("laparoscope_arm", schema.laparoscope_arm), ("instrument_arm", schema.instrument_arm)):
        if arm is not None and arm not in robot.arms:
            expected = f"an arm of robot {robot.name} ({', '.join(robot.arms)})"
            raise RecordingError(where=f"{where}: {key}", expected=expected, found=arm)
    if not robot.arms[schema.instrument_arm].is_instrument:
        raise RobotError(
            where=f"{schema.robot}: arms.{schema.instrument_arm}",
            expected="rcm_frame, shaft_frame and head_point of an instrument arm",
            found="none of them",
        )
    return robot


def _check_cameras(schema: RecordingSchema, stereo: StereoRig, where: Path) -> None:
    if (schema.left is None) != (stereo.left is None):
        has_video = stereo.left is None
        expected = f"a left camera in {schema.stereo}" if has_video else f"left, for the left camera in {schema.stereo}"
        found = f"none for {schema.left}" if has_video else "no left video"
        raise RecordingError(where=f"{where}: left", expected=expected, found=found)


def _open_camera(path: Path, camera: Camera) -> FrameSource:
    source = open_source(path)
    if source.size != camera.image_size:
        height, width = camera.image_size
        is_swapped = source.size == (width, height)
        found = f"{source.size[1]} x {source.size[0]}" + (" (image_size is [width, height])" if is_swapped else "")
        raise VideoError(where=str(path), expected=f"frames of {width} x {height} px as in stereo.yaml", found=found)
    return source


def _frame_times(schema: RecordingSchema, folder: Path, right: FrameSource, left: FrameSource | None) -> np.ndarray:
    """Time of each frame: from frame_times.csv, else from the right video."""
    if left is not None and left.count != right.count:
        expected = f"{right.count} frames as {schema.right} has"
        raise VideoError(where=str(left.path), expected=expected, found=f"{left.count} frames")
    if schema.frame_times is not None:
        times_s = read_frame_times(folder / schema.frame_times)
        if len(times_s) != right.count:
            expected = f"{len(times_s)} frames as {schema.frame_times} has"
            raise VideoError(where=str(right.path), expected=expected, found=f"{right.count} frames")
        return times_s
    if right.times_s is None:
        where = f"{folder / 'recording.yaml'}: frame_times"
        expected = f"a file with the time of each frame of {schema.right}"
        raise RecordingError(where=where, expected=expected, found="none")
    if left is not None and left.times_s is not None and right.count > 1:
        apart_s = np.abs(left.times_s - right.times_s).max()
        if apart_s > _STEREO_SLACK * np.median(np.diff(right.times_s)):
            expected = f"the frame times of {schema.right}, or a frame_times file"
            raise VideoError(where=str(left.path), expected=expected, found=f"a difference of {apart_s:.3g} s")
    return right.times_s


def _check_overlap(joints: JointLog, times_s: np.ndarray, where: Path) -> None:
    """Frames outside the log are data; no frame inside it is a wrong clock offset."""
    first, last = joints.timestamps_s[[0, -1]]
    if not joints.at(times_s)[1].any():
        expected = f"joints at the time of some frame ({times_s[0]:.6g} to {times_s[-1]:.6g} s, clock_offset_s added)"
        found = f"samples from {first:.6g} to {last:.6g} s, none close enough to one"
        raise RecordingError(where=str(where), expected=expected, found=found)
