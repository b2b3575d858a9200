"""The truth against brute force, and the drawing against the truth: they share no code."""

import dataclasses

import numpy as np
import pytest
import torch
from scipy.optimize import curve_fit
from scipy.special import erf

from data_synth import load_synth_config
from data_synth.cameras import Camera, build_camera
from data_synth.contours import view_cylinder
from data_synth.draw import Brush, draw_instrument
from data_synth.kinematics import transform_points
from data_synth.materials import Finish, Surface, own_finish
from data_synth.render import CAMERA_RIGHT_P_LIGHT, Renderer
from data_synth.truth import SideTruth, side_truth
from data_synth.world import World, build_world

TOLERANCE_PX = 0.02
"""How well drawn edges must lie where the truth says; measured: at most 0.012 px, the fading of the shaft towards its
limb."""


@pytest.fixture(scope="module", params=["clean", "barrel"])
def world(request: pytest.FixtureRequest) -> World:
    return build_world(dataclasses.replace(load_synth_config(request.param), motions=3))


@pytest.mark.parametrize("side", ["right", "left"])
def test_contours_are_the_outermost_points_of_the_cylinder(world: World, side: str) -> None:
    truth = side_truth(world, side)
    angle = np.linspace(0.0, 2.0 * np.pi, 20001)
    for i in np.flatnonzero(truth.visible):
        v = truth.camera_v_axis[i]
        e = np.linalg.svd(v[None])[2][1:]
        ring = 4.0 * (np.cos(angle)[:, None] * e[0] + np.sin(angle)[:, None] * e[1])
        surface = truth.camera_p_rcm[i] + truth.s_end_mm[i] * v + ring
        xy = surface[:, :2] / surface[:, 2:]
        a, b = truth.contour_xy[i, :, 0], truth.contour_xy[i, :, 1]
        d = (b - a) / np.linalg.norm(b - a, axis=-1, keepdims=True)
        # Left of the walk to the tip is negative across it (x right, y down); nothing is further out than its edge.
        outside = [d[k, 0] * (xy - a[k])[:, 1] - d[k, 1] * (xy - a[k])[:, 0] for k in range(2)]
        assert abs(outside[0].min()) < 1e-8
        assert abs(outside[1].max()) < 1e-8


def test_distortion_round_trip_and_jacobian() -> None:
    camera = build_camera(load_synth_config("barrel").camera, load_synth_config("barrel").camera.right)
    v, u = np.meshgrid(np.linspace(0, 479, 7), np.linspace(0, 639, 9), indexing="ij")
    uv = np.stack([u, v], axis=-1)
    xy, jacobian = camera.rays(uv)
    np.testing.assert_allclose(camera.pixels(xy), uv, atol=1e-9)
    step = 1e-4
    for axis in range(2):
        shift = step * np.eye(2)[axis]
        slope = (camera.rays(uv + shift)[0] - camera.rays(uv - shift)[0]) / (2 * step)
        np.testing.assert_allclose(jacobian[..., axis], slope, rtol=1e-5, atol=1e-9)


def test_distortion_is_brown_conrady() -> None:
    # One point by hand: x = 0.3, y = -0.2, r2 = 0.13, k1 = -0.2, p1 = 0.01, p2 = 0.02:
    # radial = 0.974; x' = 0.2922 + 2 p1 x y + p2 (r2 + 2 x2) = 0.2922 - 0.0012 + 0.0062; y' = -0.1948 + 0.0021 - 0.0024
    camera = Camera(640, 480, 100.0, 100.0, 0.0, 0.0, (-0.2, 0.0, 0.01, 0.02, 0.0))
    np.testing.assert_allclose(camera.pixels(np.array([0.3, -0.2])), [29.72, -19.51], atol=1e-12)


def test_distortion_that_folds_the_picture_is_refused() -> None:
    camera = Camera(640, 480, 300.0, 300.0, 320.0, 240.0, (-0.9, 0.0, 0.0, 0.0, 0.0))
    with pytest.raises(ValueError, match="distortion: expected an invertible model"):
        camera.rays(np.array([[0.0, 0.0]]))


def paint_alone(world: World, side: str, background: float, finish: Finish) -> np.ndarray:
    """The instrument of all frames over a flat background, without the sensor: (N, H, W), encoded."""
    renderer, n = Renderer(world), len(world.frame_times_s)
    light = torch.as_tensor(transform_points(world.camera_T_camera_right(side), CAMERA_RIGHT_P_LIGHT))
    settings = world.config.camera
    brush = Brush(renderer.views[side].rays, light, settings.blur_px, settings.gamma)
    picture = torch.full((n, settings.height_px, settings.width_px, 3), background)
    frames = np.arange(n)[:, None]
    draw_instrument(
        picture, brush, renderer.swept_poses(side, frames, world.frame_times_s[:, None], np.ones((1, 1))), finish
    )
    return picture.mean(-1).numpy().astype(np.float64)


