"""What is whole of a bag that was cut off or damaged: its records read one after the other, without the index."""

import bz2
import struct
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from functools import lru_cache
from pathlib import Path
from typing import Any, BinaryIO
from urllib.parse import quote

from rmis_calib.convert.topics import Topic
from rmis_calib.errors import FileError

Messages = Callable[[set[str]], Iterator[tuple[str, int, Any]]]
_RAW = tuple[str, str, str, int, bytes]
"""Topic, type, definition, received ns, data."""
_LARGEST = 1 << 31
_SQLITE_FLAGS = 0x1 | 0x40  # read only, the name is a URI


@contextmanager
def salvaged(path: Path) -> Iterator[tuple[list[Topic], Messages]]:
    """Topics and messages of a damaged .bag, .mcap or .db3, or of those in a folder.

    Raises:
        FileError: nothing of it can be read.
    """
    files = _files(path)
    counts: dict[tuple[str, str], int] = {}
    for topic, kind, _, _, _ in _records(files):
        counts[topic, kind] = counts.get((topic, kind), 0) + 1
    if not counts:
        raise FileError(where=str(path), expected="a bag with an intact part", found="no whole message")
    yield [Topic(name, kind, count) for (name, kind), count in counts.items()], lambda names: _decoded(files, names)


def can_salvage(path: Path) -> bool:
    """Whether any message of a .bag, .mcap or .db3, or of those in a folder, is whole."""
    return any(True for _ in _records(_files(path)))


def _files(path: Path) -> list[Path]:
    """Files that are what their names say."""
    files = sorted(path.iterdir()) if path.is_dir() else [path]
    return [file for file in files if file.suffix in _RECORDS and _begins_like(file, _MAGIC[file.suffix])]


def _begins_like(file: Path, magic: bytes) -> bool:
    with file.open("rb") as opened:
        return opened.read(len(magic)) == magic


def _records(files: list[Path]) -> Iterator[_RAW]:
    for file in files:
        yield from _RECORDS[file.suffix](file)


def _decoded(files: list[Path], names: set[str]) -> Iterator[tuple[str, int, Any]]:
    from rosbags.typesys import Stores, get_types_from_msg, get_typestore

    known: dict[tuple[str, bool], Any] = {}
    for file in files:
        is_ros1 = file.suffix == ".bag"
        for topic, kind, definition, received_ns, data in _RECORDS[file.suffix](file):
            if topic not in names:
                continue
            if (kind, is_ros1) not in known:
                store = get_typestore(Stores.EMPTY if definition else Stores.ROS2_JAZZY)
                if definition:
                    store.register(get_types_from_msg(definition, kind))
                known[kind, is_ros1] = store.deserialize_ros1 if is_ros1 else store.deserialize_cdr
            try:
                message = known[kind, is_ros1](data, kind)
            except Exception:  # a record whose length survived but whose content did not
                continue
            yield topic, received_ns, message


def _ros1_records(path: Path) -> Iterator[_RAW]:
    """Bag format 2.0: records of a header and data; messages lie in chunks."""
    connections: dict[int, tuple[str, str, str]] = {}
    with path.open("rb") as file:
        if not file.readline().startswith(b"#ROSBAG V2"):
            return
        for header, data in _ros1_pairs(file):
            op = header.get("op", b"\0")[0]
            if op == 0x05:  # chunk
                try:
                    content = _unpacked(header.get("compression", b"none"), data)
                except Exception:  # one damaged chunk: the next may be whole
                    continue
                for inner_header, inner in _ros1_pairs(_Bytes(content)):
                    yield from _ros1_message(inner_header, inner, connections)
            else:
                yield from _ros1_message(header, data, connections)


def _ros1_message(
    header: dict[str, bytes], data: bytes, connections: dict[int, tuple[str, str, str]]
) -> Iterator[_RAW]:
    op = header.get("op", b"\0")[0]
    if op not in (0x02, 0x07) or "conn" not in header:
        return
    number = struct.unpack("<I", header["conn"])[0]
    if op == 0x07:
        fields = dict(_ros1_fields(data))
        kind = fields.get("type", b"").decode()
        package, _, name = kind.partition("/")
        definition = fields.get("message_definition", b"").decode(errors="replace")
        connections[number] = (header.get("topic", b"").decode(), f"{package}/msg/{name}", definition)
    elif number in connections:
        seconds, nanoseconds = struct.unpack("<II", header["time"])
        topic, kind, definition = connections[number]
        yield topic, kind, definition, seconds * 1_000_000_000 + nanoseconds, data


