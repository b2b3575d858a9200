"""Frames of a video or a folder of images: decoded ahead in a background thread, in bounded memory, onto a device."""

from collections import deque
from collections.abc import Generator, Iterator, Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass
from itertools import islice
from pathlib import Path
from threading import Lock

import numpy as np
import torch
from jaxtyping import Int64, UInt8
from torch import Tensor

from rmis_calib.errors import InputError
from rmis_calib.io._images import ImageReader
from rmis_calib.io.readers import Reader, open_reader

# Batches decoded ahead of the consumer: one hides the decoding behind the detection, one more rides out a key frame.
_BATCHES_AHEAD = 2


@dataclass(frozen=True, eq=False)
class FrameBatch:
    """Frames in order on one device, consecutive unless only every n-th was asked for."""

    indices: Int64[Tensor, " batch"]
    """Frame numbers, on the CPU."""
    images: UInt8[Tensor, "batch 3 height width"]
    """RGB; channels last in memory, as they are decoded."""


class FrameSource:
    """One camera's frames.

    Attributes:
        path: the video, folder or image.
        size: (height, width), px.
        count: number of frames, exact.
        times_s: (N,) time of each frame after the first, from the container's time stamps, else index / rate; None for
            images and for a video that has neither.
    """

    def __init__(self, reader: Reader) -> None:
        self._reader = reader
        self.path: Path = reader.path
        self.size: tuple[int, int] = reader.size
        self.count: int = reader.count
        self.times_s: np.ndarray | None = reader.times_s

    def __len__(self) -> int:
        return self.count

    def __repr__(self) -> str:
        return f"FrameSource({str(self.path)!r}, {self.count} frames of {self.size[1]} x {self.size[0]} px)"

    def batches(
        self, batch_size: int, device: torch.device | str = "cpu", every: int = 1
    ) -> Generator[FrameBatch, None, None]:
        """All frames in order, or every n-th from the first; the last batch shorter where it must be.

        A thread decodes ahead; memory holds three batches at most, the consumer's among them. Closing the iterator, or
        leaving its loop, ends the thread.

        Raises:
            InputError: `batch_size` or `every` is not positive.
            VideoError: a frame cannot be decoded; raised when the consumer reaches its batch.
        """
        if batch_size < 1:
            raise InputError(where="batch_size", expected="at least 1", found=batch_size)
        if every < 1:
            raise InputError(where="every", expected="at least 1", found=every)
        return self._batches(batch_size, torch.device(device), every)

    def _batches(self, batch_size: int, device: torch.device, every: int) -> Generator[FrameBatch, None, None]:
        frames = self._reader.read_all(every)
        # An interrupt may hit between the start of the thread and its registration, and then `shutdown` does not wait.
        decoding = Lock()
        executor = ThreadPoolExecutor(max_workers=1, thread_name_prefix="rmis-decode")
        try:
            # Errors of the thread travel in the futures and are raised by `result`.
            ahead = deque(executor.submit(_stack, frames, batch_size, decoding) for _ in range(_BATCHES_AHEAD))
            start = 0
            while (images := ahead.popleft().result()) is not None:
                ahead.append(executor.submit(_stack, frames, batch_size, decoding))
                yield _to_device(images, torch.arange(start, start + len(images)) * every, device)
                start += len(images)
        finally:
            executor.shutdown(wait=True, cancel_futures=True)
            with decoding:
                frames.close()

    def has(self, index: int) -> bool:
        """Whether there is such a frame to read."""
        return 0 <= index < self.count

    def frame(self, index: int) -> UInt8[Tensor, "3 height width"]:
        """One frame by number, RGB on the CPU.

        Raises:
            InputError: no such frame.
            VideoError: it cannot be decoded.
        """
        return self.frames([index])[0]

    def frames(self, indices: Sequence[int]) -> UInt8[Tensor, "n 3 height width"]:
        """Some frames by number, in the order asked for, RGB on the CPU. Decodes from the nearest key frames.

        Raises:
            InputError: no such frame.
            VideoError: one cannot be decoded.
        """
        wrong = [index for index in indices if not 0 <= index < self.count]
        if wrong:
            raise InputError(where=str(self.path), expected=f"a frame of 0 to {self.count - 1}", found=wrong[0])
        order = sorted(set(indices))
        found = dict(zip(order, self._reader.read(order), strict=True))
        images = np.stack([found[index] for index in indices]) if order else np.empty((0, *self.size, 3), np.uint8)
        return torch.from_numpy(images).permute(0, 3, 1, 2)

    def labels(self, indices: Sequence[int]) -> Int64[Tensor, "n height width"]:
        """Class numbers of some pictures of masks: of images, indices of a palette or grey values; of a video, grey.

        Raises:
            VideoError: one cannot be decoded, or is a picture of colours.
        """
        if isinstance(self._reader, ImageReader):
            return torch.from_numpy(self._reader.labels(indices))
        return self.frames(indices)[:, 0].long()


def open_source(path: str | Path) -> FrameSource:
    """Frames of a video file, a folder of images sorted by name, or a single image.

    Raises:
        FileError: nothing is there.
        VideoError: it is empty, truncated or not what it seems.
    """
    return FrameSource(open_reader(path))


def _stack(frames: Iterator[np.ndarray], batch_size: int, decoding: Lock) -> np.ndarray | None:
    with decoding:
        batch = list(islice(frames, batch_size))
    return np.stack(batch) if batch else None


def _to_device(images: np.ndarray, indices: Int64[Tensor, " batch"], device: torch.device) -> FrameBatch:
    pixels = torch.from_numpy(images)
    if device.type == "cuda":
        # From pinned memory the copy runs beside the kernels of the batch before.
        pixels = pixels.pin_memory().to(device, non_blocking=True)
    return FrameBatch(indices, pixels.to(device).permute(0, 3, 1, 2))
