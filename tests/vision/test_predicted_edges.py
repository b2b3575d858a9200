"""Edges near given contours: where drawn bars put them, with a true sigma, and none where there is none."""

import numpy as np
import pytest
import torch
from drawn_bars import draw_bar

from rmis_calib.geometry.cameras import Camera
from rmis_calib.vision.fine.predicted_edges import edges_at

CAMERA = Camera.from_values(700.0, 700.0, 320.0, 240.0, image_size=(480, 640))


def stations(bar, off_px=(0.0, 0.0), width_px=None, count=24):
    """Along both contours of the bar, or beside them: (1, 2, s, 2), normalised."""
    along = np.linspace(-150.0, 80.0, count)
    half = 0.5 * (width_px or bar.width_px)
    places = [half + off_px[0], -half - off_px[1]]
    uv = np.stack([bar.centre + along[:, None] * bar.along + y * bar.left for y in places])
    return torch.from_numpy((uv - [320.0, 240.0]) / 700.0)[None]


@pytest.mark.parametrize("angle_deg", [25.0, -70.0, 170.0])
def test_offsets_are_signed_outwards_and_exact(angle_deg):
    bar = draw_bar(angle_deg, blur_px=0.9)
    found = edges_at(bar.batch, CAMERA, stations(bar, off_px=(-3.3, 2.4)))
    off = found.px[0].nanmedian(-1).values.tolist()
    assert off == pytest.approx([3.3, -2.4], abs=0.05)
    assert torch.isfinite(found.px).float().mean() > 0.95


def test_sigma_is_that_of_the_noise():
    """The scatter of many stations in noise is what they claim."""
    bar = draw_bar(20.0, noise_levels=8.0, inside=(60.0, 60.0, 60.0), outside=(120.0, 110.0, 100.0))
    found = edges_at(bar.batch, CAMERA, stations(bar, count=240))
    known = torch.isfinite(found.px)
    z = (found.px / found.sigma_px)[known]
    assert known.float().mean() > 0.8
    assert 1.4826 * float(z.abs().median()) == pytest.approx(1.0, abs=0.3)


def test_noise_alone_a_step_of_the_wrong_sign_and_what_is_out_of_view_are_no_edges():
    bar = draw_bar(25.0, noise_levels=4.0)
    beside = stations(bar, off_px=(60.0, 60.0), count=240)
    assert torch.isfinite(edges_at(bar.batch, CAMERA, beside).px).float().mean() < 0.1
    light = draw_bar(25.0, inside=(170.0, 110.0, 100.0), outside=(40.0, 42.0, 45.0))
    assert not torch.isfinite(edges_at(light.batch, CAMERA, stations(light)).px).any()
    out = edges_at(bar.batch, CAMERA, stations(bar) + 2.0)
    assert not out.looked.any() and not torch.isfinite(out.px).any()


def test_no_station_is_no_edge():
    bar = draw_bar()
    found = edges_at(bar.batch, CAMERA, torch.full((1, 2, 24, 2), torch.nan, dtype=torch.float64))
    assert not found.looked.any() and not torch.isfinite(found.px).any()
