"""One process that owns a device, and finds shafts for all others: pictures of several recordings in one batch.

Workers decode, send their pictures in shared memory and wait (`shared_detector.py`). Whatever waits while the device is
at work is its next batch, as long as camera, settings and size of the pictures are the same. So the device is never
kept waiting for a batch to fill, and memory is bounded by what the workers have in flight.
"""

import contextlib
import math
import mmap
import multiprocessing
import os
import pickle
import signal
import sys
import threading
import uuid
from collections import deque
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, field
from multiprocessing.connection import Connection, Listener
from multiprocessing.reduction import recv_handle
from typing import Any

import numpy as np
import torch
from torch import Tensor

from rmis_calib.parallel.processes import end_with_parent, environment_of_threads, prefer_to_kill

_RESTART_S = 0.5


@dataclass(frozen=True)
class Header:
    """What a worker says of its pictures.

    Attributes:
        detector: settings and camera, pickled; equal bytes are one detector.
        shape: (b, height, width) of the pictures; three bytes a pixel.
        new_buffer: bytes of the shared memory whose handle follows; 0: the one before.
        contour_n: (b, k, 2, 3) where to look, as `ShaftDetector.look_near` takes it; None: everywhere.
    """

    detector: bytes
    shape: tuple[int, int, int]
    new_buffer: int
    contour_n: np.ndarray | None = None

    @property
    def size(self) -> int:
        """Bytes in the shared memory."""
        return 3 * math.prod(self.shape)

    @property
    def kind(self) -> tuple[bytes, tuple[int, ...], tuple[int, ...] | None]:
        """What pictures of one batch have in common."""
        return self.detector, self.shape[1:], None if self.contour_n is None else self.contour_n.shape[1:]


@dataclass(eq=False)
class _Request:
    """Pictures of a worker, and room for the answer."""

    header: Header
    pixels: Tensor
    """Bytes in shared memory."""
    done: threading.Event = field(default_factory=threading.Event)
    answer: bytes = b""

    def pictures(self, device: str) -> Tensor:
        """(b, h, w, 3) uint8, on the device."""
        return self.pixels[: self.header.size].view(*self.header.shape, 3).to(device)


class _Line:
    """Requests that wait for the device."""

    def __init__(self, most_frames: int) -> None:
        self._most_frames = most_frames
        self._waiting: deque[_Request] = deque()
        self._changed = threading.Condition()

    def add(self, request: _Request) -> None:
        with self._changed:
            self._waiting.append(request)
            self._changed.notify()

    def take(self) -> list[_Request]:
        """The oldest request, and those that fit into one batch with it."""
        with self._changed:
            while not self._waiting:
                self._changed.wait()
            taken: list[_Request] = []
            frames = 0
            for request in list(self._waiting):
                count = request.header.shape[0]
                if not taken or (request.header.kind == taken[0].header.kind and frames + count <= self._most_frames):
                    taken.append(request)
                    frames += count
                    self._waiting.remove(request)
            return taken


def serve(address: str, device: str, most_frames: int, threads: int) -> None:
    """What the process does, until its parent is gone."""
    from rmis_calib.pipeline.pictures.detection import detecting_threads

    signal.signal(signal.SIGINT, signal.SIG_IGN)  # as a worker's: the parent decides
    end_with_parent()
    prefer_to_kill()
    torch.set_num_threads(threads)
    line = _Line(most_frames)
    with detecting_threads(device) as (executor, count), Listener(address, authkey=key_of_batch()) as listener:
        for _ in range(count):
            executor.submit(_detect_forever, line, device)
        while True:
            with contextlib.suppress(OSError, EOFError, multiprocessing.AuthenticationError):  # a worker that has died
                connection = listener.accept()
                threading.Thread(target=_listen, args=(connection, line), daemon=True).start()


def _listen(connection: Connection, line: _Line) -> None:
    """Take the requests of a connection, one after the other, until its worker closes it or dies."""
    with connection, contextlib.suppress(OSError, EOFError):
        shared = torch.empty(0, dtype=torch.uint8)
        while True:
            header: Header = pickle.loads(connection.recv_bytes())
            if header.new_buffer:
                shared = _mapped(recv_handle(connection), header.new_buffer)
            request = _Request(header, shared)
            line.add(request)
            request.done.wait()
            connection.send_bytes(request.answer)


