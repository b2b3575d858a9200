"""One eye of a file that shows both, side by side or one above the other, as a source of frames of its own."""

from collections.abc import Generator, Iterator, Sequence
from typing import Literal

import numpy as np

from rmis_calib.errors import VideoError
from rmis_calib.io._images import ImageReader
from rmis_calib.io._video_file import VideoReader

Layout = Literal["side_by_side", "top_bottom"]


class EyeReader:
    """Half of every frame of another reader. Each eye decodes the file for itself: both run beside each other.

    Convention: the left eye is the left or the upper half, unless `swapped`.

    Raises:
        VideoError: the frames cannot be halved.
    """

    def __init__(
        self, whole: VideoReader | ImageReader, eye: Literal["right", "left"], layout: Layout, swapped: bool
    ) -> None:
        self._whole = whole
        self.path, self.count, self.times_s, self.notes = whole.path, whole.count, whole.times_s, whole.notes
        height, width = whole.size
        side = width if layout == "side_by_side" else height
        if side % 2:
            expected = f"an even {'width' if layout == 'side_by_side' else 'height'} for stereo_layout {layout}"
            raise VideoError(where=str(whole.path), expected=expected, found=f"{width} x {height} px")
        self.size = (height, side // 2) if layout == "side_by_side" else (side // 2, width)
        is_second = (eye == "right") != swapped
        half = slice(side // 2, None) if is_second else slice(None, side // 2)
        self._part = (slice(None), half) if layout == "side_by_side" else (half, slice(None))

    def read_all(self, every: int = 1) -> Generator[np.ndarray, None, None]:
        """Every n-th frame's half, (h, w, 3) uint8 RGB."""
        frames = self._whole.read_all(every)
        try:
            for frame in frames:
                yield np.ascontiguousarray(frame[self._part])
        finally:
            frames.close()

    def read(self, indices: Sequence[int]) -> Iterator[np.ndarray]:
        """Some frames' halves, in the order asked for."""
        for frame in self._whole.read(indices):
            yield np.ascontiguousarray(frame[self._part])
