"""Shafts measured near where they are known to be about: as a search measures them, and each picture by itself."""

import numpy as np
import pytest
import torch

from data_synth import load_synth_config
from data_synth.render import Renderer
from data_synth.truth import SideTruth, side_truth
from data_synth.world import build_world
from rmis_calib.errors import ShapeError
from rmis_calib.geometry import Camera
from rmis_calib.vision import FrameReason, ShaftDetector
from tests.vision.test_batch_independence import differing

FRAMES = 6


@pytest.fixture(scope="module")
def scene() -> tuple[torch.Tensor, SideTruth, Camera]:
    world = build_world(load_synth_config({"motions": FRAMES}))
    own = world.cameras["right"]
    camera = Camera.from_values(own.fx, own.fy, own.cx, own.cy, own.distortion, image_size=(own.height, own.width))
    return Renderer(world).render("right", np.arange(FRAMES)).movedim(-1, 1), side_truth(world, "right"), camera


def places(truth: SideTruth, shift: float = 0.0) -> torch.Tensor:
    """(frames, 2, 2, 3): nothing, and the true contours, shifted by a share of the width to the right."""
    lines = truth.n_contour / np.linalg.norm(truth.n_contour[..., :2], axis=-1, keepdims=True)
    middle = truth.axis_xy.mean(1)[:, None]  # (f, 1, xy)
    width = np.diff((lines[..., :2] * middle).sum(-1) + lines[..., 2], axis=1)
    lines[..., 2] += shift * width
    known = torch.from_numpy(lines)[:, None]
    return torch.cat([torch.full_like(known, torch.nan), known], 1)


@pytest.mark.parametrize("shift", [0.0, 0.1, -0.1])
def test_it_measures_what_a_search_does(scene: tuple[torch.Tensor, SideTruth, Camera], shift: float) -> None:
    images, truth, camera = scene
    found = ShaftDetector(camera=camera).look_near(images, places(truth, shift))
    assert found.valid.tolist() == [[False, True]] * FRAMES
    assert (found.reason == FrameReason.OK).all()
    lines = truth.n_contour / np.linalg.norm(truth.n_contour[..., :2], axis=-1, keepdims=True)
    points = np.concatenate([found.contour_xy[:, 1].double().numpy(), np.ones((FRAMES, 2, 2, 1))], -1)
    off = float(camera.focal) * np.abs(np.einsum("fepi,fei->fep", points, lines))
    assert off.max() < 0.25  # px
    searched = ShaftDetector(camera=camera).detect(images)
    torch.testing.assert_close(found.confidence[:, 1], searched.confidence[:, 0], rtol=0, atol=0.01)
    assert torch.equal(found.end_valid[:, 1], searched.end_valid[:, 0])
    assert torch.equal(found.direction_known[:, 1], searched.direction_known[:, 0])
    both = found.end_valid[:, 1]
    apart = float(camera.focal) * (found.end_xy[both, 1] - searched.end_xy[both, 0]).norm(dim=-1)
    assert apart.max() < 3 * float(camera.focal) * searched.end_sigma[both, 0].max()


def test_a_picture_alone_or_among_others(scene: tuple[torch.Tensor, SideTruth, Camera]) -> None:
    images, truth, camera = scene
    threads = torch.get_num_threads()
    torch.set_num_threads(1)
    try:
        among = ShaftDetector(camera=camera).look_near(images, places(truth))
        for which in ([3], [5, 0], [1, 2, 4]):
            alone = ShaftDetector(camera=camera).look_near(images[which], places(truth)[which])
            assert differing(alone, among.of_frames(torch.tensor(which))) == []
    finally:
        torch.set_num_threads(threads)


def test_where_there_is_no_place_or_no_shaft_nothing_is_found(scene: tuple[torch.Tensor, SideTruth, Camera]) -> None:
    images, truth, camera = scene
    detector = ShaftDetector(camera=camera)
    nowhere = detector.look_near(images, torch.full((FRAMES, 3, 2, 3), torch.nan))
    assert not nowhere.valid.any()
    assert nowhere.valid.shape == (FRAMES, 3)
    broken = images.float() / 255
    broken[0, 0, 5, 5] = torch.nan
    broken[1:] = 0.4
    found = detector.look_near(broken, places(truth))
    assert not found.valid.any()
    assert found.reason.tolist() == [FrameReason.BAD_PIXELS] + [FrameReason.EDGES_UNCLEAR] * (FRAMES - 1)
    assert torch.isnan(found.contour_xy).all()
    for wrong in (places(truth)[:2], places(truth)[:, :0]):
        with pytest.raises(ShapeError, match="contour_n"):
            detector.look_near(images, wrong)