def _mapped(handle: int, size: int) -> Tensor:
    memory = mmap.mmap(handle, size)
    os.close(handle)
    return torch.frombuffer(memory, dtype=torch.uint8)


def _detect_forever(line: _Line, device: str) -> None:
    detectors: dict[bytes, Any] = {}
    while True:
        requests = line.take()
        try:
            answers = _found(requests, detectors, device)
        except Exception:
            # One recording's pictures, or too many at once: each on its own, so that only what is at fault fails.
            answers = [_alone(request, detectors, device) for request in requests]
        for request, answer in zip(requests, answers, strict=True):
            request.answer = pickle.dumps(answer)
            request.done.set()


def _alone(request: _Request, detectors: dict[bytes, Any], device: str) -> dict[str, np.ndarray] | str:
    try:
        return _found([request], detectors, device)[0]
    except Exception as error:
        if "CUDA error" in str(error):  # after which nothing works in this process; the next one starts afresh
            os._exit(1)
        return f"{type(error).__name__}: {error}"


def _found(requests: Sequence[_Request], detectors: dict[bytes, Any], device: str) -> list[dict[str, np.ndarray]]:
    """What was found in the pictures of each request, searched as one batch."""
    from rmis_calib.vision import ShaftDetector

    known = requests[0].header.detector
    if known not in detectors:
        settings, camera = pickle.loads(known)
        detectors[known] = ShaftDetector(settings, None if camera is None else camera.to(device=device))
    pictures = [request.pictures(device) for request in requests]
    joined = pictures[0] if len(pictures) == 1 else torch.cat(pictures)
    images = joined.permute(0, 3, 1, 2)  # channels stay last in memory, as they were decoded
    places = [header.contour_n for header in (request.header for request in requests) if header.contour_n is not None]
    if places:
        found = detectors[known].look_near(images, torch.from_numpy(np.concatenate(places)))
    else:
        found = detectors[known].detect(images)
    sizes = [len(part) for part in pictures]
    parts = {name: value.cpu().split(sizes) for name, value in vars(found).items()}
    return [{name: part[i].numpy() for name, part in parts.items()} for i in range(len(requests))]


class _Process:
    """The process of a device, started again when it dies."""

    def __init__(self, device: str, most_frames: int, threads: int) -> None:
        name = f"rmis-calib-{os.getpid()}-{uuid.uuid4().hex}"
        # Linux has addresses that are no files, and end with the process.
        self.address = f"\0{name}" if sys.platform.startswith("linux") else f"/tmp/{name}"
        self._arguments = (self.address, device, most_frames, threads)
        self._threads = threads
        self._closing = threading.Event()
        self._process = self._start()
        self._watch = threading.Thread(target=self._keep_alive, daemon=True, name="rmis-device")
        self._watch.start()

    def _start(self) -> Any:
        context = multiprocessing.get_context("spawn")
        process = context.Process(target=serve, args=self._arguments, name="rmis-calib-device", daemon=True)
        with environment_of_threads(self._threads):
            process.start()
        return process

    def _keep_alive(self) -> None:
        while True:
            self._process.join()
            if self._closing.wait(_RESTART_S):
                return
            self._process = self._start()

    def close(self) -> None:
        self._closing.set()
        while self._watch.is_alive():  # it may just have started another
            self._process.kill()
            self._watch.join(0.1)


@contextlib.contextmanager
def device_services(devices: Sequence[str], most_frames: int, threads: int) -> Iterator[dict[str, str]]:
    """A process for each device while the block runs; their addresses by device.

    Args:
        devices: `cpu`, `cuda:0`, ...
        most_frames: of a batch.
        threads: of each process.
    """
    with contextlib.ExitStack() as stack:
        addresses = {}
        for device in devices:
            process = _Process(device, most_frames, threads)
            stack.callback(process.close)
            addresses[device] = process.address
        yield addresses


def key_of_batch() -> bytes:
    """Shared by all processes of a batch, and by nobody else."""
    return bytes(multiprocessing.current_process().authkey)
