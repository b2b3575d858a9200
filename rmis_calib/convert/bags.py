"""ROS1 bags, ROS2 bags (sqlite3, mcap) and bare files of them, by rosbags: read once, in bounded memory."""

from collections import deque
from collections.abc import Iterator
from concurrent.futures import ThreadPoolExecutor
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import numpy as np

from rmis_calib.convert.joints import NEEDS_ROBOT, NO_POSES
from rmis_calib.convert.material import NEEDS_STEREO, ArmLog, Job, Material
from rmis_calib.convert.messages import camera_info_of, pose_of, stamp_ns, write_picture
from rmis_calib.convert.salvage import salvaged
from rmis_calib.convert.settings import ConvertSettings
from rmis_calib.convert.topics import Choice, Topic, choose_topics, describe
from rmis_calib.errors import FileError, RecordingError
from rmis_calib.io._camera_formats.camera_info import CameraInfo, mono_of_info, pair_of_infos
from rmis_calib.io._checks import Note
from rmis_calib.io.intrinsics import StereoFile

_INSTALL = "the package rosbags (pip install 'rmis-calib[bags]')"
_WAITING = 32
"""Pictures of one eye that wait for the other's: a bag that interleaves worse loses pairs, and says so."""
_PAIR_SLACK = 0.5
"""Share of a frame interval that the eyes of a pair may be apart."""
_CLOCKS_APART_S = 0.5


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
            hint = "a whole bag (--salvage converts what is whole of it)"
            raise FileError(where=str(path), expected=hint, found=_first_line(problem)) from problem
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
    return sorted(file for file in path.iterdir() if file.suffix in (".bag", ".mcap", ".db3")) or [path]


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
                hint = "a whole bag (--salvage converts what is whole of it)"
                raise FileError(where=str(path), expected=hint, found=_first_line(problem)) from problem
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


def read_logs(path: Path, settings: ConvertSettings, note: Note) -> tuple[dict[str, ArmLog], dict[str, CameraInfo]]:
    """Only the arms and the cameras of a bag, for pictures that lie beside it."""
    with open_bag(path, settings.salvage, note) as bag:
        choice = choose_topics([t for t in bag.topics if "Image" not in t.type], settings, note, str(path))
        infos = {t.name: t for t in bag.topics if t.type.endswith("CameraInfo")}
        arms, found = _new_logs(choice), {}
        for topic, received_ns, message in bag.read(_log_topics(choice) | set(infos)):
            if topic in infos:
                side = "right" if "right" in topic else "left" if "left" in topic else "right"
                found.setdefault(side, camera_info_of(message, topic))
            else:
                _add_to_log(arms, choice, topic, received_ns, message)
        return arms, found


def _log_topics(choice: Choice) -> set[str]:
    return {topic.name for topic in (*choice.joints.values(), *choice.poses.values())}


def _new_logs(choice: Choice) -> dict[str, ArmLog]:
    arms = {}
    for arm in {**choice.joints, **choice.poses}:
        pose = choice.poses.get(arm)
        arms[arm] = ArmLog(arm, is_local=pose is not None and "local" in pose.name)
    return arms


def _add_to_log(arms: dict[str, ArmLog], choice: Choice, topic: str, received_ns: int, message: Any) -> None:
    for arm, log in arms.items():
        if arm in choice.joints and choice.joints[arm].name == topic and len(message.position):
            log.joint_ns.append(stamp_ns(message, received_ns))
            log.joints.append(np.array(message.position, dtype=np.float64))
            log.joint_names = tuple(message.name)
        elif arm in choice.poses and choice.poses[arm].name == topic:
            log.pose_ns.append(stamp_ns(message, received_ns))
            log.poses.append(pose_of(message))
            log.pose_frame = str(message.header.frame_id)
            # Where a console gives an arm no other frame, poses are in its own base, and say so.
            log.is_local = log.is_local or log.pose_frame.strip("/") == f"{arm}_base"


