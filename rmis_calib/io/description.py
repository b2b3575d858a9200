"""All of a recording folder that needs no torch: every text file read and checked, every video opened and counted.

Most mistakes are found here, so that they are told before anything heavy is imported.
"""

from dataclasses import dataclass
from pathlib import Path

import numpy as np

from rmis_calib.errors import InputError, RecordingError, RobotError, VideoError
from rmis_calib.io._checks import Note
from rmis_calib.io._eyes import EyeReader
from rmis_calib.io._schemas import CameraPairSchema, RecordingSchema
from rmis_calib.io.clocks import check_overlap, on_one_clock
from rmis_calib.io.configs import load_yaml
from rmis_calib.io.folders import DESCRIPTION, recording_folder
from rmis_calib.io.intrinsics import Intrinsics, StereoFile
from rmis_calib.io.joints import JointLog, load_joints
from rmis_calib.io.readers import Reader, open_reader
from rmis_calib.io.robot import load_robot
from rmis_calib.io.stereo import read_camera_pair, read_stereo
from rmis_calib.io.tables import HeadPoints, read_frame_times, read_head_points
from rmis_calib.io.validation import validate
from rmis_calib.robot import Robot

# Images of a stereo pair that are further apart than this part of a frame interval do not show one instant.
_STEREO_SLACK = 0.5


@dataclass(frozen=True, eq=False)
class RecordingDescription:
    """A recording folder, read and checked. Millimetres, radians, pixels, seconds."""

    path: Path
    robot: Robot
    stereo: StereoFile
    """Of the pictures as the files show them, crops applied; no left camera where there are no left pictures."""
    right: Reader
    left: Reader | None
    joints: JointLog
    frame_times_s: np.ndarray
    laparoscope_arm: str | None
    instrument_arm: str
    shaft_diameter_mm: float
    clock_offset_s: float
    head_points: HeadPoints | None
    notes: tuple[str, ...]
    rolling_shutter_s: float
    inputs: tuple[Path, ...]
    """The folder, and every file that it names."""


def read_description(path: str | Path, clock_offset_s: float | None = None) -> RecordingDescription:
    """Read all text files of a recording, and open its videos.

    Args:
        path: the folder, or its recording.yaml.
        clock_offset_s: in place of what recording.yaml says.

    Raises:
        FileError, VideoError, RecordingError, RobotError, InputError: as `load_recording`.
    """
    folder = recording_folder(path)
    where = folder / DESCRIPTION
    schema = validate(RecordingSchema, load_yaml(where, RecordingError), str(where), RecordingError)
    offset = schema.clock_offset_s if clock_offset_s is None else clock_offset_s
    if not np.isfinite(offset):
        raise InputError(where="clock_offset_s", expected="a finite number of seconds", found=offset)
    notes = list(schema.notes)
    robot = _load_robot(schema, folder, notes.append)
    stereo = _cameras(schema, _read_cameras(schema, folder, notes.append), where)
    arms = tuple(arm for arm in (schema.laparoscope_arm, schema.instrument_arm) if arm is not None)
    joints = load_joints(folder / schema.joints, robot, arms, notes.append)
    listed_s = None if schema.frame_times is None else read_frame_times(folder / schema.frame_times)
    right, left = _open_cameras(schema, folder, stereo, None if listed_s is None else len(listed_s))
    frame_times_s = _frame_times(schema, folder, right, left, listed_s)
    notes += [note for reader in (right, left) if reader is not None for note in reader.notes if note not in notes]
    frame_times_s, joints = on_one_clock(frame_times_s, joints, offset, folder / schema.joints, notes.append)
    check_overlap(joints, frame_times_s, offset, folder / schema.joints)
    head_path = folder / "head_points.csv"
    size = stereo.right.image_size
    heads = read_head_points(head_path, len(frame_times_s), size, left is not None) if head_path.exists() else None
    named = (schema.robot, *schema.stereo_files, schema.joints, schema.right, schema.left, schema.frame_times)
    inputs = (folder, *(folder / name for name in named if name is not None and (folder / name).exists()))
    return RecordingDescription(
        folder, robot, stereo, right, left, joints, frame_times_s, schema.laparoscope_arm, schema.instrument_arm,
        schema.shaft_diameter_mm, float(offset), heads, tuple(notes), schema.rolling_shutter_s, inputs,
    )  # fmt: skip


def _load_robot(schema: RecordingSchema, folder: Path, note: Note) -> Robot:
    """The robot, a preset or a file of the folder, with the arms that the recording names."""
    is_file = Path(schema.robot).suffix.lower() in (".yaml", ".yml")
    robot = load_robot(folder / schema.robot if is_file else schema.robot, note)
    where = f"{folder / DESCRIPTION}"
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


