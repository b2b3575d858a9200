"""A detector that has its pictures searched by the process that owns the device (`device_service.py`)."""

import mmap
import os
import pickle
import tempfile
import threading
import time
from dataclasses import replace
from multiprocessing.connection import Client, Connection
from multiprocessing.reduction import send_handle

import numpy as np
import torch
from torch import Tensor

from rmis_calib.errors import DeviceError, ShapeError
from rmis_calib.geometry import Camera
from rmis_calib.parallel.device_service import Header, key_of_batch
from rmis_calib.vision import DetectorSettings, ShaftDetections, ShaftDetector
from rmis_calib.vision.detector import checked_places

_ATTEMPTS = 3
_PATIENCE_S = 120.0
"""How long a device's process may take to start, libraries and all, on a machine that has much to do."""


class SharedDetector(ShaftDetector):
    """As `ShaftDetector`, but `detect` and `look_near` leave the work to the process that owns the device.

    Pictures are on the CPU. Each thread that calls has one request under way, and one buffer.
    """

    def __init__(self, service: "SharedDevice", settings: DetectorSettings, camera: Camera | None) -> None:
        super().__init__(settings, camera)
        self._service = service
        self._pickled = pickle.dumps((settings, camera))

    def detect(self, images: Tensor, masks: Tensor | None = None) -> ShaftDetections:
        """See `ShaftDetector.detect`; with masks there is little to search, and this process does it.

        Raises:
            ShapeError: as there, and pictures that are not uint8.
            DeviceError: the device's process died over these pictures each time, or does not come back.
            RuntimeError: what the search raised there, memory that ran out for instance.
        """
        if masks is not None:
            return super().detect(images, masks)
        return self._sent(images, None)

    def look_near(self, images: Tensor, contour_n: Tensor) -> ShaftDetections:
        """See `ShaftDetector.look_near`.

        Raises:
            ShapeError, DeviceError, RuntimeError: as `detect`.
        """
        checked_places(contour_n, images)
        return self._sent(images, contour_n.to("cpu", torch.float32).numpy())

    def _sent(self, images: Tensor, contour_n: np.ndarray | None) -> ShaftDetections:
        self._check(images)
        if images.dtype != torch.uint8:
            raise ShapeError(where="images", expected="uint8, as they were decoded", found=images.dtype)
        return self._service.search(self._pickled, images, contour_n)


class SharedDevice:
    """A worker's connections to the process that owns a device."""

    def __init__(self, address: str, device: str) -> None:
        """Keep the address; threads connect when they first ask.

        Args:
            address: from `device_services`.
            device: where the answers are wanted.
        """
        self._address, self._device = address, device
        self._of_thread = threading.local()

    def detector(self, settings: DetectorSettings, camera: Camera | None) -> SharedDetector:
        """A detector of a camera's pictures."""
        return SharedDetector(self, settings, camera)

    def search(self, detector: bytes, images: Tensor, contour_n: np.ndarray | None = None) -> ShaftDetections:
        """Send uint8 pictures (b, 3, h, w), and where to look in them, and wait for what was found.

        Raises:
            DeviceError, RuntimeError: see `SharedDetector.detect`.
        """
        for attempt in range(_ATTEMPTS):
            line: _Line | None = getattr(self._of_thread, "line", None)
            try:
                line = self._of_thread.line = line or _Line(self._address)
                answer = line.ask(detector, images, contour_n)
                break
            except (EOFError, OSError) as error:  # it died, or was killed; another one is being started
                if line is not None:
                    line.close()
                self._of_thread.line = None
                if attempt == _ATTEMPTS - 1:
                    expected, found = "an answer of the process that owns the device", f"it died {_ATTEMPTS} times"
                    raise DeviceError(where="device", expected=expected, found=found) from error
        if isinstance(answer, str):
            raise RuntimeError(answer)
        found = {name: torch.from_numpy(value).to(self._device) for name, value in answer.items()}
        return ShaftDetections(**found)


class _Line:
    """A connection with memory that both sides see."""

    def __init__(self, address: str) -> None:
        self._connection = _connected(address)
        self._memory: mmap.mmap | None = None

    def ask(self, detector: bytes, images: Tensor, contour_n: np.ndarray | None) -> dict[str, np.ndarray] | str:
        count, _, height, width = images.shape
        header = Header(detector, (count, height, width), 0, contour_n)
        handle = None
        if self._memory is None or len(self._memory) < header.size:
            header = replace(header, new_buffer=header.size)
            handle, self._memory = _shared_memory(header.size)
        shared = torch.frombuffer(self._memory, dtype=torch.uint8)
        shared[: header.size].view(count, height, width, 3).copy_(images.permute(0, 2, 3, 1))
        try:
            self._connection.send_bytes(pickle.dumps(header))
            if handle is not None:
                send_handle(self._connection, handle, None)
        finally:
            if handle is not None:
                os.close(handle)
        return pickle.loads(self._connection.recv_bytes())

    def close(self) -> None:
        self._connection.close()


def _connected(address: str) -> Connection:
    """A connection, as soon as the process listens.

    Raises:
        OSError: it does not.
    """
    until = time.monotonic() + _PATIENCE_S
    while True:
        try:
            return Client(address, authkey=key_of_batch())  # type: ignore[return-value]
        except (OSError, EOFError):
            if time.monotonic() > until:
                raise
            time.sleep(0.1)


def _shared_memory(size: int) -> tuple[int, mmap.mmap]:
    """Memory without a name, which ends with the last process that holds it, however that dies; and its handle."""
    if hasattr(os, "memfd_create"):
        handle = os.memfd_create("rmis-calib-pictures")
    else:
        with tempfile.TemporaryFile() as file:
            handle = os.dup(file.fileno())
    os.ftruncate(handle, size)
    return handle, mmap.mmap(handle, size)
