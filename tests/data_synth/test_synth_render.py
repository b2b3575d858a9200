"""Pictures: repeatable, the same world in both cameras, and each fault of the camera does what its setting says."""

import dataclasses
from typing import Any

import numpy as np
import pytest
import torch

from data_synth import load_synth_config, render_frames
from data_synth.kinematics import rigid_inverse, transform_points
from data_synth.render import Renderer
from data_synth.sensor import Sensor
from data_synth.settings_picture import CameraSettings
from data_synth.textures import filtered_noise, upper_share
from data_synth.tissue import intersect
from data_synth.truth import side_truth
from data_synth.world import build_world

SMALL: dict[str, Any] = {
    "width_px": 160,
    "height_px": 120,
    "right": {"fx_px": 175.0, "fy_px": 175.0, "cx_px": 80.0, "cy_px": 60.0},
    "left": {"fx_px": 176.0, "fy_px": 175.5, "cx_px": 78.0, "cy_px": 61.0},
}


def small(motions: int = 4, look: dict | None = None, motion: dict | None = None, seed: int = 0, **camera: Any):
    content = {"seed": seed, "motions": motions, "camera": SMALL | camera, "look": look or {}, "motion": motion or {}}
    return load_synth_config(content)


def test_same_seed_same_pictures() -> None:
    (a, _), (b, _), (c, _) = (render_frames(small(seed=s), 2) for s in (0, 0, 1))
    assert a.shape == (2, 3, 120, 160)
    assert a.dtype == torch.uint8
    assert torch.equal(a, b)
    assert (a.float() - c.float()).abs().mean() > 5.0


def test_a_frame_does_not_depend_on_its_batch() -> None:
    renderer = Renderer(build_world(small(look={"smoke": 0.5, "other_instruments": ["dark", "white"]}, bayer=True)))
    together = renderer.render("left", np.arange(3))
    assert torch.equal(together[1:2], renderer.render("left", np.array([1])))


def test_both_cameras_see_one_surface() -> None:
    world = build_world(small())
    renderer = Renderer(world)
    times = world.frame_times_s[:1]
    points = []
    for side in ("right", "left"):
        tissue_T_camera = rigid_inverse(renderer.tissue.base_T_tissue) @ world.base_T_camera(side, times)[:, None]
        rays = renderer.views[side].coarse_rays
        if side == "left":  # look from the left camera along the rays to what the right camera saw
            camera_T_tissue = rigid_inverse(tissue_T_camera[0, 0])
            p = transform_points(camera_T_tissue, points[0].double().numpy())
            rays = torch.as_tensor(p / p[..., 2:], dtype=torch.float32)
        view = intersect(renderer.tissue, rays, torch.as_tensor(tissue_T_camera).float(), torch.zeros(3))
        points.append(view.points[0])
    # Three steps of the search leave a tenth of a millimetre at most on slopes.
    assert (points[0] - points[1]).abs().quantile(0.95) < 0.1


def test_absent_instrument_is_neither_drawn_nor_true() -> None:
    config = small(look={"absent_fraction": 1.0, "shadow": 0.5})
    pictures, truth = render_frames(config, 2)
    assert not truth.visible.any()
    assert np.isnan(truth.contour_xy).all()
    present, shown = render_frames(small(look={"shadow": 0.5}), 2)
    assert shown.visible.all()
    assert (pictures.float() - present.float()).abs().amax() > 60.0
    # The background is the same where no instrument is: the left border.
    assert (pictures.float() - present.float())[..., :20].abs().mean() < 3.0


def test_round_field_is_black_outside() -> None:
    pictures, truth = render_frames(small(round_field=0.8, noise_levels=0.0), 1)
    assert pictures[..., :4, :4].max() == 0
    uv = truth.contour_uv[0][truth.contour_visible[0]]
    assert (np.hypot(*(uv - [79.5, 59.5]).T) < 64.0).all()


def test_rows_of_two_fields_are_from_two_times() -> None:
    motion = {"kind": "smooth", "speed": 2.0}
    clean = {"noise_levels": 0.0, "vignette": 0.0}
    delay = 0.04
    world = build_world(small(motion=motion, **clean))
    woven = Renderer(build_world(small(motion=motion, field_delay_s=delay, **clean))).encoded("right", np.array([1]))
    shifted = [
        Renderer(dataclasses.replace(world, frame_times_s=world.frame_times_s + s)).encoded("right", np.array([1]))
        for s in (-delay / 2, delay / 2)
    ]
    assert torch.equal(woven[:, ::2], shifted[0][:, ::2])
    assert torch.equal(woven[:, 1::2], shifted[1][:, 1::2])
    assert not torch.equal(shifted[0], shifted[1])


def test_rolling_rows_are_read_one_after_the_other() -> None:
    motion = {"kind": "smooth", "speed": 2.0}
    readout = 0.06
    config = small(motion=motion, noise_levels=0.0, readout_s=readout)
    rolling = Renderer(build_world(config)).encoded("right", np.array([1]))
    world = build_world(small(motion=motion, noise_levels=0.0))
    # Row 20 of 120 is read a third of the readout before the frame's time, row 100 a third after.
    for row, shift in ((20, -1 / 3), (60, 0.0), (100, 1 / 3)):
        moved = dataclasses.replace(world, frame_times_s=world.frame_times_s + shift * readout)
        still = dataclasses.replace(world, frame_times_s=world.frame_times_s - shift * readout - 0.01)
        same, other = (Renderer(w).encoded("right", np.array([1]))[:, row] for w in (moved, still))
        near = (rolling[:, row] - same).abs().mean()
        assert near < 0.3 * (rolling[:, row] - other).abs().mean()


