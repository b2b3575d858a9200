"""The table of straightness against a lens whose distortion is known."""

import dataclasses

import pytest
import torch

from data_synth import load_synth_config, render_frames
from data_synth.world import build_world
from rmis_calib.geometry import Camera
from rmis_calib.vision import ShaftDetections, ShaftDetector, StraightnessTable


@pytest.fixture(scope="module")
def seen() -> tuple[ShaftDetections, ShaftDetections]:
    """What is found in pictures with k1 = -0.35, told so, and told 0.1 less."""
    config = dataclasses.replace(load_synth_config("barrel"), motions=8, seed=7)
    images, _ = render_frames(config)
    own = build_world(config).cameras["right"].to_dict()
    k, lens = [own[name] for name in ("fx", "fy", "cx", "cy")], list(own["distortion"])
    size = tuple(images.shape[-2:])
    right = Camera.from_values(*k, lens, image_size=size)
    wrong = Camera.from_values(*k, [lens[0] + 0.1, *lens[1:]], image_size=size)
    return ShaftDetector(camera=right).detect(images), ShaftDetector(camera=wrong).detect(images)


def rms(found: ShaftDetections) -> float:
    values = found.straight_px[found.valid]
    return float(values[torch.isfinite(values)].square().mean().sqrt())


def test_contours_are_straight_under_the_true_lens_and_bent_under_another(seen):
    right, wrong = seen
    assert rms(right) < 0.06
    assert rms(wrong) > 3 * rms(right)


def test_tables_of_parts_add_up_to_that_of_the_whole(seen):
    _, found = seen
    size = (480, 640)
    parts = [StraightnessTable.of(found.of_frames(torch.arange(a, b)), size) for a, b in ((0, 3), (3, 8))]
    whole = StraightnessTable.of(found, size)
    torch.testing.assert_close((parts[0] + parts[1]).information, whole.information)
    torch.testing.assert_close((parts[0] + parts[1]).weighted_px, whole.weighted_px)
    known = torch.isfinite(found.straight_px[found.valid & (found.confidence >= 0.9)])
    assert float(whole.count.sum()) == pytest.approx(int(known.sum()))


def test_a_known_displacement_comes_back():
    """Stretches of two crossing contours in one cell, moved by (0.3, -0.2) px: each sees its normal part of that."""
    uv = torch.tensor([[[10.0, 10.0], [20.0, 10.0]], [[12.0, 8.0], [12.0, 18.0]]])  # to the right, and down
    left = torch.tensor([[0.0, -1.0], [1.0, 0.0]])
    moved = torch.tensor([0.3, -0.2])
    off = (left @ moved)[:, None].expand(2, 2)
    found = _one_shaft(uv, off)
    table = StraightnessTable.of(found, (60, 80), cells=(2, 2))
    torch.testing.assert_close(table.displacement_px()[0, 0], moved.double())
    assert torch.isnan(table.displacement_px()[1, 1]).all()


def _one_shaft(uv: torch.Tensor, off: torch.Tensor) -> ShaftDetections:
    more = dict.fromkeys(("contour_sigma", "end_xy", "end_uv", "scatter_px", "blur_px"), (2,))
    more |= {"axis_xy": (2, 2), "contour_xy": (2, 2, 2), "contour_uv": (2, 4, 2)}
    fields = {n: torch.ones(1, 1, *more.get(n, ())) for n in ShaftDetections.__dataclass_fields__}
    fields |= {n: fields[n].bool() for n in ("valid", "end_valid", "direction_known")}
    fields |= {"reason": torch.zeros(1).long(), "end_kind": fields["end_kind"].long()}
    return ShaftDetections(**fields | {"straight_uv": uv[None, None], "straight_px": off[None, None]})
