"""Painted strips: the same seed gives the same strips, and colours change where the truth says that the tube ends."""

import pytest
import torch

from data_synth import paint_strips
from data_synth.strips import PaintedStrips

ALONG = 128


def strips(seed: int, count: int) -> PaintedStrips:
    backgrounds = torch.rand(4, 3, 30, 40, generator=torch.Generator().manual_seed(1))
    backgrounds = torch.nn.functional.interpolate(backgrounds, size=(240, 320), mode="bilinear")
    return paint_strips(backgrounds, count, torch.Generator().manual_seed(seed))


@pytest.fixture(scope="module")
def made() -> PaintedStrips:
    return strips(5, 256)


def test_same_seed_same_strips_another_seed_others():
    first, again, other = strips(5, 16), strips(5, 16), strips(6, 16)
    assert all(torch.equal(value, getattr(again, name)) for name, value in vars(first).items())
    assert not torch.equal(first.picture, other.picture)
    assert first.picture.shape == (16, 3, 24, ALONG) and first.picture.dtype == torch.float32
    assert float(first.picture.amin()) >= 0 and float(first.picture.amax()) <= 1


def test_every_kind_of_strip_is_there(made):
    inside = made.end < ALONG
    for share in (made.fits, made.ring, inside):
        assert 0.1 < float(share.float().mean()) < 0.95
    assert 0.02 < float(made.hidden.float().mean()) < 0.2
    assert bool(inside[made.hidden].all())


def test_ends_in_view_lie_in_the_field_of_view_and_some_tube_before_them(made):
    inside = (made.end < ALONG) & made.fits
    middle = made.known[inside, 12]
    column = made.end[inside].long()
    assert bool((middle.gather(1, column[:, None]) == 1).all())
    assert bool((middle.gather(1, column[:, None] - 2) == 1).all())


def test_colours_change_at_the_end_and_not_before_it(made):
    """On the middle rows: over two columns about the end far more than over two columns within the tube, typically."""
    clear = made.fits & ~made.hidden & (made.end > 20) & (made.end < ALONG - 6)
    rows = made.picture[clear, :, 9:15].mean(2)  # (m, 3, along)
    end = made.end[clear].round().long()

    def change(at: torch.Tensor) -> torch.Tensor:
        before, after = (rows.gather(2, (at + k)[:, None, None].expand(-1, 3, 1)) for k in (-2, 2))
        return (after - before).abs().amax((1, 2))

    there, within = change(end), change(end - 8)
    assert int(clear.sum()) > 80
    assert float(there.median()) > 4 * float(within.median())
    assert float((there > within).float().mean()) > 0.9


def test_contours_that_fit_lie_half_a_width_from_the_middle(made):
    """Where the tube lies, the colour changes most across the strip at either contour, on average over all strips."""
    tube = torch.arange(ALONG) < made.end[:, None] - 4
    clear = made.fits & (made.end > 30)
    step = made.picture.diff(dim=2).abs().mean(1) * tube[:, None]  # (m, 23, along): i lies between rows i and i + 1
    step = step[clear].sum(2)
    profile = (step / step.sum(1, keepdim=True)).mean(0)
    lateral = torch.linspace(1, -1, 24)
    place = 0.5 * (lateral[1:] + lateral[:-1])
    assert float(place[profile[:11].argmax()]) == pytest.approx(0.5, abs=0.1)
    assert float(place[12:][profile[12:].argmax()]) == pytest.approx(-0.5, abs=0.1)
