"""Dark straight things that are no shaft (a chessboard, tape), and a shaft before them, or lost in the dark."""

import numpy as np
import pytest
import torch
from drawn_bars import draw_bar
from scipy.special import ndtr

from rmis_calib.vision import DetectorSettings, ShaftDetector

SIZE = (480, 640)
DARK, BRIGHT = 45.0, 205.0


@pytest.fixture(scope="module")
def detector() -> ShaftDetector:
    return ShaftDetector(DetectorSettings())


def places(angle_deg: float) -> tuple[np.ndarray, np.ndarray]:
    """Along and across an axis through the middle of the picture, px, (h, w) each."""
    v, u = np.mgrid[: SIZE[0], : SIZE[1]].astype(float)
    angle = np.deg2rad(angle_deg)
    x, y = u - SIZE[1] / 2, v - SIZE[0] / 2
    return x * np.cos(angle) + y * np.sin(angle), y * np.cos(angle) - x * np.sin(angle)


def chessboard(angle_deg: float, square_px: float, columns: int, rows: int) -> np.ndarray:
    """(h, w, 3) bytes: squares on a bright sheet that fills the picture, edges a pixel soft."""
    x, y = places(angle_deg)
    waves = [np.sin(np.pi * (c / square_px + 0.5 * (n % 2))) for c, n in ((x, columns), (y, rows))]
    sign = np.clip(square_px * waves[0], -1, 1) * np.clip(square_px * waves[1], -1, 1)
    on_board = (abs(x) < columns * square_px / 2) & (abs(y) < rows * square_px / 2)
    grey = np.where(on_board & (sign > 0), DARK, BRIGHT)
    noise = np.random.default_rng(4).normal(0.0, 2.0, (*SIZE, 3))
    return np.clip(grey[..., None] + noise, 0, 255).astype(np.uint8)


def batch(picture: np.ndarray) -> torch.Tensor:
    return torch.from_numpy(picture).permute(2, 0, 1)[None].contiguous()


@pytest.mark.parametrize("angle_deg", [0.0, 11.0, 38.0, 83.0])
@pytest.mark.parametrize(("square_px", "columns", "rows"), [(62.0, 6, 5), (45.0, 9, 6), (70.0, 14, 11)])
def test_squares_of_a_chessboard_are_not_shafts(
    detector: ShaftDetector, angle_deg: float, square_px: float, columns: int, rows: int
) -> None:
    """Also of one that the picture's border cuts."""
    found = detector.detect(batch(chessboard(angle_deg, square_px, columns, rows)))
    assert not bool((found.confidence[found.valid] > 0.5).any())


@pytest.mark.parametrize("angle_deg", [20.0, 115.0, 250.0])
def test_a_shaft_over_a_chessboard_is_the_first_candidate(detector: ShaftDetector, angle_deg: float) -> None:
    board, bar = chessboard(8.0, 62.0, 6, 5), draw_bar(angle_deg, end_px=60.0, width_px=52.0)
    ends = abs(bar.image.astype(float) - [170.0, 110.0, 100.0]).sum(-1, keepdims=True) > 40
    found = detector.detect(batch(np.where(ends, bar.image, board)))
    assert bool(found.valid[0, 0])
    points = found.contour_xy[0, 0].double().numpy()
    across = (points - bar.centre) @ bar.left
    assert np.abs(np.abs(across) - bar.width_px / 2).max() < 1.5
    assert not bool((found.confidence[0, 1:][found.valid[0, 1:]] > 0.5).any())


def test_tape_that_ends_before_the_border_is_not_sure(detector: ShaftDetector) -> None:
    x, y = places(31.0)
    cover = ndtr(40 - abs(y)) * ndtr(130 - abs(x))
    noise = np.random.default_rng(4).normal(0.0, 2.0, (*SIZE, 3))
    grey = BRIGHT + (DARK - BRIGHT) * cover[..., None]
    found = detector.detect(batch(np.clip(grey + noise, 0, 255).astype(np.uint8)))
    assert not bool((found.confidence[found.valid] > 0.5).any())


def test_a_shaft_that_comes_out_of_the_dark_comes_from_the_border(detector: ShaftDetector) -> None:
    """A quarter of the picture is dark, and the shaft before it without contours; which way its tip is is known."""
    bar = draw_bar(10.0, end_px=150.0, noise_levels=1.0)
    x = np.arange(SIZE[1])[None, :, None]
    light = ndtr((x - 150.0) / 4)  # the lamp does not reach the rest, nor the shaft there
    picture = np.clip(16.0 + (bar.image - 16.0) * light, 0, 255).astype(np.uint8)
    found = detector.detect(batch(picture))
    assert bool(found.valid[0, 0]) and bool(found.direction_known[0, 0])
    assert float(found.confidence[0, 0]) > 0.7
    axis = found.axis_xy[0, 0].double().numpy()
    assert (axis[1] - axis[0]) @ bar.along > 0
