"""Straight pictures of strips lie where they should, and the network that looks along them is small and sees shafts."""

import hashlib
import json
import sys
from importlib.resources import files
from pathlib import Path

import numpy as np
import pytest
import torch

from data_synth import render_bench
from rmis_calib.vision import DetectorSettings, EndKind, ShaftDetector
from rmis_calib.vision.coarse.straight_pictures import ACROSS, ALONG, straighten_pictures
from rmis_calib.vision.coarse.strip_network import StripNetwork, StripVerdict, load_network, made_by
from rmis_calib.vision.coarse.strips import Strips
from rmis_calib.vision.image.canvas import Canvas

sys.path.insert(0, str(Path(__file__).resolve().parents[1] / "benchmarks"))
import labelled_strips
import train_strip_network as trainer


def strips_through(contours: torch.Tensor, centre: torch.Tensor) -> Strips:
    """Strips between two lines each, given by points (b, k, line, point, uv) that run the same way, ideal pixels."""
    points, valid = contours, torch.ones(contours.shape[:2], dtype=torch.bool)
    middle = points.mean(2)
    along = torch.nn.functional.normalize(middle[:, :, 1] - middle[:, :, 0], dim=-1)
    left = torch.stack([along[..., 1], -along[..., 0]], -1)
    reach = ((centre - middle[:, :, 0]) * along).sum(-1, keepdim=True)
    origin = middle[:, :, 0] + reach * along
    relative = points - origin[:, :, None, None]
    t, y = ((relative * axis[:, :, None, None]).sum(-1) for axis in (along, left))  # (b, k, line, point)
    run = t[..., 1] - t[..., 0]
    slope = (y[..., 1] - y[..., 0]) / torch.where(run.abs() < 1e-3, 1e-3, run)
    offset = y[..., 0] - slope * t[..., 0]
    swapped = offset[..., :1] < offset[..., 1:]
    offset, slope = (torch.where(swapped, value.flip(-1), value) for value in (offset, slope))
    frame = torch.arange(len(points), device=points.device)[:, None].expand_as(valid)
    return Strips(frame, origin, along, offset, slope, valid)


def strip(points: list[list[list[float]]], centre: tuple[float, float]) -> Strips:
    return strips_through(torch.tensor(points)[None, None], torch.tensor(centre))


def test_the_straight_picture_shows_what_lies_there():
    """Small pixel (i, j) is the ideal pixel 1.5 + 4 (i, j); the picture is a ramp in either direction."""
    canvas = Canvas(4, (1.5, 1.5), (60, 80), None, None)
    v, u = torch.meshgrid(torch.arange(60.0), torch.arange(80.0), indexing="ij")
    rgb = torch.stack([0.1 + u / 100, 0.1 + v / 100, torch.full_like(u, 0.5)])[None]
    one = strip([[[101.5, 81.5], [201.5, 81.5]], [[101.5, 121.5], [201.5, 121.5]]], (159.5, 119.5))
    straight, chord = straighten_pictures(rgb, torch.ones(1, 60, 80), canvas, one, torch.zeros(1, 1).long())
    assert straight.shape == (1, 6, ACROSS, ALONG)
    # The axis runs along v = 101.5 from the first small column (u = 1.5) to the last (u = 317.5).
    assert (one.origin[0, 0] + chord[0, 0, :1] * one.along[0, 0]).tolist() == pytest.approx([1.5, 101.5], abs=1e-3)
    assert (one.origin[0, 0] + chord[0, 0, 1:] * one.along[0, 0]).tolist() == pytest.approx([317.5, 101.5], abs=1e-3)
    red, green, blue = straight[0, :3]
    column = torch.linspace(0, 79, ALONG)
    # Left of who walks to the right is up: rows run from one width above the axis to one below it, 40 px each.
    row = (torch.linspace(61.5, 141.5, ACROSS) - 1.5) / 4
    expected = (0.16 + column / 100).log() - (0.16 + row[:, None] / 100).log()
    torch.testing.assert_close(red - green, expected, atol=2e-3, rtol=0)
    torch.testing.assert_close((red + green + blue).mean(), torch.tensor(0.0), atol=1e-4, rtol=0)
    assert bool((straight[0, 3] == 1).all())


def test_places_outside_the_field_of_view_are_unknown():
    canvas = Canvas(4, (1.5, 1.5), (60, 80), None, None)
    seen = torch.ones(1, 60, 80)
    seen[..., 40:] = 0
    one = strip([[[101.5, 81.5], [201.5, 81.5]], [[101.5, 121.5], [201.5, 121.5]]], (159.5, 119.5))
    straight, _ = straighten_pictures(torch.rand(1, 3, 60, 80), seen, canvas, one, torch.zeros(1, 1).long())
    known = straight[0, 3].mean(0)
    assert bool((known[:60] == 1).all()) and bool((known[68:] == 0).all())
    assert bool((straight[0, :3, :, 68:] == 0).all())


