"""Pictures into a video that every player plays: H.264, written frame by frame in bounded memory."""

from fractions import Fraction
from pathlib import Path
from types import TracebackType
from typing import Any

import av
import numpy as np

from rmis_calib.errors import OutputError, ShapeError

_OPTIONS = {"crf": "18", "preset": "veryfast", "movflags": "+faststart"}
_BT709 = 1
"""The number that H.264 gives to the colours of high definition; without it players guess by the picture's size."""
_VIDEO_RANGE = 1
_FINEST_RATE = 1001


class OverlayVideo:
    """A video file that grows by one picture at a time. A context manager: leaving it completes the file.

    Colour has half the resolution (yuv420p), which every player takes; a picture of odd size gets one more row or
    column.
    """

    def __init__(self, path: Path, size: tuple[int, int], rate_hz: float) -> None:
        """Open the file.

        Args:
            path: ends in .mp4.
            size: (height, width), px.
            rate_hz: pictures a second, played.

        Raises:
            OutputError: the file cannot be written.
        """
        self._path, self._size = path, size
        try:
            self._container = av.open(str(path), "w")
            rate = Fraction(rate_hz).limit_denominator(_FINEST_RATE)
            self._stream: Any = self._container.add_stream("libx264", rate=rate, options=_OPTIONS)
        except (av.FFmpegError, ValueError) as error:
            raise _unwritable(path, error) from error
        self._stream.height, self._stream.width = (n + n % 2 for n in size)
        self._stream.pix_fmt = "yuv420p"
        context = self._stream.codec_context
        context.colorspace = context.color_primaries = context.color_trc = _BT709
        context.color_range = _VIDEO_RANGE

    def __enter__(self) -> "OverlayVideo":
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        try:
            if kind is None:
                self._container.mux(self._stream.encode())
        except av.FFmpegError as failure:
            raise _unwritable(self._path, failure) from failure
        finally:
            self._container.close()

    def add(self, image: np.ndarray) -> None:
        """Append a picture, (h, w, 3) uint8 RGB.

        Raises:
            ShapeError: it has another size than the video.
            OutputError: the file cannot be written, as when the disk is full.
        """
        if image.shape != (*self._size, 3) or image.dtype != np.uint8:
            expected = f"{(*self._size, 3)} uint8"
            raise ShapeError(where=str(self._path), expected=expected, found=f"{image.shape} {image.dtype}")
        odd = [(0, n % 2) for n in self._size]
        even = np.pad(image, (*odd, (0, 0)), mode="edge") if any(self._size[i] % 2 for i in range(2)) else image
        frame = av.VideoFrame.from_ndarray(np.ascontiguousarray(even), format="rgb24")
        frame = frame.reformat(
            format="yuv420p", dst_colorspace=_BT709, dst_color_range=_VIDEO_RANGE, interpolation="AREA"
        )
        try:
            self._container.mux(self._stream.encode(frame))
        except av.FFmpegError as error:
            raise _unwritable(self._path, error) from error


def _unwritable(path: Path, error: Exception) -> OutputError:
    found = getattr(error, "strerror", None) or str(error)
    return OutputError(where=str(path), expected="a place where H.264 video can be written", found=found)
