"""Detection over whole videos: what threads and thinning must not change."""

from pathlib import Path

import cv2
import numpy as np
import pytest
import torch

from rmis_calib.config import CalibrationConfig
from rmis_calib.errors import VideoError
from rmis_calib.pipeline import detect
from rmis_calib.vision import FrameReason

COUNT = 7


@pytest.fixture(scope="module")
def bars(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A dark bar that enters at the left and moves down from picture to picture."""
    folder = tmp_path_factory.mktemp("bars")
    noise = np.random.default_rng(3).normal(0.0, 1.5, (COUNT, 240, 320, 3))
    for frame in range(COUNT):
        picture = np.full((240, 320, 3), (90, 100, 190), np.float64)  # blue, green, red
        picture[80 + 6 * frame : 120 + 6 * frame, :220] = 40.0
        picture = cv2.GaussianBlur(picture, (0, 0), 1.0) + noise[frame]
        cv2.imwrite(str(folder / f"{frame:04d}.png"), picture.round().clip(0, 255).astype(np.uint8))
    return folder


@pytest.mark.parametrize(
    ("search_every", "told"), [(1, [(0, 7), (2, 7), (4, 7), (6, 7), (7, 7)]), (8, [(0, 7), (7, 7)])]
)
def test_every_picture_is_in_its_place(bars: Path, search_every: int, told: list[tuple[int, int]]) -> None:
    heard: list[tuple[int, int]] = []
    seen: list[int] = []
    table = detect(
        bars,
        CalibrationConfig(batch_size=2, search_every=search_every),
        lambda _, done, total: heard.append((done, total)),
        lambda batch: seen.extend(batch.frames.indices.tolist()),
    )
    found = table.views[0].detections
    assert found.valid[:, 0].all()
    middle = found.axis_xy[:, 0, :, 1].mean(-1)
    expected = 99.5 + 6.0 * torch.arange(COUNT)
    torch.testing.assert_close(middle, expected, rtol=0, atol=0.1)  # px; measured 0.03
    assert heard == told
    assert seen == list(range(COUNT))


def test_thinning_leaves_frames_out_and_changes_no_other(bars: Path) -> None:
    everything = detect(bars, CalibrationConfig(batch_size=1, search_every=1)).views[0].detections
    table = detect(bars, CalibrationConfig(batch_size=1, search_every=1, every=3))
    thinned = table.views[0].detections
    for name, value in vars(thinned).items():
        torch.testing.assert_close(value[::3], getattr(everything, name)[::3], rtol=0, atol=0, equal_nan=True)
    left_out = torch.arange(COUNT) % 3 > 0
    assert not thinned.valid[left_out].any()
    assert (thinned.reason[left_out] == FrameReason.LEFT_OUT).all()
    assert table.rows()[0] == ("pictures", "3 of 3 frames with a shaft")


def test_the_number_of_torch_threads_is_left_as_it_was(bars: Path) -> None:
    before = torch.get_num_threads()
    detect(bars)
    assert torch.get_num_threads() == before


def test_a_broken_picture_stops_the_work(bars: Path, tmp_path: Path) -> None:
    for path in bars.iterdir():
        data = path.read_bytes()
        (tmp_path / path.name).write_bytes(data[: len(data) // 2] if path.name == "0005.png" else data)
    with pytest.raises(VideoError, match=r"0005\.png"):
        detect(tmp_path, CalibrationConfig(batch_size=2))
