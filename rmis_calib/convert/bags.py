"""ROS1 bags, ROS2 bags (sqlite3, mcap) and bare files of them, by rosbags: read once, in bounded memory."""

from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import numpy as np

from rmis_calib.convert.eye_pairs import EyePairs
from rmis_calib.convert.joints import NEEDS_ROBOT, NO_POSES
from rmis_calib.convert.material import NEEDS_STEREO, ArmLog, Job, Logs, Material
from rmis_calib.convert.messages import camera_info_of, stamp_ns
from rmis_calib.convert.salvage import can_salvage, salvaged
from rmis_calib.convert.settings import STILL, ConvertSettings
from rmis_calib.convert.topic_logs import TopicLogs
from rmis_calib.convert.topics import Choice, Topic, choose_topics, describe
from rmis_calib.errors import FileError, RecordingError
from rmis_calib.io._camera_formats.camera_info import CameraInfo, mono_of_info, pair_of_infos
from rmis_calib.io._checks import Note
from rmis_calib.io.intrinsics import StereoFile

_INSTALL = "the package rosbags (pip install 'rmis-calib[bags]')"
_CLOCKS_APART_S = 0.5
BAGS = (".bag", ".mcap", ".db3")


class Bag:
    """A bag that can be read: topics, and messages as objects."""

    def __init__(self, reader: Any, topics: list[Topic], count: int, messages: Any) -> None:
        self._reader, self.topics, self.count, self._messages = reader, topics, count, messages

    def read(self, names: set[str]) -> Iterator[tuple[str, int, Any]]:
        """(topic, received ns, message) of some topics in the order of the bag."""
        yield from self._messages(names)


@contextmanager
def open_bag(path: Path, salvage: bool, note: Note) -> Iterator[Bag]:
    """A bag as it is, or what is whole of it.

    Raises:
        FileError: it is damaged, and `salvage` is false; or rosbags is not installed.
    """
    try:
        from rosbags.highlevel import AnyReader
        from rosbags.typesys import Stores, get_typestore
    except ImportError as problem:
        raise FileError(where=str(path), expected=_INSTALL, found="nothing") from problem
    store = get_typestore(Stores.ROS2_JAZZY)
    reader = None
    try:
        reader = AnyReader(_files(path), default_typestore=store)
        reader.open()
    except _damage() as problem:
        if not salvage:
            raise FileError(where=str(path), expected=_whole_bag(path), found=_first_line(problem)) from problem
        note(f"{path.name} is damaged ({_first_line(problem)}): what is whole of it was read")
        with salvaged(path) as (topics, messages):
            yield Bag(None, topics, sum(topic.count for topic in topics), messages)
        return
    try:
        yield _whole(reader, path, salvage, note)
    finally:
        reader.close()


def _files(path: Path) -> list[Path]:
    """What rosbags opens: a file, a ROS2 folder, or the files of a folder that a recorder split or left unfinished."""
    if not path.is_dir() or (path / "metadata.yaml").is_file():
        return [path]
    return sorted(file for file in path.iterdir() if file.suffix in BAGS) or [path]


def _whole(reader: Any, path: Path, salvage: bool, note: Note) -> Bag:
    counts: dict[tuple[str, str], int] = {}
    for connection in reader.connections:
        key = (connection.topic, connection.msgtype)
        counts[key] = counts.get(key, 0) + connection.msgcount
    topics = [Topic(name, kind, count) for (name, kind), count in counts.items()]

    def messages(names: set[str]) -> Iterator[tuple[str, int, Any]]:
        connections = [connection for connection in reader.connections if connection.topic in names]
        if not connections:
            return
        try:
            for connection, received_ns, raw in reader.messages(connections=connections):
                yield connection.topic, received_ns, reader.deserialize(raw, connection.msgtype)
        except _damage() as problem:
            if not salvage:
                raise FileError(where=str(path), expected=_whole_bag(path), found=_first_line(problem)) from problem
            note(f"{path.name} breaks off ({_first_line(problem)}): what was read until there is used")

    return Bag(reader, topics, sum(topic.count for topic in topics), messages)


def _damage() -> tuple[type[Exception], ...]:
    """What rosbags raises on damage: its own errors, and those of lz4, bz2, zstd, sqlite and struct as they are."""
    import struct

    import apsw
    from rosbags.highlevel import AnyReaderError
    from rosbags.rosbag1 import ReaderError as Reader1Error
    from rosbags.rosbag2 import ReaderError as Reader2Error

    own = (AnyReaderError, Reader1Error, Reader2Error)
    return (*own, apsw.Error, struct.error, ValueError, KeyError, RuntimeError, OSError, EOFError, AssertionError)


def _whole_bag(path: Path) -> str:
    """What was expected, and salvage only where it can help."""
    if can_salvage(path):
        return "a whole bag (--salvage converts what is whole of it)"
    return "a bag with an intact part"


def _first_line(problem: Exception) -> str:
    return (str(problem).splitlines() or [type(problem).__name__])[0][:200] or type(problem).__name__