def test_exposure_is_the_mean_of_its_instants() -> None:
    motion = {"kind": "smooth", "speed": 2.0}
    # Tissue without texture: at this size its highlights are points that every instant draws anew.
    look = {"other_instruments": ["dark"], "gloss": 0.0, "vessels": 0.0, "fat": 0.0, "folds": 0.0, "shadow": 0.0}
    exposure_s = 0.08
    config = small(motion=motion, look=look, exposure_s=exposure_s)
    blurred = Renderer(build_world(config)).encoded("right", np.array([0]))
    world = build_world(small(motion=motion, look=look))
    shifts = exposure_s * ((np.arange(8) + 0.5) / 8 - 0.5)
    instants = [
        Renderer(dataclasses.replace(world, frame_times_s=world.frame_times_s + s)).encoded("right", np.array([0]))
        for s in shifts
    ]
    mean, sharp = torch.stack(instants).mean(0)[0], Renderer(world).encoded("right", np.array([0]))[0]
    truth = side_truth(world, "right")
    for shaft in (truth, *truth.others):
        u, v = np.round(shaft.contour_uv[0][shaft.contour_visible[0]]).astype(int).clip(2, [157, 117]).T
        near = np.zeros((120, 160), dtype=bool)
        for across in range(-2, 3):
            near[v + across, u] = True
        moved = (sharp - mean).abs()[near].mean()
        assert moved > 0.01
        # Edges are widened, not averaged, and a Gaussian is no uniform motion: measured, a fifth of the blur is left,
        # and four hundredths of it in the mean.
        assert (blurred[0] - mean).abs()[near].mean() < 0.25 * moved
        assert (blurred[0] - mean)[near].mean().abs() < 0.06 * moved


def expose(level: float, **settings: Any) -> torch.Tensor:
    sensor = Sensor(
        CameraSettings(width_px=320, height_px=240, **settings), seed=1, frames=3, device=torch.device("cpu")
    )
    return sensor.expose(torch.full((1, 240, 320, 3), level), np.array([2]), "right").float()


def test_sensor_noise_has_its_size() -> None:
    grey = expose(0.5, noise_levels=3.0)
    assert grey.mean().item() == pytest.approx(127.5, abs=0.1)
    assert grey.std().item() == pytest.approx(3.0, rel=0.03)


def test_bayer_keeps_a_flat_colour_and_blurs_its_noise() -> None:
    assert torch.equal(expose(100 / 255, bayer=True, noise_levels=0.0), torch.full((1, 240, 320, 3), 100.0))
    assert expose(0.5, bayer=True, noise_levels=4.0).std() < 3.5


def test_colour_noise_keeps_the_brightness() -> None:
    noisy = expose(0.5, noise_levels=0.0, colour_noise_levels=6.0)
    luma = noisy @ torch.tensor([0.30, 0.59, 0.11])
    assert noisy[..., 0].std() > 3.0
    assert luma.std() < 0.6  # rounding alone leaves 0.2


def test_sharpening_overshoots_and_keeps_the_edge() -> None:
    sensor = Sensor(
        CameraSettings(width_px=64, height_px=64, noise_levels=0.0, sharpening=1.0), 0, 1, torch.device("cpu")
    )
    u = torch.arange(64.0).view(1, 1, 64, 1)
    ramp = (0.3 + 0.4 * torch.special.ndtr((u - 31.5) / 1.0)).expand(1, 64, 64, 3)
    row = sensor.expose(ramp.clone(), np.array([0]), "right")[0, 30, :, 0].float()
    assert row[:30].min() < 0.3 * 255 - 2
    assert row[34:].max() > 0.7 * 255 + 2
    assert (row[31] + row[32]).item() / 2 == pytest.approx(0.5 * 255, abs=1.0)


def test_jpeg_and_white_balance_change_the_picture() -> None:
    assert not torch.equal(expose(0.5, jpeg_quality=20), expose(0.5))
    red, green, _ = expose(0.5, white_balance_variation=0.2, noise_levels=0.0)[0, 0, 0]
    assert green == 128.0
    assert red != green


def test_textures_have_unit_variance_and_the_share_asked_for() -> None:
    field = filtered_noise(np.random.default_rng(0), 128, 2.0, 20.0)
    assert field.std() == pytest.approx(1.0)
    assert upper_share(field, 0.25, 0.05).mean() == pytest.approx(0.25, abs=0.02)
    assert upper_share(field, 0.0, 0.05).max() == 0.0


@pytest.mark.parametrize("kind", ["grid", "random"])
def test_stops_keep_the_end_in_view(kind: str) -> None:
    world = build_world(small(motions=80, motion={"kind": kind}))
    assert all(side_truth(world, side).end_visible.all() for side in world.cameras)


def test_grid_that_is_too_small_is_refused() -> None:
    with pytest.raises(ValueError, match="motions: expected at most 8 on this grid, found 9"):
        build_world(small(motions=9, motion={"kind": "grid", "laparoscope": "static", "positions_instrument": 2}))


@pytest.mark.skipif(not torch.cuda.is_available(), reason="no CUDA device here")
def test_cuda_draws_the_same_pictures() -> None:
    config = small(look={"smoke": 0.4, "other_instruments": ["dark"], "tissue_over_shaft": True}, noise_levels=0.0)
    (cpu, _), (cuda, _) = (render_frames(config, 3, device=d) for d in ("cpu", "cuda"))
    assert (cpu.float() - cuda.cpu().float()).abs().quantile(0.999) <= 3.0
