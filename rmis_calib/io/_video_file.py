"""A video file as a source of frames: counted and timed by its packets, decoded by PyAV, checked against each other."""

from bisect import bisect_right
from collections.abc import Generator, Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from itertools import chain
from pathlib import Path
from typing import Any

import av
import numpy as np
from av.stream import Disposition
from av.video.frame import VideoFrame

from rmis_calib.errors import VideoError
from rmis_calib.io._containers import is_cut_short
from rmis_calib.io._depth import bits_of, eight_bits

_SIXTEEN_BIT = {name: "gray16le" if name.startswith("gray") else "rgb48le" for name in (
    "gray16le", "gray16be", "rgb48le", "rgb48be", "rgba64le", "rgba64be", "bgr48le", "bgr48be"
)}  # fmt: skip
"""Pixel formats of 16-bit numbers, whose pictures may use fewer bits; other formats say how many they use."""
_LOOKED_AT = 8
"""Frames from which the number of bits is told."""
_MOST_WRONG_STAMPS = 0.1
"""Share of the frames up to which wrong time stamps are interpolated."""


@dataclass(frozen=True)
class _Index:
    """What the packets say, without decoding: display times in units of the stream's time base, sorted."""

    count: int
    pts: Sequence[int | None]
    key_pts: list[int]
    promised: int
    """Packets that the container claims to hold; 0 where it claims nothing."""
    present: int
    is_damaged: bool


