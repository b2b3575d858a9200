"""What is found in a picture depends on that picture alone, to the last bit: on a CPU, not on the rest of its batch."""

import dataclasses

import numpy as np
import pytest
import torch

from data_synth import load_synth_config
from data_synth.render import Renderer
from data_synth.world import build_world
from rmis_calib.vision import ShaftDetections, ShaftDetector
from rmis_calib.vision.image.sampling import sample, sample_frames


@pytest.fixture(scope="module")
def pictures() -> torch.Tensor:
    """Twelve pictures of three scenes, easy and hard, of a size whose rows do not fill whole vector registers."""
    parts = []
    for preset in ("demo", "two_instruments", "hard"):
        config = load_synth_config(preset)
        camera = dataclasses.replace(config.camera, left=None)
        world = build_world(dataclasses.replace(config, camera=camera, motions=24))
        parts.append(Renderer(world).render("right", np.array([0, 4, 7, 9])).movedim(-1, 1)[:, :, :471, :613])
    return torch.cat(parts).contiguous(memory_format=torch.channels_last)


def differing(found: ShaftDetections, among: ShaftDetections) -> list[str]:
    """Names of the fields of which any bit differs, but for the kind of a NaN."""
    return [
        name
        for name, value in vars(found).items()
        if not torch.equal(torch.nan_to_num(value, nan=-1e9), torch.nan_to_num(getattr(among, name), nan=-1e9))
    ]


@pytest.mark.parametrize("which", [[5], [1, 8], [11, 3, 6], [0, 2, 4, 7, 9, 10, 1]])
def test_a_picture_alone_or_among_others(pictures: torch.Tensor, which: list[int]) -> None:
    threads = torch.get_num_threads()
    torch.set_num_threads(1)  # sums over several threads are split by their size
    try:
        among = ShaftDetector().detect(pictures).of_frames(torch.tensor(which))
        alone = ShaftDetector().detect(pictures[which])
    finally:
        torch.set_num_threads(threads)
    assert bool(among.valid.any())
    assert differing(alone, among) == []


def test_places_in_many_pictures_are_read_as_in_one() -> None:
    """A row of one tall picture of all of them would be off by more and more, the taller it is."""
    count, height, width = 40, 720, 8
    rows = torch.arange(height, dtype=torch.float32)[:, None].expand(height, width)  # the value is the row
    layers = rows.expand(1, count, height, width).contiguous()
    v = torch.linspace(0.0, height - 1.0, 997).expand(count, 997)
    u = torch.full_like(v, 3.25)
    dense = sample_frames(layers, torch.arange(count)[:, None], u[:, None], v[:, None])
    assert float((dense[0, :, 0] - v).abs().max()) < 1e-4  # single precision of 720 rows
    listed = torch.tensor([[39, 0, 39, 17]])
    few = sample_frames(layers + torch.arange(count).reshape(-1, 1, 1) * 1000.0, listed, u[None, :4], v[None, :4])
    one = torch.stack([sample(layers[:, i] + 1000.0 * i, u[i], v[i])[0] for i in (39, 0, 39, 17)])
    assert torch.equal(few[0, 0], one)
