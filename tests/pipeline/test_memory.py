"""Memory between the frames of a video: what it finds is what a search of every frame finds, whatever happens."""

import dataclasses
from collections.abc import Iterator
from pathlib import Path

import cv2
import numpy as np
import pytest
import torch

from data_synth import load_synth_config
from data_synth.render import Renderer
from data_synth.settings import MotionSettings
from data_synth.truth import SideTruth, side_truth
from data_synth.world import build_world
from rmis_calib.config import CalibrationConfig
from rmis_calib.geometry import Camera
from rmis_calib.io import FrameBatch
from rmis_calib.pipeline import detect
from rmis_calib.pipeline.pictures.memory import RUN, detect_run, in_runs
from rmis_calib.vision import FrameReason, ShaftDetections, ShaftDetector
from tests.vision.drawn_bars import draw_bar

COUNT, EVERY = 25, 8
STEEL = (190.0, 190.0, 195.0)
SEARCHED = {0, 8, 16, 24}


class Watched(ShaftDetector):
    """Tells which pictures it searched from the start, by the number in their first pixel."""

    def __init__(self, camera: Camera | None = None) -> None:
        super().__init__(camera=camera)
        self.searched: set[int] = set()

    def detect(self, images: torch.Tensor, masks: torch.Tensor | None = None) -> ShaftDetections:
        self.searched |= set(images[:, 0, 0, 0].tolist())
        return super().detect(images, masks)


def numbered(pictures: list[np.ndarray] | torch.Tensor) -> torch.Tensor:
    """(n, 3, h, w), channels last in memory, each with its number in the first pixel."""
    images = torch.stack([torch.as_tensor(picture) for picture in pictures]).permute(0, 3, 1, 2)
    images[:, :, 0, 0] = torch.arange(len(images), dtype=torch.uint8)[:, None]
    return images


def bar(place: float) -> tuple[float, float]:
    """Angle, deg, and offset, px, of a bar that moves smoothly; `place` counts frames."""
    return 25.0 + 0.4 * place + 0.01 * place**2, 1.5 * place + 0.3


def drawn(place: float, noise: int = 0) -> np.ndarray:
    angle, offset = bar(place)
    size = (240, 320)
    return draw_bar(
        angle, size=size, width_px=30, end_px=60, offset_px=offset, noise_levels=2, wrist=STEEL, seed=noise
    ).image


def empty(noise: int) -> np.ndarray:
    return draw_bar(size=(240, 320), end_px=-1000, noise_levels=2, seed=noise).image


def off_px(found: ShaftDetections, frame: int, rank: int, place: float) -> float:
    """Largest distance of the contour points from the bar as it was drawn; 0.24 where its steel shines through."""
    angle, offset = bar(place)
    truth = draw_bar(angle, size=(240, 320), width_px=30, end_px=60, offset_px=offset)
    across = (found.contour_xy[frame, rank].double().numpy() - truth.centre) @ truth.left
    return float(np.abs(np.abs(across) - 15.0).max())


def off_lines(found: ShaftDetections, full: ShaftDetections) -> torch.Tensor:
    """(b, k) largest distance of one's contour points from the other's contours, px."""
    first, second = full.contour_xy.unbind(3)
    along = torch.nn.functional.normalize(second - first, dim=-1)[:, :, :, None]
    away = found.contour_xy - first[:, :, :, None]
    return (away[..., 0] * along[..., 1] - away[..., 1] * along[..., 0]).abs().amax((2, 3))


def check_as_searched(images: torch.Tensor) -> tuple[ShaftDetections, set[int]]:
    """What memory gives, and what it searched, after a comparison with a search of every picture."""
    watched = Watched()
    found = detect_run(watched, images, EVERY, 8)
    full = ShaftDetector().detect(images)
    assert found.valid.sum(1).tolist() == full.valid.sum(1).tolist()
    assert torch.equal(found.reason, full.reason)
    assert off_lines(found, full)[full.valid].max() < 0.1
    torch.testing.assert_close(found.confidence, full.confidence, rtol=0, atol=0.05, equal_nan=True)
    assert torch.equal(found.end_valid, full.end_valid)
    return found, watched.searched


def test_smooth_motion_is_searched_once_in_eight_frames() -> None:
    found, searched = check_as_searched(numbered([drawn(i, i) for i in range(COUNT)]))
    assert searched == SEARCHED
    assert max(off_px(found, i, 0, i) for i in range(COUNT)) < 0.3


def test_a_cut_is_noticed() -> None:
    places = [i if i < 11 else i + 60 for i in range(COUNT)]  # 90 px further, and turned
    found, searched = check_as_searched(numbered([drawn(place, i) for i, place in enumerate(places)]))
    assert set(range(8, 17)) <= searched
    assert max(off_px(found, i, 0, place) for i, place in enumerate(places)) < 0.3


@pytest.mark.parametrize("jump", [0.4, 12.0, -20.0])
def test_a_jump_of_one_frame_is_found_where_it_is(jump: float) -> None:
    places = [float(i) for i in range(COUNT)]
    places[12] += jump
    found, searched = check_as_searched(numbered([drawn(place, i) for i, place in enumerate(places)]))
    assert searched - SEARCHED == ({12} if abs(jump) > 1 else set())
    assert off_px(found, 12, 0, places[12]) < 0.3


@pytest.mark.parametrize("hidden", [range(11, 14), range(15, 18), range(16, 17)])
def test_a_shaft_that_is_hidden_is_found_again_at_once(hidden: range) -> None:
    pictures = [empty(i) if i in hidden else drawn(i, i) for i in range(COUNT)]
    found, searched = check_as_searched(numbered(pictures))
    assert set(hidden) <= searched
    assert found.valid.any(1).tolist() == [i not in hidden for i in range(COUNT)]