class VideoReader:
    """Frames of a video file in the order of their display.

    Opening reads every packet without decoding it: an exact count, an exact time of each frame, and the news of a file
    that was cut off. A cut that leaves whole packets in a format that states neither its length nor its count (MPEG-TS,
    raw H.264) shows only against frame_times.csv.

    Raises:
        VideoError: the file is empty, not a video, or truncated.
    """

    def __init__(self, path: Path, expected_count: int | None = None) -> None:
        """Open a file.

        Args:
            path: the file.
            expected_count: frames that a frame_times.csv lists: it outweighs what the container promises.
        """
        self.path = path
        self.count = 0
        self.notes: tuple[str, ...] = ()
        if path.stat().st_size == 0:
            raise VideoError(where=str(path), expected="a video", found="an empty file (0 bytes)")
        with self._open() as (container, stream):
            codec = stream.codec_context
            self._size: tuple[int, int] = (0, 0) if codec is None else (codec.height, codec.width)
            self._rate = stream.average_rate or stream.guessed_rate
            self._time_base = stream.time_base
            index = _read_index(container, stream)
            hides_frames = _has_hidden_packets(container, stream)
        if min(self._size) <= 0:
            raise VideoError(where=str(path), expected="a video with pictures", found="none that can be decoded")
        promises_more = index.promised > index.present
        if index.is_damaged or not index.count or (promises_more and expected_count != index.present):
            raise self._truncated(index.promised, index.present)
        if promises_more:
            self._note(f"the header promises {index.promised} frames; the {index.present} that are there were read")
        self.count, self._key_pts = index.count, index.key_pts
        stamps = index.pts
        if hides_frames or not _are_distinct(stamps):
            stamps = [frame.pts for frame in self._decode()]
            self.count = len(stamps)
        self._stamps = np.array([np.nan if stamp is None else float(stamp) for stamp in stamps])
        """Time stamps as they are, (N,), NaN where a frame has none."""
        self._pts = [stamp for stamp in stamps if stamp is not None] if _are_distinct(stamps) else []
        """The same where each frame has its own: only then is a frame found by it."""
        if not self._pts:
            self._note_stamps()
        self._turns, self._bits = self._look_at_first()
        self.size = self._size if self._turns % 2 == 0 else (self._size[1], self._size[0])

    def _note(self, sentence: str) -> None:
        self.notes = (*self.notes, f"{self.path.name}: {sentence}")

    def _quarter_turns(self, frame: VideoFrame) -> int:
        """Anticlockwise, by the display matrix.

        Raises:
            VideoError: the matrix asks for a mirrored picture, or for one turned by another angle.
        """
        data = frame.side_data.get("DISPLAYMATRIX")
        if data is None:
            return 0
        a, b, _, c, d, *_ = np.frombuffer(bytes(data), dtype=np.int32).tolist()
        if a * d - b * c < 0 or sorted(map(abs, (a, b, c, d)))[1] != 0:
            expected = "pictures as the camera took them, or turned by 90, 180 or 270 deg"
            what = "mirrored pictures" if a * d - b * c < 0 else f"pictures turned by {frame.rotation} deg"
            raise VideoError(where=str(self.path), expected=expected, found=f"a file that asks for {what}")
        return round(frame.rotation / 90) % 4

    def _look_at_first(self) -> tuple[int, int]:
        """Quarter turns (anticlockwise) that the container asks for, and bits of a picture of 16-bit numbers."""
        turns, highest = 0, 0
        for number, frame in zip(range(_LOOKED_AT), self._decode(), strict=False):
            if number == 0:
                turns = self._quarter_turns(frame)
            if frame.format.name not in _SIXTEEN_BIT:
                break
            highest = max(highest, int(frame.to_ndarray(format=_SIXTEEN_BIT[frame.format.name]).max()))
        if turns:
            self._note(f"pictures are turned by {90 * turns} deg, as the file asks for")
        bits = bits_of(highest)
        if 8 < bits < 16:
            self._note(f"the 16-bit pictures hold values up to {highest}: read as {bits} bits")
        return turns, bits

    @property
    def times_s(self) -> np.ndarray | None:
        """Time of each frame after the first, (N,); from the container's time stamps, else index / rate.

        A few frames without a stamp, or with that of another one, get a time between their neighbours', and a note.
        """
        by_rate = np.arange(self.count) / float(self._rate) if self._rate else None
        if self._time_base is None:
            return by_rate
        if self._pts:
            pts = np.array(self._pts, dtype=np.int64)
            return (pts - pts[0]) * float(self._time_base)
        good = _rising(self._stamps)
        if good.sum() < max(2, (1.0 - _MOST_WRONG_STAMPS) * self.count):
            return by_rate
        numbers = np.arange(self.count)
        mended = _interpolated(numbers, numbers[good], self._stamps[good])
        return (mended - mended[0]) * float(self._time_base)

    def _note_stamps(self) -> None:
        """Say what became of frames without a time stamp of their own."""
        wrong = np.flatnonzero(~_rising(self._stamps)).tolist()
        if self._time_base is None or len(wrong) == self.count:
            return
        if len(wrong) > _MOST_WRONG_STAMPS * self.count:
            self._note(f"{len(wrong)} of {self.count} time stamps are missing or repeated: times are frame / rate")
        elif wrong:
            frames = ", ".join(map(str, wrong[:5])) + (", ..." if len(wrong) > 5 else "")
            self._note(f"no time stamp of its own in frame {frames}: interpolated between the neighbours")

    def read_all(self, every: int = 1) -> Generator[np.ndarray, None, None]:
        """Every n-th frame from the first, (H, W, 3) uint8 RGB. All are decoded, but only those turned into RGB.

        Raises:
            VideoError: a frame cannot be decoded, or their number is not the one counted at opening.
        """
        number = 0
        for frame in self._decode():
            if number % every == 0:
                yield self._pixels(frame, number)
            number += 1
        if number != self.count:
            raise self._truncated(self.count, number)

    def read(self, indices: Sequence[int]) -> Iterator[np.ndarray]:
        """Some frames; `indices` increase.

        Raises:
            VideoError: a frame cannot be decoded or does not come.
        """
        if not self._pts:
            wanted = set(indices)
            yield from (image for number, image in enumerate(self.read_all()) if number in wanted)
            return
        with self._open() as (container, stream):
            frames: Iterator[VideoFrame] = iter(())
            reached = -1
            for index in indices:
                key = self._key_before(index)
                if key > reached:
                    frames = self._frames_from(container, stream, key)
                frame = next((frame for frame in frames if self._index_of(frame) >= index), None)
                if frame is None or self._index_of(frame) != index:
                    raise VideoError("truncated or damaged video", where=f"{self.path} frame {index}")
                reached = index
                yield self._pixels(frame, index)

    def _key_before(self, index: int) -> int:
        """Index of the last frame at or before `index` where decoding can start."""
        place = bisect_right(self._key_pts, self._pts[index])
        return bisect_right(self._pts, self._key_pts[place - 1]) - 1 if place else 0

    def _frames_from(self, container: Any, stream: Any, key: int) -> Iterator[VideoFrame]:
        """Frames from `key` or from a little before it."""
        container.seek(self._pts[key], stream=stream)
        frames = self._guard(container.decode(stream))
        first = next(frames, None)
        if first is None or self._index_of(first) > key:
            # Some containers seek by decoding time and land one key frame late: start over.
            container.seek(min(self._pts[0], 0), stream=stream)
            return self._guard(container.decode(stream))
        return chain([first], frames)

    def _index_of(self, frame: VideoFrame) -> int:
        """Number of a frame by its time stamp; -1 for one that belongs before the first."""
        return -1 if frame.pts is None else bisect_right(self._pts, frame.pts) - 1

    def _decode(self) -> Iterator[VideoFrame]:
        with self._open() as (container, stream):
            yield from self._guard(container.decode(stream))

    def _guard(self, frames: Iterator[VideoFrame]) -> Iterator[VideoFrame]:
        """The same frames, with the decoder's complaints as `VideoError`."""
        number = 0
        while True:
            try:
                frame = next(frames, None)
            except av.FFmpegError as error:
                found = f"an error after {number} frames ({error.strerror})"
                raise VideoError(where=str(self.path), expected=f"{self.count} frames", found=found) from error
            if frame is None:
                return
            number += 1
            yield frame

    def _pixels(self, frame: VideoFrame, number: int) -> np.ndarray:
        if frame.is_corrupt:
            raise VideoError(where=f"{self.path} frame {number}", expected="a whole picture", found="a damaged one")
        if (frame.height, frame.width) != self._size:
            expected = f"{self._size[1]} x {self._size[0]} px as before"
            found = f"{frame.width} x {frame.height}"
            raise VideoError(where=f"{self.path} frame {number}", expected=expected, found=found)
        if frame.format.name in _SIXTEEN_BIT and self._bits > 8:
            values = frame.to_ndarray(format=_SIXTEEN_BIT[frame.format.name])
            image = eight_bits(values, self._bits, f"{self.path} frame {number}")
        else:
            image = frame.to_ndarray(format="rgb24")
        return np.ascontiguousarray(np.rot90(image, self._turns)) if self._turns else image

    def _truncated(self, expected: int, found: int) -> VideoError:
        promise = f"{expected} frames" if expected > found else "whole frames"
        found_text = f"{found} frames" if expected > found else f"a cut after {max(found - 1, 0)} frames"
        return VideoError("truncated or damaged video", where=str(self.path), expected=promise, found=found_text)

    @contextmanager
    def _open(self) -> Iterator[tuple[Any, Any]]:
        try:
            with av.open(str(self.path), metadata_errors="ignore") as container:
                # Cover art is a stream of a single picture that no camera took.
                attached = Disposition.attached_pic | Disposition.timed_thumbnails
                streams = [stream for stream in container.streams.video if not stream.disposition & attached]
                if len(streams) != 1:
                    raise VideoError(where=str(self.path), expected="one video stream", found=f"{len(streams)}")
                stream = streams[0]
                stream.thread_type = "AUTO"
                yield container, stream
        except av.FFmpegError as error:
            is_cut = self.path.is_file() and is_cut_short(self.path)
            found = "a file cut short, without its index: copy or record it again" if is_cut else error.strerror
            raise VideoError(where=str(self.path), expected="a complete video", found=found) from error


