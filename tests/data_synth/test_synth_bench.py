"""Benches: the same seed gives the same picture, and the picture has its edges where the truth has them."""

import numpy as np
import torch

from data_synth import render_bench
from data_synth.clutter import draw_clutter


def test_same_seed_same_pictures_another_seed_others():
    first, truth = render_bench(3, 2, 240, 320)
    again, same = render_bench(3, 2, 240, 320)
    assert torch.equal(first, again)
    assert all(np.array_equal(a.contour_uv, b.contour_uv) for a, b in zip(truth[0], same[0], strict=True))
    assert not torch.equal(first, render_bench(4, 2, 240, 320)[0])
    assert first.shape == (2, 3, 240, 320) and first.dtype == torch.uint8


def test_benches_without_instruments_have_no_truth():
    _, truth = render_bench(5, 3, 240, 320, most=0)
    assert truth == [[], [], []]


def test_contours_of_one_cylinder_and_end_between_them():
    shafts = [s for shafts in render_bench(11, 40, 240, 320)[1] for s in shafts if s.visible]
    assert len(shafts) > 15
    for shaft in shafts:
        (a0, a1), (b0, b1) = shaft.contour_uv
        along = a1 - a0 + b1 - b0
        left = np.array([along[1], -along[0]])  # x right, y down: left of who walks along
        assert ((a0 - b0) @ left > 0) and ((a1 - b1) @ left > 0)
        sides = [
            np.linalg.det(np.stack([along, shaft.end_uv - point])) for point in (a1, b1)
        ]  # the end lies between both edges
        assert sides[0] * sides[1] < 0


def test_the_picture_changes_at_the_true_contours():
    """Across either contour the brightness has its steepest place within 1.5 px of the truth, in most of the pictures.

    In some the background is as dark as the shaft, or a cast shadow lies beside it.
    """
    pictures, truth = render_bench(21, 40)
    off = []
    for picture, shafts in zip(pictures.float().mean(1).numpy(), truth, strict=True):
        for shaft in shafts[:1]:
            for edge in shaft.contour_uv:
                middle = 0.35 * edge[0] + 0.65 * edge[1]
                direction = (edge[1] - edge[0]) / np.linalg.norm(edge[1] - edge[0])
                across, along = np.linspace(-8, 8, 65), np.linspace(-4, 4, 9)
                at = (
                    middle
                    + along[:, None, None] * direction
                    + across[:, None] * np.array([direction[1], -direction[0]])
                )
                uv = np.round(at).astype(int)
                inside = (uv > 8).all() and (uv[..., 0] < 631).all() and (uv[..., 1] < 471).all()
                if not (shaft.visible and inside):
                    continue
                profile = np.convolve(picture[uv[..., 1], uv[..., 0]].mean(0), np.ones(7) / 7, "valid")
                slope = np.abs(np.diff(profile))
                if slope.max() > 1.0:
                    off.append(abs(across[4:-3][slope.argmax()]))
    assert len(off) > 20
    assert np.mean(np.array(off) < 1.5) > 0.7


def test_clutter_is_a_picture_within_its_range():
    for seed in range(8):
        picture = draw_clutter(np.random.default_rng(seed), 120, 160)
        assert picture.shape == (120, 160, 3) and picture.dtype == np.float32
        assert np.isfinite(picture).all() and picture.min() >= 0 and picture.max() <= 1
