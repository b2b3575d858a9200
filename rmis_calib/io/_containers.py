"""Whether a video file is as long as its own container says: decoders play a cut file up to the cut without a word."""

from pathlib import Path
from typing import BinaryIO

_EBML, _SEGMENT = b"\x1a\x45\xdf\xa3", b"\x18\x53\x80\x67"
_BOX_TYPES = (b"ftyp", b"moov", b"mdat", b"wide", b"free", b"skip")


def is_cut_short(path: Path) -> bool:
    """Whether an MP4, QuickTime or Matroska file ends before its last part does; False for other formats."""
    length = path.stat().st_size
    with path.open("rb") as file:
        start = file.read(8)
        if start[4:8] in _BOX_TYPES:
            return _mp4_end(file, length) > length
        return start.startswith(_EBML) and _matroska_end(file) > length


def _mp4_end(file: BinaryIO, length: int) -> int:
    """Where the last top-level box ends."""
    position, size = 0, 8
    # A box is no smaller than its header; less (0: up to the end of the file) ends the walk.
    while position < length and size >= 8:
        file.seek(position)
        header = file.read(16)
        size = int.from_bytes(header[:4])
        if size == 1:  # a 64-bit size follows the type
            size = int.from_bytes(header[8:])
        position += size
    return position


def _matroska_end(file: BinaryIO) -> int:
    """Where the segment, which holds everything after the header, ends; 0 for one of unknown size (a live stream)."""
    file.seek(len(_EBML))
    header_size, is_known = _element_size(file)
    if not is_known:
        return 0
    file.seek(header_size, 1)
    if file.read(len(_SEGMENT)) != _SEGMENT:
        return 0
    size, is_known = _element_size(file)
    return file.tell() + size if is_known else 0


def _element_size(file: BinaryIO) -> tuple[int, bool]:
    """An EBML size, and whether it is known: as many more bytes as the first has leading zeros; all ones is unknown."""
    first = file.read(1)
    if not first or not first[0]:
        return 0, False
    more = 8 - first[0].bit_length()
    mask = (1 << (7 * (more + 1))) - 1
    size = int.from_bytes(first + file.read(more)) & mask
    return size, size != mask