def _read_index(container: Any, stream: Any) -> _Index:
    pts: list[int | None] = []
    key_pts: list[int] = []
    count = present = 0
    is_damaged = is_cut_short(Path(container.name))
    for packet in container.demux(stream):
        if not packet.size:  # the flush at the end
            continue
        present += 1
        is_damaged |= packet.is_corrupt
        if packet.is_discard:  # cut away by an edit list: decoded, never shown
            continue
        count += 1
        pts.append(packet.pts)
        if packet.pts is not None and packet.is_keyframe:
            key_pts.append(packet.pts)
    # Without a stamp the place among the others is not known before the pictures are decoded.
    known = [stamp for stamp in pts if stamp is not None]
    ordered: Sequence[int | None] = sorted(known) if len(known) == len(pts) else pts
    return _Index(count, ordered, sorted(key_pts), stream.frames, present, is_damaged)


def _has_hidden_packets(container: Any, stream: Any) -> bool:
    """Whether packets and pictures may differ in number: hidden reference frames of VP8, packed B-frames in AVI."""
    codec = "" if stream.codec_context is None else stream.codec_context.name
    return codec.startswith(("vp8", "libvpx")) or (codec == "mpeg4" and "avi" in container.format.name)


def _rising(stamps: np.ndarray) -> np.ndarray:
    """(N,) whether each stamp is known and exceeds all known ones before it."""
    known = np.where(np.isnan(stamps), -np.inf, stamps)
    before = np.concatenate(([-np.inf], np.maximum.accumulate(known)[:-1]))
    return known > before


def _interpolated(at: np.ndarray, numbers: np.ndarray, stamps: np.ndarray) -> np.ndarray:
    """Stamps at all frame numbers, on straight lines between the good ones and beyond them."""
    out = np.interp(at, numbers, stamps)
    step = (stamps[-1] - stamps[0]) / (numbers[-1] - numbers[0])
    out = np.where(at < numbers[0], stamps[0] + step * (at - numbers[0]), out)
    return np.where(at > numbers[-1], stamps[-1] + step * (at - numbers[-1]), out)


def _are_distinct(stamps: Sequence[int | None]) -> bool:
    """Whether each frame has a time stamp of its own."""
    return None not in stamps and len(set(stamps)) == len(stamps)