def test_lines_in_either_order_make_the_same_strip():
    lines = [[[10.0, 40.0], [210.0, 60.0]], [[12.0, 80.0], [212.0, 110.0]]]
    first, second = strip(lines, (160.0, 120.0)), strip(lines[::-1], (160.0, 120.0))
    t = torch.tensor([[[-30.0, 40.0]]])
    torch.testing.assert_close(first.points(t, first.contour(t)[:, :, 0]), second.points(t, second.contour(t)[:, :, 0]))
    assert bool((first.contour(t)[:, :, 0] > first.contour(t)[:, :, 1]).all())
    # The given points lie on the contours.
    relative = torch.tensor(lines) - first.origin[0, 0]
    on, off = relative @ first.along[0, 0], relative @ first.left[0, 0]
    torch.testing.assert_close(off, first.offset[0, 0][:, None] + first.slope[0, 0][:, None] * on, atol=1e-3, rtol=0)


def test_the_network_is_small():
    assert sum(p.numel() for p in StripNetwork().parameters()) <= 150_000
    file = files("rmis_calib.vision.coarse") / "strip_network.npz"
    assert len(file.read_bytes()) < 400_000
    with file.open("rb") as stream, np.load(stream) as weights:
        own = {name: weights[name] for name in weights.files if name != "made_by"}
        assert {w.dtype for w in own.values()} == {np.dtype(np.float16)}
    assert sum(w.size for w in own.values()) <= 150_000


def test_the_weights_say_what_they_were_made_by():
    made = made_by()
    assert (Path(__file__).resolve().parents[2] / made["script"]).is_file()
    assert made["version"] == trainer.VERSION  # else the script gives other weights than the package's
    digest = hashlib.sha256(json.dumps(made["settings"], sort_keys=True).encode()).hexdigest()
    assert made["settings_sha256"] == digest
    assert made["seed"] == made["settings"]["seed"]


@pytest.fixture
def settled():
    """Threads and algorithms as the script has them, and afterwards as they were."""
    threads, strict = torch.get_num_threads(), torch.are_deterministic_algorithms_enabled()
    trainer.settle()
    yield
    torch.set_num_threads(threads)
    torch.use_deterministic_algorithms(strict)


def short_training(seed: int) -> dict[str, torch.Tensor]:
    pictures = torch.rand(2, 3, 60, 80, generator=torch.Generator().manual_seed(seed))
    settings = trainer.Training(seed=seed, steps=6, batch=24)
    return trainer.train(trainer.painted(seed, pictures, 64), settings).state_dict()


def test_two_short_trainings_with_one_seed_give_the_same_weights(settled):
    first, again, other = short_training(1), short_training(1), short_training(2)
    assert all(torch.equal(w, again[name]) for name, w in first.items())
    assert not all(torch.equal(w, other[name]) for name, w in first.items())


def test_scenes_and_benches_give_the_same_strips_again(settled, monkeypatch):
    monkeypatch.setattr(labelled_strips, "FRAMES", 2)
    for strips in (lambda: trainer.of_world(7, 0, trainer.TRAINED_ON), lambda: trainer.of_benches(7, 0)):
        first, again = strips(), strips()
        assert len(first.end) > 5
        assert all(torch.equal(value, getattr(again, name)) for name, value in vars(first).items())


def test_an_end_is_the_mean_of_the_columns_about_the_likeliest():
    ends = torch.zeros(2, 2, ALONG)
    ends[0, 1, 40:43] = torch.tensor([0.2, 0.5, 0.2])
    ends[0, 0, 100] = 0.1
    ends[1, 0, 10] = 0.3
    chord = torch.tensor([[0.0, 254.0], [-50.0, 77.0]])
    verdict = StripVerdict(torch.zeros(2), torch.zeros(2), ends, torch.tensor([0.0, 0.7]), torch.zeros(2), chord)
    t, kind, share = verdict.best_end()
    assert t.tolist() == pytest.approx([82.0, -40.0], abs=1e-3)
    assert kind.tolist() == [EndKind.RING, EndKind.TUBE]
    assert share.tolist() == pytest.approx([0.9, 0.3], abs=1e-5)


def true_strips(seed: int, count: int) -> tuple[torch.Tensor, list[tuple[int, torch.Tensor]]]:
    images, truth = render_bench(seed, count)
    shafts = [(i, torch.as_tensor(s.contour_uv).float()) for i, each in enumerate(truth) for s in each if s.visible]
    return images, shafts


def test_true_shafts_look_like_shafts_and_the_same_strip_elsewhere_does_not():
    """On benches that it was not trained on; a strip turned by a quarter about the picture's centre is no shaft."""
    images, shafts = true_strips(777, 24)
    detector = ShaftDetector(DetectorSettings())
    _, stages = detector.explain(images)
    canvas = detector._canvas(images)
    centre = torch.tensor(canvas.centre)
    turned = [(centre + (c - centre).flip(-1) * torch.tensor([1.0, -1.0])).clone() for _, c in shafts]
    lines = torch.stack([torch.stack([c for _, c in shafts]), torch.stack(turned)])  # (2, m, edge, point, uv)
    several = strips_through(lines, centre)
    number = torch.tensor([i for i, _ in shafts]).expand(2, -1)
    straight, chord = straighten_pictures(stages.rgb, stages.seen.float(), canvas, several, number)
    logit = load_network(torch.device("cpu")).judge(straight, chord.flatten(0, 1)).shaft.unflatten(0, (2, -1))
    assert float((logit[0] > 0).float().mean()) > 0.6
    assert float((logit[1] > 0).float().mean()) < 0.1