def _ros1_pairs(file: "BinaryIO | _Bytes") -> Iterator[tuple[dict[str, bytes], bytes]]:
    while True:
        parts = []
        for _ in range(2):
            size = file.read(4)
            if len(size) < 4 or struct.unpack("<I", size)[0] > _LARGEST:
                return
            parts.append(file.read(struct.unpack("<I", size)[0]))
            if len(parts[-1]) < struct.unpack("<I", size)[0]:
                break
        header = dict(_ros1_fields(parts[0]))
        is_whole = len(parts) == 2 and len(parts[-1]) == struct.unpack("<I", size)[0]
        if is_whole or (len(parts) == 2 and header.get("op") == b"\x05" and header.get("compression") == b"none"):
            yield header, parts[1]  # of a chunk that breaks off, the messages before
        if not is_whole:
            return


def _ros1_fields(data: bytes) -> Iterator[tuple[str, bytes]]:
    place = 0
    while place + 4 <= len(data):
        size = struct.unpack_from("<I", data, place)[0]
        name, _, value = data[place + 4 : place + 4 + size].partition(b"=")
        yield name.decode(errors="replace"), value
        place += 4 + size


def _unpacked(compression: bytes, data: bytes) -> bytes:
    if compression == b"bz2":
        return bz2.decompress(data)
    if compression == b"lz4":
        import lz4.frame

        return lz4.frame.decompress(data)
    return data


class _Bytes:
    """Bytes that are read like a file, without a copy of the whole."""

    def __init__(self, data: bytes) -> None:
        self._data, self._place = memoryview(data), 0

    def read(self, size: int) -> bytes:
        part = self._data[self._place : self._place + size]
        self._place += size
        return bytes(part)


def _mcap_records(path: Path) -> Iterator[_RAW]:
    from mcap.exceptions import McapError
    from mcap.records import Channel, Message, Schema
    from mcap.stream_reader import StreamReader

    schemas: dict[int, Any] = {}
    channels: dict[int, Any] = {}
    with path.open("rb") as file:
        try:
            for record in StreamReader(file).records:
                if isinstance(record, Schema):
                    schemas[record.id] = record
                elif isinstance(record, Channel):
                    channels[record.id] = record
                elif isinstance(record, Message) and record.channel_id in channels:
                    channel = channels[record.channel_id]
                    schema = schemas[channel.schema_id]
                    definition = bytes(schema.data).decode(errors="replace") if schema.encoding == "ros2msg" else ""
                    yield channel.topic, schema.name, definition, record.log_time, bytes(record.data)
        except (McapError, KeyError, ValueError, EOFError, struct.error):
            return  # the place where the file breaks off


def _sqlite_records(path: Path) -> Iterator[_RAW]:
    """Rows up to the first page that is not there."""
    import apsw

    try:
        connection = apsw.Connection(
            f"file:{quote(str(path.absolute()))}?immutable=1", _SQLITE_FLAGS, _filled_up().vfs_name
        )
        topics = {row[0]: row[1:] for row in connection.execute("SELECT id, name, type FROM topics")}
        for topic_id, received_ns, data in connection.execute(
            "SELECT topic_id, timestamp, data FROM messages ORDER BY id"
        ):
            if topic_id in topics:
                name, kind = topics[topic_id]
                yield name, kind, "", received_ns, bytes(data)
    except (apsw.Error, TypeError):
        return


@lru_cache(maxsize=1)
def _filled_up() -> Any:
    """Files as SQLite sees them, filled up with zeros: it opens none that is shorter than its header says."""
    import apsw

    class FilledUpFile(apsw.VFSFile):
        def __init__(self, name: Any, flags: list[int]) -> None:
            super().__init__("", name, flags)
            head = super().xRead(min(100, super().xFileSize()), 0).ljust(100, b"\0")
            page_bytes = int.from_bytes(head[16:18], "big")
            self._size = (65536 if page_bytes == 1 else page_bytes) * int.from_bytes(head[28:32], "big")

        def xFileSize(self) -> int:
            return max(self._size, super().xFileSize())

        def xRead(self, amount: int, offset: int) -> bytes:
            there = max(0, min(amount, super().xFileSize() - offset))
            return (super().xRead(there, offset) if there else b"").ljust(amount, b"\0")

    class FilledUp(apsw.VFS):
        vfs_name = "rmis-filled-up"

        def __init__(self) -> None:
            super().__init__(self.vfs_name, "")

        def xOpen(self, name: Any, flags: list[int]) -> FilledUpFile:
            return FilledUpFile(name, flags)

    return FilledUp()


_MAGIC = {".bag": b"#ROSBAG V2", ".mcap": b"\x89MCAP0\r\n", ".db3": b"SQLite format 3\0"}
_RECORDS: dict[str, Callable[[Path], Iterator[_RAW]]] = {
    ".bag": _ros1_records,
    ".mcap": _mcap_records,
    ".db3": _sqlite_records,
}
