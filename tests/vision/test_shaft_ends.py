"""The end of a shaft is measured where the tube ends, whatever is fixed on it before that."""

import numpy as np
import pytest
import torch
from scipy.special import ndtr
from torch import Tensor

from rmis_calib.vision.coarse.strips import Strips
from rmis_calib.vision.fine.ends import locate
from rmis_calib.vision.image.pixel_mapping import Lens
from rmis_calib.vision.image.sampling import FullPicture
from tests.vision.drawn_bars import Bar, draw_bar

STUB = 0.4
"""Length of the tube that shows beyond the ball, widths."""


def with_ball(bar: Bar, colour: tuple[float, float, float]) -> Tensor:
    """The bar's picture with a ball of 2.4 widths over it, which leaves a stub of the tube before its end."""
    height, width = bar.image.shape[:2]
    u, v = np.meshgrid(np.arange(width, dtype=float), np.arange(height, dtype=float))
    radius = 1.2 * bar.width_px
    centre = bar.centre + (bar.end_px - STUB * bar.width_px - radius) * bar.along
    cover = ndtr((radius - np.hypot(u - centre[0], v - centre[1])) / 0.7)[..., None]
    image = bar.image * (1 - cover) + np.array(colour) * cover
    return torch.from_numpy(np.round(image).astype(np.uint8)).permute(2, 0, 1)[None]


def strip_of(bar: Bar) -> Strips:
    """The strip between the true contours, walked towards the tip from the bar's centre."""
    half = torch.tensor([[[0.5 * bar.width_px, -0.5 * bar.width_px]]], dtype=torch.float32)
    origin, along = (torch.tensor(x, dtype=torch.float32)[None, None] for x in (bar.centre, bar.along))
    np.testing.assert_allclose([bar.along[1], -bar.along[0]], bar.left)
    valid = torch.ones(1, 1, dtype=torch.bool)
    return Strips(torch.zeros(1, 1, dtype=torch.int64), origin, along, half, torch.zeros_like(half), valid)


@pytest.mark.parametrize("colour", [(210.0, 60.0, 55.0), (235.0, 235.0, 230.0), (60.0, 160.0, 80.0)])
@pytest.mark.parametrize("off", [-4.0, 3.0])
def test_the_end_beyond_a_ball_is_measured_at_the_tube_and_not_at_the_ball(colour, off):
    bar = draw_bar(noise_levels=1.5, wrist=(190.0, 190.0, 185.0))
    picture = FullPicture(with_ball(bar, colour), torch.zeros(1, 1, dtype=torch.int64), Lens(None))
    one = torch.ones(1, 1)
    near = one * (bar.end_px + off)
    end = locate(picture, strip_of(bar), near, 4.0 * one, bar.width_px * one, 0.7 * one, 0.05)
    assert bool(end.valid)
    assert float(end.t) == pytest.approx(bar.end_px, abs=0.5)
    assert float(end.sigma_px) < 0.5