def convert_bag(job: Job, settings: ConvertSettings) -> Material:
    """All of a recording from one bag.

    Raises:
        FileError: it is damaged.
        RecordingError: it has no pictures, no measured joints or poses, or pictures of an unknown kind.
    """
    with open_bag(job.source, settings.salvage, job.note) as bag:
        where = str(job.source)
        choice = choose_topics(bag.topics, settings, job.note, where)
        if not choice.joints and not choice.poses:
            expected = "measured_js or measured_cp of an instrument's arm"
            raise RecordingError(where=where, expected=expected, found=describe(bag.topics))
        if choice.right is None:
            expected = (
                "pictures (sensor_msgs Image or CompressedImage): a calibration needs the cameras' view of the shaft"
            )
            raise RecordingError(where=where, expected=expected, found=describe(bag.topics))
        _check_before_reading(choice, settings, where)
        return _read(bag, choice, job, settings)


def _check_before_reading(choice: Choice, settings: ConvertSettings, where: str) -> None:
    """What would be missing at the end, before gigabytes are read."""
    needed = {"right", "left"} if choice.left is not None else {"right"}
    if settings.stereo is None and not needed <= set(choice.infos):
        raise RecordingError(
            where=where, expected=NEEDS_STEREO, found="no camera_info of " + " and ".join(sorted(needed))
        )
    if settings.robot is None and not set(choice.joints) & set(choice.poses):
        raise RecordingError(where=where, expected=NEEDS_ROBOT, found=NO_POSES)
    arms = [*choice.joints, *(arm for arm in choice.poses if arm not in choice.joints)]
    for name in (settings.instrument, settings.laparoscope):
        if name not in (None, *STILL, *arms):
            raise RecordingError(where=where, expected=f"a log of {name}", found=", ".join(arms))


def read_logs(path: Path, settings: ConvertSettings, note: Note) -> tuple[Logs, dict[str, CameraInfo]]:
    """Only the arms and the cameras of a bag, for pictures that lie beside it."""
    with open_bag(path, settings.salvage, note) as bag:
        choice = choose_topics([t for t in bag.topics if "Image" not in t.type], settings, note, str(path))
        infos = {t.name: t for t in bag.topics if t.type.endswith("CameraInfo")}
        logs, found = TopicLogs(choice), {}
        for topic, received_ns, message in bag.read(logs.topics | set(infos)):
            if topic in infos:
                side = "right" if "right" in topic else "left" if "left" in topic else "right"
                found.setdefault(side, camera_info_of(message, topic))
            else:
                logs.add(topic, received_ns, message)
        return logs.logs, found


def _read(bag: Bag, choice: Choice, job: Job, settings: ConvertSettings) -> Material:
    assert choice.right is not None
    logs, infos = TopicLogs(choice), {}
    pairs = EyePairs(job, choice.right, choice.left)
    sides = {topic.name: side for side, topic in choice.infos.items()}
    pictures = {topic.name for topic in (choice.right, choice.left) if topic is not None}
    names = logs.topics | set(sides) | pictures
    total = sum(topic.count for topic in bag.topics if topic.name in names)
    for done, (topic, received_ns, message) in enumerate(bag.read(names), start=1):
        if topic in pictures:
            pairs.add(topic, stamp_ns(message, received_ns), message)
        elif topic in sides:
            infos.setdefault(sides[topic], camera_info_of(message, topic))
        else:
            logs.add(topic, received_ns, message)
        job.progress("reading the bag", min(done, total), total)
    frame_ns = pairs.finish()
    _check_clocks(frame_ns, logs.logs.arms, job.note)
    rectified = settings.rectified
    if rectified is None:
        rectified = "rect" in choice.right.name
        if infos:
            kind = "rectified: their camera is P" if rectified else "raw: their camera is K and D"
            job.note(f"pictures of {choice.right.name} were taken for {kind} (by the topic's name)")
    layout = _layout(pairs.size, infos, choice.left is None)
    if layout is not None:
        job.note("pictures are twice as wide as their camera_info: both eyes side by side, the left one on the left")
    cameras = cameras_of(infos, choice.left is not None or layout is not None, rectified, job.note)
    left = "left" if choice.left is not None else None
    return Material(logs.logs.with_content(), cameras, frame_ns, "right", left, layout)


def cameras_of(infos: dict[str, CameraInfo], is_stereo: bool, rectified: bool, note: Note) -> StereoFile | None:
    """The rig of a bag's camera_info; None where it has too few."""
    if is_stereo:
        return pair_of_infos(infos["left"], infos["right"], rectified, note) if len(infos) == 2 else None
    info = infos.get("right") or infos.get("left")
    return None if info is None else mono_of_info(info, rectified, note)


def _layout(size: tuple[int, int] | None, infos: dict[str, CameraInfo], is_one: bool) -> Any:
    info = infos.get("right") or infos.get("left")
    if not is_one or size is None or info is None:
        return None
    height, width = info.size
    return "side_by_side" if size == (height, 2 * width) else None


def _check_clocks(frame_ns: np.ndarray, arms: dict[str, ArmLog], note: Note) -> None:
    for log in arms.values():
        stamps = log.joint_ns or log.pose_ns
        if not stamps:
            continue
        apart = max(stamps[0] - int(frame_ns[-1]), int(frame_ns[0]) - stamps[-1]) / 1e9
        if apart > _CLOCKS_APART_S:
            note(
                f"stamps of {log.name} and of the pictures do not overlap: they are {apart:.3g} s apart; other clocks?"
            )