def _read(bag: Bag, choice: Choice, job: Job, settings: ConvertSettings) -> Material:
    assert choice.right is not None
    arms, infos = _new_logs(choice), {}
    pairs = _Pairs(job, choice.right, choice.left)
    sides = {topic.name: side for side, topic in choice.infos.items()}
    pictures = {topic.name for topic in (choice.right, choice.left) if topic is not None}
    names = _log_topics(choice) | set(sides) | pictures
    total = sum(topic.count for topic in bag.topics if topic.name in names)
    for done, (topic, received_ns, message) in enumerate(bag.read(names), start=1):
        if topic in pictures:
            pairs.add(topic, stamp_ns(message, received_ns), message)
        elif topic in sides:
            infos.setdefault(sides[topic], camera_info_of(message, topic))
        else:
            _add_to_log(arms, choice, topic, received_ns, message)
        job.progress("reading the bag", min(done, total), total)
    frame_ns = pairs.finish()
    _check_clocks(frame_ns, arms, job.note)
    rectified = settings.rectified
    if rectified is None:
        rectified = "rect" in choice.right.name
        if infos:
            kind = "rectified: their camera is P" if rectified else "raw: their camera is K and D"
            job.note(f"pictures of {choice.right.name} were taken for {kind} (by the topic's name)")
    layout = _layout(pairs.size, infos, choice.left is None)
    if layout is not None:
        job.note("pictures are twice as wide as their camera_info: both eyes side by side, the left one on the left")
    return Material(
        {name: log for name, log in arms.items() if log.has_joints or log.poses},
        cameras_of(infos, choice.left is not None or layout is not None, rectified, job.note), frame_ns, "right",
        "left" if choice.left is not None else None, layout,
    )  # fmt: skip


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


class _Pairs:
    """Pictures written as they come; of two eyes only those that belong together, both encoded at once."""

    def __init__(self, job: Job, right: Topic, left: Topic | None) -> None:
        self._job, self._right, self._left = job, right, left
        self._pool = ThreadPoolExecutor(max_workers=2, thread_name_prefix="rmis-encode")
        self._waiting: dict[str, deque[tuple[int, Any]]] = {
            right.name: deque(),
            **({left.name: deque()} if left else {}),
        }
        self._interval_ns: float | None = None
        self._previous: dict[str, int] = {}
        self._ns: list[int] = []
        self._apart: list[int] = []
        self._lost = 0
        self.size: tuple[int, int] | None = None
        for side in ("right", *(("left",) if left is not None else ())):
            (job.folder / side).mkdir()

    def add(self, topic: str, ns: int, message: Any) -> None:
        previous = self._previous.get(topic)
        if previous is not None and ns <= previous:
            self._lost += 1
            return
        if previous is not None and topic == self._right.name:
            gap = ns - previous
            self._interval_ns = gap if self._interval_ns is None else min(self._interval_ns, gap)
        self._previous[topic] = ns
        if self._left is None:
            self._write(ns, message, None)
            return
        self._waiting[topic].append((ns, message))
        self._match()

    def finish(self) -> np.ndarray:
        """(N,) stamps of the frames that were written.

        Raises:
            RecordingError: there are none.
        """
        if self._left is not None:
            self._match(at_end=True)
            self._lost += sum(map(len, self._waiting.values()))
        self._pool.shutdown()
        where = self._right.name
        if not self._ns:
            expected = "pictures of both eyes with stamps that belong together" if self._left else "pictures"
            raise RecordingError(where=where, expected=expected, found="none")
        if self._lost:
            self._job.note(f"{self._lost} pictures without a partner, or with a repeated stamp, were left out")
        if self._apart:
            apart_ms = float(np.median(np.abs(self._apart))) / 1e6
            self._job.note(f"{len(self._ns)} pairs of pictures; the eyes are {apart_ms:.3g} ms apart (median)")
        return np.array(self._ns, dtype=np.int64)

    def _match(self, at_end: bool = False) -> None:
        """Write the pairs at the head of both queues; let go of what can have no partner any more."""
        assert self._left is not None
        right, left = self._waiting[self._right.name], self._waiting[self._left.name]
        while right and left:
            apart = left[0][0] - right[0][0]
            slack = _PAIR_SLACK * self._interval_ns if self._interval_ns is not None else None
            if slack is None and not at_end and len(right) < 2:
                break  # the interval is not known before the second picture
            if slack is None or abs(apart) <= slack:
                (ns, right_message), (_, left_message) = right.popleft(), left.popleft()
                self._apart.append(apart)
                self._write(ns, right_message, left_message)
            else:
                (right if apart > 0 else left).popleft()
                self._lost += 1
        for queue in (right, left):
            while len(queue) > _WAITING:
                queue.popleft()
                self._lost += 1

    def _write(self, ns: int, right: Any, left: Any) -> None:
        number = f"{len(self._ns):06d}"
        eyes = [("right", right, self._right), *([("left", left, self._left)] if self._left is not None else [])]
        written = [
            self._pool.submit(write_picture, message, self._job.folder / side / number, topic.name)
            for side, message, topic in eyes
        ]
        for future in written:
            self.size = self.size or future.result()[1]
        self._ns.append(ns)