def edge_profile(t: np.ndarray, at: float, low: float, high: float, width: float) -> np.ndarray:
    return low + (high - low) * 0.5 * (1.0 + erf((t - at) / (width * np.sqrt(2.0))))


def contour_errors(picture: np.ndarray, polyline: np.ndarray) -> list[tuple[float, float]]:
    """Signed distance and width of the drawn edge about stretches of a true contour, by a fit to raw pixels."""
    found = []
    for k in range(2, len(polyline) - 8, 4):
        a, b, mid = polyline[k], polyline[k + 4], polyline[k + 2]
        (u0, v0), (u1, v1) = (
            np.clip(c, 0, np.array(picture.shape)[::-1] - 1).astype(int)
            for c in (np.minimum(a, b) - 5, np.maximum(a, b) + 6)
        )
        v, u = np.mgrid[v0:v1, u0:u1]
        length = np.linalg.norm(b - a)
        d = (b - a) / length
        n = np.array([-d[1], d[0]])
        along = (u - a[0]) * d[0] + (v - a[1]) * d[1]
        across = (u - a[0]) * n[0] + (v - a[1]) * n[1]
        bend = 4.0 * ((mid - a) @ n) * (along / length) * (1.0 - along / length)
        near = (along > 0) & (along < length) & (np.abs(across) < 3.0)
        if near.sum() < 40:
            continue
        x, y = (across - bend)[near], picture[v0:v1, u0:u1][near]
        start = [0.0, y[x < -2].mean(), y[x > 2].mean(), 0.6]
        (at, _, _, sigma), _ = curve_fit(edge_profile, x, y, p0=start)
        found.append((at, sigma))
    return found


@pytest.mark.parametrize("side", ["right", "left"])
def test_drawn_contours_and_ends_are_where_the_truth_is(world: World, side: str) -> None:
    truth, picture = side_truth(world, side), paint_alone(world, side, 0.65, own_finish(world.config.look))
    # Two pixels beside the axis are few: for the end the stripe of the highlight is left out.
    dull = Finish(Surface((0.02,) * 3, 0.0, 1.0), Surface((0.4,) * 3, 0.0, 1.0), Surface((0.4,) * 3, 0.0, 1.0))
    unlit = paint_alone(world, side, 0.65, dull)
    blur = world.config.camera.blur_px
    contours, ends = [], []
    for i in np.flatnonzero(truth.visible & truth.end_visible):
        for edge in range(2):
            inside = truth.contour_visible[i, edge]
            contours += contour_errors(picture[i], truth.contour_uv[i, edge][inside])
        ends.append(end_error(unlit[i], truth, i))
    contours = np.array(contours)
    assert len(contours) > 40
    np.testing.assert_allclose(contours[:, 0], 0.0, atol=TOLERANCE_PX)
    np.testing.assert_allclose(contours[:, 1], blur, rtol=0.03)
    np.testing.assert_allclose(ends, 0.0, atol=TOLERANCE_PX)


def test_contours_smeared_by_motion_stay_where_the_truth_is() -> None:
    config = load_synth_config("cholec")
    camera = dataclasses.replace(config.camera, exposure_s=0.012, readout_s=0.0, blur_px=0.6, round_field=0.0)
    motion = dataclasses.replace(config.motion, speed=2.0, frame_rate_hz=2.0)
    world = build_world(dataclasses.replace(config, camera=camera, motion=motion, motions=6))
    finish = own_finish(load_synth_config("clean").look)
    truth, picture = side_truth(world, "right"), paint_alone(world, "right", 0.65, finish)
    found = [
        contour_errors(picture[i], truth.contour_uv[i, edge][truth.contour_visible[i, edge]])
        for i in np.flatnonzero(truth.visible)
        for edge in range(2)
    ]
    errors = np.array([pair for pairs in found for pair in pairs])
    assert len(errors) > 40
    assert errors[:, 1].max() > 1.5 * camera.blur_px
    # The fading of the shaft towards its limb counts for more where the edge is wide: measured, at most 0.026 px.
    np.testing.assert_allclose(errors[:, 0], 0.0, atol=0.03)


