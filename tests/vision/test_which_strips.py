"""Which strips may be shafts: room for a second shaft beside a plain one, and what the network's word counts for."""

import dataclasses

import numpy as np
import pytest
import torch
from drawn_bars import Bar, draw_bar

from rmis_calib.vision import DetectorSettings, ShaftDetector
from rmis_calib.vision.coarse import scoring
from rmis_calib.vision.coarse.search import StripCandidates, search, small_views
from rmis_calib.vision.coarse.strips import Strips
from rmis_calib.vision.fine import confidence, measurement
from rmis_calib.vision.image.canvas import plan_canvas
from rmis_calib.vision.image.pixel_mapping import Lens

KEPT = 20


def near(bar: Bar, count: int, off_px: float) -> tuple[torch.Tensor, ...]:
    """Origin, direction and contours of strips on a bar, each one a little beside the one before."""
    shift = torch.linspace(-off_px, off_px, count)[:, None] * torch.tensor(bar.left)
    origin = torch.tensor(bar.centre) + shift
    half = bar.width_px / 2
    return origin, torch.tensor(bar.along).expand(count, 2), torch.tensor([half, -half]).expand(count, 2)


def test_a_plain_shaft_leaves_room_for_a_short_one() -> None:
    long, short = draw_bar(90.0, offset_px=-160.0, width_px=60.0, end_px=230.0), draw_bar(90.0, offset_px=200.0)
    both = np.minimum(long.image, draw_bar(90.0, offset_px=200.0, end_px=-100.0).image)
    images = torch.from_numpy(both).permute(2, 0, 1)[None].contiguous()
    settings = DetectorSettings()
    canvas = plan_canvas((480, 640), 2, Lens(None), images.device)
    picture = small_views(images, canvas, settings, 1).picture
    listed = [torch.cat(each).float()[None] for each in zip(near(long, 60, 4.0), near(short, 3, 2.0), strict=True)]
    origin, along, offset = listed
    middle = torch.tensor(canvas.centre)
    station = ((middle - origin) * along).sum(-1, keepdim=True)
    strips = Strips(
        frame=torch.zeros(1, 63, dtype=torch.int64),
        origin=origin + station * along,
        along=along,
        offset=offset,
        slope=torch.zeros_like(offset),
        valid=torch.ones(1, 63, dtype=torch.bool),
    )
    kept = scoring.screen(picture, strips, settings, KEPT).origin[0, :, 0]
    assert kept.shape == (KEPT,)
    on_short = (kept - short.centre[0]).abs() < 10
    assert int(on_short.sum()) == 3
    assert int(((kept - long.centre[0]).abs() < 10).sum()) == KEPT - 3


@pytest.fixture(scope="module")
def drawn() -> tuple[torch.Tensor, StripCandidates, ShaftDetector]:
    """A picture of one shaft, and its strips in both views."""
    images, detector = draw_bar(25.0, blur_px=2.0).batch, ShaftDetector()
    canvas = plan_canvas((480, 640), 2, detector.lens, images.device)
    with torch.inference_mode():
        found, _ = search(images, canvas, detector.settings, 2)
    return images, found, detector


def certain(drawn: tuple, network: float, lit: bool, tint: float) -> float:
    """Confidence of the best strip, were the network's word, its view and its tint these."""
    images, found, detector = drawn
    verdict = dataclasses.replace(found.verdict, shaft=torch.full_like(found.verdict.shaft, network))
    trace = dataclasses.replace(found.trace, tint=torch.full_like(found.trace.tint, tint))
    changed = dataclasses.replace(found, verdict=verdict, trace=trace, lit=torch.full_like(found.lit, lit))
    with torch.inference_mode():
        return float(measurement.measure(images, changed, detector.lens, detector.settings).certain[0, 0])


def test_the_network_speaks_for_any_strip_and_against_those_that_may_deceive(drawn: tuple) -> None:
    plain, lit, red = ((False, 0.0), (True, 0.0), (False, 0.6))
    assert certain(drawn, 8.0, *plain) > certain(drawn, 2.0, *plain)
    # In the dark view, of a grey strip, its refusal counts for nothing.
    assert certain(drawn, -5.0, *plain) == certain(drawn, 2.0, *plain)
    for kind in (lit, red):
        assert certain(drawn, -1.0, *kind) < certain(drawn, 5.0, *kind)


def test_a_short_piece_is_plausible_where_the_network_is_sure(drawn: tuple) -> None:
    images, found, detector = drawn
    with torch.inference_mode():
        strips = measurement.measure(images, found, detector.lens, detector.settings)
        short = dataclasses.replace(strips.trace, length=0.5 * strips.trace.width)
        share = torch.ones_like(strips.certain)
        reach = float(np.hypot(*images.shape[-2:]))
        said = [confidence.plausible(short, strips.fit, share, reach, torch.full_like(share, n)) for n in (5.0, 7.0)]
    assert not bool(said[0].any())
    assert bool(said[1].all())
