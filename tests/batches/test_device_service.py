"""One process that searches the pictures of many: its answers, what it puts together, and what happens when it dies."""

import os
import pickle
import signal
from collections.abc import Iterator
from concurrent.futures import ThreadPoolExecutor
from contextlib import suppress
from pathlib import Path

import numpy as np
import pytest
import torch

from data_synth import load_synth_config
from data_synth.render import Renderer
from data_synth.world import build_world
from rmis_calib.errors import DeviceError, ShapeError
from rmis_calib.geometry.lines import line_through_points
from rmis_calib.parallel import shared_detector
from rmis_calib.parallel.device_service import Header, _Line, _Request, device_services
from rmis_calib.parallel.shared_detector import SharedDevice
from rmis_calib.vision import DetectorSettings, ShaftDetections, ShaftDetector


@pytest.fixture(scope="module", autouse=True)
def one_thread() -> Iterator[None]:
    """As the service has: sums over several threads are split by their size."""
    threads = torch.get_num_threads()
    torch.set_num_threads(1)
    yield
    torch.set_num_threads(threads)


@pytest.fixture(scope="module")
def address() -> Iterator[str]:
    with device_services(["cpu"], 16, 1) as addresses:
        yield addresses["cpu"]


@pytest.fixture(scope="module")
def pictures() -> torch.Tensor:
    """Six pictures (b, 3, h, w), channels last in memory as they are decoded."""
    world = build_world(load_synth_config({"motions": 6}))
    return Renderer(world).render("right", np.arange(6)).movedim(-1, 1)[:, :, :240, :320]


def same(found: ShaftDetections, other: ShaftDetections) -> bool:
    return all(
        torch.equal(torch.nan_to_num(value, nan=-1e9), torch.nan_to_num(getattr(other, name), nan=-1e9))
        for name, value in vars(found).items()
    )


def request(kind: bytes, frames: int, width: int = 320) -> _Request:
    return _Request(Header(kind, (frames, 240, width), 0), torch.empty(0, dtype=torch.uint8))


def test_what_waits_goes_together_if_it_is_alike_and_not_too_much() -> None:
    line = _Line(16)
    first, other, small, second, third = (
        request(b"one", 8), request(b"two", 8), request(b"one", 8, 160), request(b"one", 8), request(b"one", 4),
    )  # fmt: skip
    for one in (first, other, small, second, third):
        line.add(one)
    assert line.take() == [first, second]
    assert line.take() == [other]
    line.add(request(b"two", 40))
    assert line.take() == [small]
    assert line.take() == [third]
    assert [one.header.shape[0] for one in line.take()] == [40]  # too many for a batch, but they were sent as one


def test_many_at_once_get_what_each_would_find_alone(address: str, pictures: torch.Tensor) -> None:
    device = SharedDevice(address, "cpu")
    parts = [pictures[i : i + n] for i, n in ((0, 3), (3, 1), (2, 4), (0, 6), (5, 1), (1, 2))]
    with ThreadPoolExecutor(6) as executor:
        detector = device.detector(DetectorSettings(), None)
        together = list(executor.map(detector.detect, parts * 2))
    alone = [ShaftDetector().detect(part) for part in parts]
    assert bool(alone[3].valid.any())
    assert all(map(same, together, alone * 2))
    with pytest.raises(ShapeError, match="uint8"):
        detector.detect(pictures.float() / 255.0)


def test_places_to_look_at_travel_with_the_pictures(address: str, pictures: torch.Tensor) -> None:
    detector = SharedDevice(address, "cpu").detector(DetectorSettings(), None)
    xy = ShaftDetector().detect(pictures).contour_xy
    places = line_through_points(xy[..., 0, :], xy[..., 1, :])
    with ThreadPoolExecutor(6) as executor:  # searches, and looks at places, wait beside each other
        searched = [executor.submit(detector.detect, pictures[i : i + 2]) for i in (0, 2)]
        looked = [executor.submit(detector.look_near, pictures[i : i + 3], places[i : i + 3]) for i in (0, 2, 3, 1)]
    assert all(
        same(f.result(), ShaftDetector().detect(pictures[i : i + 2])) for f, i in zip(searched, (0, 2), strict=True)
    )
    alone = [ShaftDetector().look_near(pictures[i : i + 3], places[i : i + 3]) for i in (0, 2, 3, 1)]
    assert bool(alone[0].valid.any())
    assert all(same(f.result(), own) for f, own in zip(looked, alone, strict=True))
    with pytest.raises(ShapeError, match="contour_n"):
        detector.look_near(pictures, places[:2])


def test_an_error_is_told_to_whom_it_belongs(address: str, pictures: torch.Tensor) -> None:
    device = SharedDevice(address, "cpu")
    broken = pickle.dumps((DetectorSettings(), None))[:-5]
    with ThreadPoolExecutor(2) as executor:
        bad = executor.submit(device.search, broken, pictures)
        well = executor.submit(device.detector(DetectorSettings(), None).detect, pictures)
        assert bool(well.result().valid.any())
        with pytest.raises(RuntimeError, match="UnpicklingError|EOFError|truncated"):
            bad.result()


def test_killed_it_is_started_again_and_asked_again(pictures: torch.Tensor, monkeypatch: pytest.MonkeyPatch) -> None:
    others = processes()
    with device_services(["cpu"], 16, 1) as addresses:
        detector = SharedDevice(addresses["cpu"], "cpu").detector(DetectorSettings(), None)
        before = detector.detect(pictures[:2])
        (own,) = processes() - others
        os.kill(own, signal.SIGKILL)
        assert same(detector.detect(pictures[:2]), before)
    assert processes() == others
    monkeypatch.setattr(shared_detector, "_PATIENCE_S", 0.3)
    with pytest.raises(DeviceError, match="it died 3 times"):
        detector.detect(pictures[:1])


def processes() -> set[int]:
    """Processes that this one has started and that are at work."""
    found = set()
    for task in Path("/proc/self/task").iterdir():
        with suppress(FileNotFoundError, ProcessLookupError):  # a thread that has ended, or a process
            for pid in (task / "children").read_text().split():
                if b"spawn_main" in Path(f"/proc/{pid}/cmdline").read_bytes():  # empty of a dead one
                    found.add(int(pid))
    return found
