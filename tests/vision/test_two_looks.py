"""When a picture is looked at again, and what of both looks is kept."""

import dataclasses

import numpy as np
import pytest
import torch
from drawn_bars import draw_bar

from data_synth import load_synth_config
from data_synth.render import Renderer
from data_synth.truth import side_truth
from data_synth.world import build_world
from rmis_calib.geometry import Camera
from rmis_calib.vision import DetectorSettings, FrameReason, ShaftDetections, ShaftDetector
from rmis_calib.vision.detections import CLOSED_CONFIDENCE, merge, needs_second_pass

SURE = 0.9


def shafts(*drawn: tuple[float, float, float]) -> ShaftDetections:
    """One frame, with room for three: upright shafts 40 px wide at x, with a confidence, turned by an angle in deg."""
    none = torch.zeros(1, 3, dtype=torch.bool)
    fields = {"valid": none.clone(), "end_valid": none, "direction_known": none}
    names = ("axis_sigma", "end_sigma", "end_sureness", "confidence")
    fields |= {name: torch.full((1, 3), torch.nan) for name in names}
    fields["end_kind"] = torch.full((1, 3), -1)
    pairs = ("contour_sigma", "end_xy", "end_uv", "scatter_px", "blur_px")
    fields |= {name: torch.full((1, 3, 2), torch.nan) for name in pairs}
    fields |= {"contour_xy": torch.full((1, 3, 2, 2, 2), torch.nan), "axis_xy": torch.full((1, 3, 2, 2), torch.nan)}
    fields |= {
        "straight_px": torch.full((1, 3, 2, 8), torch.nan),
        "straight_uv": torch.full((1, 3, 2, 8, 2), torch.nan),
    }
    fields["contour_uv"] = torch.full((1, 3, 2, 4, 2), torch.nan)
    for k, (x, confidence, angle_deg) in enumerate(drawn):
        angle = np.deg2rad(angle_deg)
        along, across = np.array([np.sin(angle), np.cos(angle)]), np.array([np.cos(angle), -np.sin(angle)])
        points = np.array([[(x, 100) + side * across + t * along for t in (-30, 30)] for side in (20.0, -20.0)])
        fields["contour_xy"][0, k], fields["axis_xy"][0, k] = torch.tensor(points), torch.tensor(points.mean(0))
        fields["confidence"][0, k], fields["valid"][0, k] = confidence, True
    fields["reason"] = torch.tensor([FrameReason.OK if drawn else FrameReason.AMBIGUOUS])
    return ShaftDetections(**fields)


@pytest.mark.parametrize(
    ("found", "leads", "again"),
    [
        (shafts((100, 0.99, 0)), (0.3, 0.01, 0.0), False),
        (shafts((100, 0.99, 0)), (0.3, 0.10, 0.0), True),  # something else that looks like a shaft
        (shafts((100, 0.80, 0)), (0.3, 0.01, 0.0), True),
        (shafts((100, 0.99, 0), (300, 0.5, 0)), (0.3, 0.02, 0.0), True),
        (shafts((100, 0.99, 0), (300, 0.95, 0)), (0.3, 0.2, 0.01), False),
        (shafts(), (0.0, 0.0, 0.0), True),
        (shafts((100, 0.99, 0), (300, 0.95, 0), (500, 0.95, 0)), (0.3, 0.2, 0.1), False),
        (shafts((100, 0.99, 0), (300, CLOSED_CONFIDENCE, 0)), (0.3, 0.02, 0.0), False),
        (shafts((300, CLOSED_CONFIDENCE, 0)), (0.3, 0.0, 0.0), True),
    ],
)
def test_pictures_are_looked_at_again_where_something_is_left(
    found: ShaftDetections, leads: tuple, again: bool
) -> None:
    assert needs_second_pass(found, torch.tensor([leads]), SURE).tolist() == [again]


def test_sure_shafts_stay_and_only_others_are_added() -> None:
    first = shafts((100, 0.95, 0), (300, 0.6, 0))
    second = shafts((106, 0.99, 2), (300, 0.8, 0), (100, 0.7, 60))
    both = merge(first, second, SURE)
    middle = both.axis_xy[0].mean(1)[:, 0]
    # The sure one as it was first seen; then the unsure one as it was seen last, and one that crosses.
    assert middle.round().tolist() == [100, 300, 100]
    assert torch.allclose(both.confidence[0], torch.tensor([0.95, 0.8, 0.7]))
    assert both.reason.tolist() == [FrameReason.OK]
    assert bool(both.valid.all())


def test_a_second_look_that_finds_nothing_takes_nothing_away() -> None:
    both = merge(shafts((100, 0.95, 0)), shafts(), SURE)
    assert both.valid.tolist() == [[True, False, False]]
    assert both.reason.tolist() == [FrameReason.OK]
    nothing = merge(shafts((100, 0.5, 0)), shafts(), SURE)
    assert not nothing.valid.any()
    assert nothing.reason.tolist() == [FrameReason.AMBIGUOUS]


def test_a_shaft_beside_its_shadow_is_measured_at_its_own_contours() -> None:
    # Slate grey on red tissue; to one side a band of the same tissue in half of the light.
    colours, light = ((46.0, 48.0, 52.0), (120.0, 66.0, 60.0)), 0.45
    bar, shaded = (
        draw_bar(25.0, inside=colours[0], outside=tuple(share * c for c in colours[1]), noise_levels=1.5, blur_px=0.9)
        for share in (1.0, light)
    )
    v, u = np.mgrid[0 : bar.image.shape[0], 0 : bar.image.shape[1]]
    lateral = (u - bar.centre[0]) * bar.left[0] + (v - bar.centre[1]) * bar.left[1]
    along = (u - bar.centre[0]) * bar.along[0] + (v - bar.centre[1]) * bar.along[1]
    shadow = (lateral > 0) & (lateral < bar.width_px / 2 + 9) & (along < bar.end_px)
    batch = torch.from_numpy(np.where(shadow[..., None], shaded.image, bar.image)).permute(2, 0, 1)[None]
    found = ShaftDetector(DetectorSettings(second_look_below=1.0)).detect(batch)
    assert bool(found.valid[0, 0])
    points = found.contour_xy[0, 0].double().numpy() - bar.centre
    error = np.stack([points[0] @ bar.left - bar.width_px / 2, -points[1] @ bar.left - bar.width_px / 2])
    assert np.abs(error).max() < 0.3


def test_a_stripe_of_glare_does_not_halve_the_shaft() -> None:
    frames = np.array([30, 32, 34, 36])
    config = load_synth_config("brutal")
    world = build_world(dataclasses.replace(config, camera=dataclasses.replace(config.camera, left=None), motions=40))
    images = Renderer(world).render("right", frames).movedim(-1, 1)
    own, truth = world.cameras["right"], side_truth(world, "right")
    camera = Camera.from_values(own.fx, own.fy, own.cx, own.cy, own.distortion, image_size=(own.height, own.width))
    found = ShaftDetector(camera=camera).detect(images)
    assert found.valid[:, 0].tolist() == [True] * 4
    points = found.contour_xy[:, 0].double().numpy()
    lines = truth.n_contour_read[frames] / np.linalg.norm(truth.n_contour_read[frames, :, :2], axis=-1, keepdims=True)
    off_px = own.fx * np.einsum("fepi,fei->fep", np.concatenate([points, np.ones((4, 2, 2, 1))], -1), lines)
    # Half of the shaft would be 27 px off. Measured: 0.2 to 1.0 px rms.
    assert np.sqrt((off_px**2).mean((1, 2))).max() < 2.0