def _read_cameras(schema: RecordingSchema, folder: Path, note: Note) -> StereoFile:
    """What `stereo` names, of whichever program."""
    if isinstance(schema.stereo, CameraPairSchema):
        return read_camera_pair(folder / schema.stereo.right, folder / schema.stereo.left, note)

    def picture_size() -> tuple[int, int]:
        if schema.crop_right is not None or schema.crop_left is not None:
            expected = f"an image size in {schema.stereo}, since the pictures are crops"
            raise RecordingError(where=f"{folder / DESCRIPTION}: crop_right", expected=expected, found="none")
        whole = open_reader(folder / schema.right)
        return (
            whole.size if schema.stereo_layout is None else EyeReader(whole, "right", schema.stereo_layout, False).size
        )

    return read_stereo(folder / schema.stereo, note, picture_size)


def _cameras(schema: RecordingSchema, stereo: StereoFile, where: Path) -> StereoFile:
    """The cameras that the recording has pictures of, cut to the part that these show."""
    if schema.is_stereo != (stereo.left is not None):
        has_pictures, files = stereo.left is None, " and ".join(schema.stereo_files)
        expected = f"a left camera in {files}" if has_pictures else f"left, for the left camera in {files}"
        found = f"none for {schema.left or schema.stereo_layout}" if has_pictures else "no left video"
        raise RecordingError(where=f"{where}: left", expected=expected, found=found)
    right = stereo.right.cropped(schema.crop_right, f"{where}: crop_right")
    left = None if stereo.left is None else stereo.left.cropped(schema.crop_left, f"{where}: crop_left")
    return StereoFile(right, left, stereo.camera_left_T_camera_right)


def _open_cameras(
    schema: RecordingSchema, folder: Path, stereo: StereoFile, count: int | None
) -> tuple[Reader, Reader | None]:
    whole = open_reader(folder / schema.right, count)
    right, left = whole, None
    if schema.stereo_layout is not None:
        right = EyeReader(whole, "right", schema.stereo_layout, schema.swapped)
        left = EyeReader(whole, "left", schema.stereo_layout, schema.swapped)
    elif schema.left is not None:
        left = open_reader(folder / schema.left, count)
    _check_size(right, stereo.right, schema, "right")
    if left is not None and stereo.left is not None:
        _check_size(left, stereo.left, schema, "left")
    return right, left


def _check_size(reader: Reader, camera: Intrinsics, schema: RecordingSchema, side: str) -> None:
    """Refuse pictures of another size than the camera's, with what is most likely to be the matter."""
    (height, width), (found_height, found_width) = camera.image_size, reader.size
    if reader.size == camera.image_size:
        return
    found = f"{found_width} x {found_height}"
    if reader.size == (width, height):
        found += " (image_size is [width, height])"
    elif schema.stereo_layout is None and reader.size == (height, 2 * width):
        found += ": both eyes side by side? then write stereo_layout: side_by_side in recording.yaml, and no left"
    elif schema.stereo_layout is None and reader.size == (2 * height, width):
        found += ": both eyes one above the other? then write stereo_layout: top_bottom in recording.yaml, and no left"
    elif found_width * height == found_height * width:
        new = camera.scaled(found_width / width)
        found += (
            f": the same shape at {found_width / width:g} times the size. If the pictures are resized ones, write "
            f"image_size: [{found_width}, {found_height}] and, for {side}, fx: {new.fx:.6g}, fy: {new.fy:.6g}, "
            f"cx: {new.cx:.6g}, cy: {new.cy:.6g} in {schema.stereo_files[0]}"
        )
    elif found_width <= width and found_height <= height:
        found += f": a part of it? then write crop_{side}: [u, v, {found_width}, {found_height}] in recording.yaml"
    raise VideoError(
        where=str(reader.path), expected=f"frames of {width} x {height} px as in {schema.stereo_files[0]}", found=found
    )


def _frame_times(
    schema: RecordingSchema, folder: Path, right: Reader, left: Reader | None, listed_s: np.ndarray | None
) -> np.ndarray:
    """Time of each frame: as listed in frame_times.csv, else from the right video."""
    if left is not None and left.count != right.count:
        expected = f"{right.count} frames as {schema.right} has"
        raise VideoError(where=str(left.path), expected=expected, found=f"{left.count} frames")
    if listed_s is not None:
        if len(listed_s) != right.count:
            expected = f"{len(listed_s)} frames as {schema.frame_times} has"
            raise VideoError(where=str(right.path), expected=expected, found=f"{right.count} frames")
        return listed_s
    right_s, left_s = right.times_s, None if left is None else left.times_s
    if right_s is None:
        where = f"{folder / DESCRIPTION}: frame_times"
        expected = f"a file with the time of each frame of {schema.right}"
        raise RecordingError(where=where, expected=expected, found="none")
    if left is not None and left_s is not None and right.count > 1:
        apart_s = np.abs(left_s - right_s).max()
        if apart_s > _STEREO_SLACK * np.median(np.diff(right_s)):
            expected = f"the frame times of {schema.right}, or a frame_times file"
            raise VideoError(where=str(left.path), expected=expected, found=f"a difference of {apart_s:.3g} s")
    return right_s