def test_a_shaft_that_leaves_and_one_that_enters_beside_another() -> None:
    pictures = []
    for i in range(COUNT):
        picture = drawn(i / 4, i)
        if i < 5 or i > 18:  # another one at the right, upright
            other = draw_bar(90, size=(240, 320), width_px=30, end_px=0, noise_levels=2, seed=i).image
            picture = np.minimum(picture, np.roll(other, 130, 1))
        pictures.append(picture)
    found, searched = check_as_searched(numbered(pictures))
    assert set(range(9)) | set(range(16, 25)) <= searched
    assert found.valid.sum(1).tolist() == [2 if i < 5 or i > 18 else 1 for i in range(COUNT)]


def test_nothing_between_two_empty_pictures_is_taken_for_granted() -> None:
    pictures = [drawn(i, i) if 10 <= i < 14 else empty(i) for i in range(COUNT)]
    found, searched = check_as_searched(numbered(pictures))
    assert searched == set(range(COUNT))
    assert found.valid.any(1).nonzero()[:, 0].tolist() == [10, 11, 12, 13]


@pytest.fixture(scope="module")
def video() -> Iterator[tuple[torch.Tensor, SideTruth, Camera]]:
    """Rendered continuous video, with the truth from poses."""
    config = load_synth_config("two_instruments")
    config = dataclasses.replace(
        config,
        camera=dataclasses.replace(config.camera, left=None),
        motion=dataclasses.replace(MotionSettings(), kind="smooth"),
        motions=18,
    )
    world = build_world(config)
    own = world.cameras["right"]
    camera = Camera.from_values(own.fx, own.fy, own.cx, own.cy, own.distortion, image_size=(own.height, own.width))
    yield numbered(Renderer(world).render("right", np.arange(18))), side_truth(world, "right"), camera


def errors_px(found: ShaftDetections, truth: SideTruth, focal: float) -> np.ndarray:
    """(frames, shafts) of the nearest candidate to each true shaft: largest distance of its points from the lines."""
    points = np.concatenate([found.contour_xy.double().numpy(), np.ones((*found.valid.shape, 2, 2, 1))], -1)
    errors = []
    for shaft in (truth, *truth.others):
        lines = shaft.n_contour[: len(points)]
        lines = lines / np.linalg.norm(lines[..., :2], axis=-1, keepdims=True)
        off = np.abs(np.einsum("fkepi,fei->fkep", points, lines)).max((2, 3))
        errors.append(np.nanmin(off, 1))
    return focal * np.stack(errors, 1)


def test_rendered_video_is_measured_as_well_as_by_searching(video: tuple[torch.Tensor, SideTruth, Camera]) -> None:
    images, truth, camera = video
    focal = float(camera.focal)
    watched, full = Watched(camera), ShaftDetector(camera=camera).detect(images)
    found = detect_run(watched, images, EVERY, 8)
    assert len(watched.searched) == 4  # 0, 6, 11, 17
    with_memory, searched = errors_px(found, truth, focal), errors_px(full, truth, focal)
    visible = np.stack([shaft.visible for shaft in (truth, *truth.others)], 1)
    with_memory, searched = with_memory[visible], searched[visible]
    assert with_memory.size == 36
    assert with_memory.max() < 0.3
    assert np.sqrt((with_memory**2).mean()) < 1.1 * np.sqrt((searched**2).mean())
    assert found.end_valid.sum() == full.end_valid.sum()
    assert torch.equal(found.end_kind, full.end_kind)
    torch.testing.assert_close(found.confidence, full.confidence, rtol=0, atol=0.01, equal_nan=True)


def test_batches_and_threads_change_no_bit(video: tuple[torch.Tensor, SideTruth, Camera], tmp_path: Path) -> None:
    images, _, _ = video
    for i in range(40):  # back and forth: two runs
        picture = images[i % 18 if i < 18 else 34 - i if i < 35 else i - 35].permute(1, 2, 0).numpy()
        cv2.imwrite(str(tmp_path / f"{i:03d}.png"), picture[::2, ::2, ::-1])
    first, other = (vars(detect(tmp_path, CalibrationConfig(batch_size=size)).views[0].detections) for size in (5, 64))
    assert bool(first["valid"].any(1).all())
    for name, value in first.items():
        torch.testing.assert_close(other[name], value, rtol=0, atol=0, equal_nan=True)


@pytest.mark.parametrize("size", [1, 5, 32, 33, 100])
def test_runs_hold_every_picture_once(size: int) -> None:
    pictures = torch.arange(70, dtype=torch.uint8)[:, None, None, None].repeat(1, 2, 2, 3).permute(0, 3, 1, 2)
    batches = (FrameBatch(3 * torch.arange(70)[i : i + size], pictures[i : i + size]) for i in range(0, 70, size))
    runs = list(in_runs(batches))
    assert [len(run.indices) for run in runs] == [RUN, RUN, 6]
    assert all(run.images.is_contiguous(memory_format=torch.channels_last) for run in runs)  # else all is slow
    assert torch.cat([run.indices for run in runs]).tolist() == list(range(0, 210, 3))
    assert torch.equal(torch.cat([run.images for run in runs]), pictures)


def test_it_can_be_turned_off(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    for i in range(12):
        cv2.imwrite(str(tmp_path / f"{i:03d}.png"), drawn(i, i))
    monkeypatch.setattr(ShaftDetector, "look_near", lambda *_: pytest.fail("looked where a shaft was expected"))
    found = detect(tmp_path, CalibrationConfig(search_every=1)).views[0].detections
    assert bool((found.reason == FrameReason.OK).all())
    with pytest.raises(pytest.fail.Exception):
        detect(tmp_path)