def test_rows_read_one_after_the_other_lean_the_contours() -> None:
    config = load_synth_config("hard")
    camera = dataclasses.replace(config.camera, readout_s=0.03, round_field=0.0)
    motion = dataclasses.replace(config.motion, speed=2.0, frame_rate_hz=2.0)
    world = build_world(dataclasses.replace(config, camera=camera, motion=motion, motions=8))
    truth, own = side_truth(world, "right"), world.cameras["right"]
    leaning = []
    for i in np.flatnonzero(truth.visible):
        for edge in range(2):
            rows = np.sort(truth.contour_uv[i, edge][truth.contour_visible[i, edge]][:, 1])[[0, -1]]
            row = np.arange(np.ceil(rows[0]), np.floor(rows[1]))
            if len(row) < 30:
                continue
            # Every row shows the contour of its own instant: no point of the shaft is followed here.
            times = world.frame_times_s[i] + camera.readout_s * ((row + 0.5) / camera.height_px - 0.5)
            shaft, _ = world.shaft("right", np.full(len(row), i), times)
            n = view_cylinder(shaft.camera_p_rcm, shaft.camera_v_axis, shaft.radius_mm).n_contour[:, edge]
            y = (row - own.cy) / own.fy
            x = -(n[:, 1] * y + n[:, 2]) / n[:, 0]
            line, at_once = truth.n_contour_read[i, edge], truth.n_contour[i, edge]
            off = [own.fx * (m @ np.stack([x, y, np.ones_like(x)])) / np.linalg.norm(m[:2]) for m in (line, at_once)]
            assert np.abs(off[0]).max() < 0.15  # the seen contour is a little curved
            leaning.append(np.abs(off[1]).max())
    assert len(leaning) > 8
    assert max(leaning) > 1.0


def test_rows_read_at_once_show_the_contours_as_they_are(world: World) -> None:
    truth = side_truth(world, "right")
    np.testing.assert_array_equal(truth.n_contour_read, truth.n_contour)


def end_error(picture: np.ndarray, truth: SideTruth, i: int) -> float:
    """Signed distance along the axis of the drawn end from the true front of the rim, by a fit to pixels near the
    axis."""
    at, head = truth.end_front_uv[i], truth.head_uv[i]
    d = (head - at) / np.linalg.norm(head - at)
    v, u = np.mgrid[0 : picture.shape[0], 0 : picture.shape[1]]
    along, across = (u - at[0]) * d[0] + (v - at[1]) * d[1], (v - at[1]) * d[0] - (u - at[0]) * d[1]
    near = (np.abs(across) < 1.0) & (np.abs(along) < 3.0)

    # The rim is a curve: a parabola across, and the shading leans a little with it.
    def model(xy: np.ndarray, s: float, low: float, high: float, width: float, lean: float, bow: float) -> np.ndarray:
        return edge_profile(xy[0] - lean * xy[1] - bow * xy[1] ** 2, s, low, high, width)

    x, y = np.stack([along[near], across[near]]), picture[near]
    start = [0.0, y[x[0] < -2].mean(), y[x[0] > 2].mean(), 0.6, 0.0, 0.0]
    return float(curve_fit(model, x, y, p0=start)[0][0])


def test_hidden_points_are_where_the_foreground_is_drawn() -> None:
    config = dataclasses.replace(load_synth_config("brutal"), motions=40)
    plain = dataclasses.replace(
        config.camera, exposure_s=0.0, readout_s=0.0, field_delay_s=0.0, round_field=0.0, vignette=0.0
    )
    look = dataclasses.replace(config.look, smoke=0.0, other_instruments=())
    config = dataclasses.replace(config, camera=plain, look=look)
    without = dataclasses.replace(config, look=dataclasses.replace(look, tissue_over_shaft=False))
    world = build_world(config)
    renderers = Renderer(world), Renderer(dataclasses.replace(world, props=build_world(without).props))
    truth = side_truth(world, "right")
    hidden, drawn = [], []
    for i in range(0, 40, 10):
        with_loop, without_loop = (r.encoded("right", np.array([i]))[0].numpy() for r in renderers)
        changed = np.abs(with_loop - without_loop).max(-1) > 0.01
        uv = np.round(truth.contour_uv[i]).reshape(-1, 2)
        seen = truth.contour_visible[i].reshape(-1)
        on_picture = np.isfinite(uv).all(-1) & (uv >= 2).all(-1) & (uv <= [637, 477]).all(-1)
        hidden += (~seen[on_picture]).tolist()
        drawn += changed[uv[on_picture, 1].astype(int), uv[on_picture, 0].astype(int)].tolist()
    assert 20 < sum(hidden) < len(hidden) - 20
    # Points within a blur of the border may go either way.
    assert np.mean(np.array(hidden) == np.array(drawn)) > 0.97


def test_other_instruments_have_their_truth_too() -> None:
    config = dataclasses.replace(load_synth_config("two_instruments"), motions=3)
    world = build_world(config)
    truth = side_truth(world, "right")
    assert len(truth.others) == 2
    assert "other1_contour_uv" in truth.arrays()
    alone = Renderer(dataclasses.replace(world, props=dataclasses.replace(world.props, others=())))
    picture, without = (r.encoded("right", np.arange(3)).numpy() for r in (Renderer(world), alone))
    changed = np.abs(picture - without).max(-1) > 0.1
    for other in truth.others:
        inside = other.contour_visible.all(1)  # (N, P): both edges are in the picture
        frame, point = np.nonzero(inside)
        assert len(frame) > 20
        uv = np.round(other.contour_uv[frame, :, point].mean(1)).astype(int)
        assert changed[frame, uv[:, 1], uv[:, 0]].mean() > 0.9
