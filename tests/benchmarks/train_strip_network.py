"""Train the network that looks along strips (rmis_calib/vision/coarse/strip_network.py), on synthetic pictures only.

    python tests/benchmarks/train_strip_network.py --out FILE [--cache FILE] [--seed 90210] [--steps 4000]

labelled_strips.py makes the strips: some of operating scenes with looks, cameras and motions drawn at random around the
presets, some of benches with clutter, and painted ones (data_synth/strips.py), whose surfaces, wrists, rings and balls
differ in each. The same settings give the same weights, bit for bit on one machine. Prints what the network says of
pictures that it was not trained on, presets among them that it never saw.

The weights in the package are this version's with its default settings; docs/accuracy.md says how good they are.
"""

import argparse
import dataclasses
import hashlib
import json
import time
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import torch
from labelled_strips import (
    BORDER,
    HELD_OUT,
    TRAINED_ON,
    LabelledStrips,
    backgrounds,
    of_benches,
    of_world,
    painted,
)  # fmt: skip
from torch import Tensor

from rmis_calib.vision.coarse.straight_pictures import ALONG
from rmis_calib.vision.coarse.strip_network import KINDS, StripNetwork, load_network, save_weights

VERSION = 4
"""Raised with every change here, in labelled_strips.py or in data_synth that changes the weights."""


@dataclass(frozen=True)
class Training:
    """What the weights depend on, besides the code."""

    seed: int = 90210
    worlds: int = 40
    """Operating scenes, ten pictures each."""
    benches: int = 70
    """Groups of ten benches."""
    painted: int = 16_384
    """Painted strips."""
    steps: int = 4_000
    batch: int = 128


def made_by(settings: Training) -> dict[str, Any]:
    """What is kept beside the weights."""
    values = dataclasses.asdict(settings)
    digest = hashlib.sha256(json.dumps(values, sort_keys=True).encode()).hexdigest()
    script = str(Path(__file__).relative_to(Path(__file__).resolve().parents[2]))
    return {"script": script, "version": VERSION, "seed": settings.seed, "settings": values, "settings_sha256": digest}


def settle() -> None:
    """One thread, and only algorithms whose sums always run in the same order."""
    torch.set_num_threads(1)
    torch.use_deterministic_algorithms(True)


def gather(settings: Training) -> LabelledStrips:
    """All strips to learn from."""
    seed, began = settings.seed, time.process_time()
    parts = [painted(seed, backgrounds(seed, 200, 16), settings.painted)]
    print(f"painted: {time.process_time() - began:.0f} s", flush=True)
    parts += [of_world(seed, i, TRAINED_ON) for i in range(settings.worlds)]
    print(f"operating scenes: {time.process_time() - began:.0f} s", flush=True)
    parts += [of_benches(seed, i) for i in range(settings.benches)]
    print(f"benches: {time.process_time() - began:.0f} s", flush=True)
    return LabelledStrips.joined(parts)


def augmented(strips: LabelledStrips, generator: torch.Generator) -> tuple[Tensor, Tensor, Tensor]:
    """Inputs of the network, mirrored and in other light, with the direction and end that then hold."""
    x, rest = strips.picture[:, :3].float(), strips.picture[:, 3:].float()
    m, known = len(x), rest[:, :1]

    def draw(*shape: int) -> Tensor:
        return torch.rand(m, *shape, generator=generator)

    x = x * (0.7 + 0.6 * draw(1, 1, 1)) + 0.12 * (draw(3, 1, 1) - 0.5)
    grey = (draw(1, 1, 1) < 0.15).float()
    x = x + grey * (x.mean(1, keepdim=True) - x)
    x = torch.cat([(x + 0.06 * draw(1, 1, 1) * torch.randn(x.shape, generator=generator)) * known, rest], 1)
    x = torch.where(draw(1, 1, 1) < 0.5, x.flip(2), x)
    back = draw() < 0.5
    x = torch.where(back[:, None, None, None], x.flip(3), x)
    forwards = torch.where(back & (strips.forwards >= 0), 1 - strips.forwards, strips.forwards)
    placed = (strips.end >= 0) & (strips.end < BORDER)
    column = strips.end % ALONG
    end = torch.where(back & placed, strips.end - column + ALONG - 1 - column, strips.end)
    return x, forwards, end


def loss(network: StripNetwork, strips: LabelledStrips, generator: torch.Generator) -> Tensor:
    x, forwards, end = augmented(strips, generator)
    whole, ends = network(x)
    known = strips.right >= 0
    value = torch.nn.functional.binary_cross_entropy_with_logits(whole[known, 0], strips.right[known].float())
    told = forwards >= 0
    value = value + 0.5 * torch.nn.functional.binary_cross_entropy_with_logits(whole[told, 1], forwards[told].float())
    ended = end >= 0
    return value + 0.5 * -(softened(end[ended]) * ends[ended].log_softmax(1)).sum(1).mean()


def softened(end: Tensor) -> Tensor:
    """The wanted distribution: a column and its neighbours."""
    wanted = torch.zeros(len(end), KINDS * ALONG + 2)
    for shift, weight in ((-1, 0.2), (0, 0.6), (1, 0.2)):
        inside = (end < BORDER) & ((end % ALONG + shift) >= 0) & ((end % ALONG + shift) < ALONG)
        place = torch.where(inside, end + shift, end)
        wanted.scatter_add_(1, place[:, None], torch.full((len(end), 1), weight))
    return wanted


def train(strips: LabelledStrips, settings: Training) -> StripNetwork:
    """The network after so many steps, from this seed."""
    torch.manual_seed(settings.seed)
    generator = torch.Generator().manual_seed(settings.seed)
    network = StripNetwork()
    optimiser = torch.optim.AdamW(network.parameters(), lr=2e-3, weight_decay=1e-3)
    began, step = time.process_time(), 0
    while step < settings.steps:
        batches = torch.randperm(len(strips.end), generator=generator).split(settings.batch)[: settings.steps - step]
        total = 0.0
        for batch in batches:
            for group in optimiser.param_groups:
                group["lr"] = 2e-3 * min(1.0, (step + 1) / 100) * 0.5 * (1 + np.cos(np.pi * step / settings.steps))
            optimiser.zero_grad()
            value = loss(network, strips.of(batch), generator)
            value.backward()
            torch.nn.utils.clip_grad_norm_(network.parameters(), 2.0)
            optimiser.step()
            total, step = total + value.item(), step + 1
        print(f"{time.process_time() - began:.0f} s, step {step}: loss {total / len(batches):.3f}", flush=True)
    return network.eval()


def report(network: StripNetwork, strips: LabelledStrips, name: str) -> None:
    """What it says of strips that it has not seen."""
    with torch.inference_mode():
        chord = torch.tensor([[0.0, ALONG - 1.0]]).expand(len(strips.end), 2)
        verdict = network.judge(strips.picture.float(), chord)
    known = strips.right >= 0
    right, p = strips.right[known] == 1, verdict.shaft[known].sigmoid()
    ended = (strips.end >= 0) & (strips.end < BORDER) & (strips.right == 1)
    place, kind, _ = (value[ended] for value in verdict.best_end())
    off = (place - strips.end[ended] % ALONG).abs()
    kinds = (kind == strips.end[ended] // ALONG).float().mean()
    told = (strips.forwards >= 0) & (strips.right == 1)
    way = ((verdict.forwards > 0) == (strips.forwards == 1))[told].float().mean()
    taken = [float((p > 0.5)[some].float().mean()) for some in (right, ~right)]
    near = [float((off <= columns).float().mean()) for columns in (1, 2, 5)]
    print(f"{name}: {int(right.sum())} right, {int((~right).sum())} wrong", end="; ")
    print(f"taken {taken[0]:.3f} of the right, {taken[1]:.3f} of the wrong; direction {float(way):.3f}", end="; ")
    print(f"end within 1, 2, 5 columns {near[0]:.3f}, {near[1]:.3f}, {near[2]:.3f}; its kind {float(kinds):.3f}")


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--out", required=True, help="file of the weights; the package's is strip_network.npz")
    parser.add_argument("--cache", type=Path, help="file that keeps the strips for another run")
    for field in dataclasses.fields(Training):
        parser.add_argument(f"--{field.name}", type=int, default=field.default)
    options = vars(parser.parse_args())
    out, cache = options.pop("out"), options.pop("cache")
    settings = Training(**options)
    settle()
    began = time.process_time()
    if cache and cache.exists():
        strips = LabelledStrips(**torch.load(cache))
    else:
        strips = gather(settings)
        if cache:
            torch.save(vars(strips), cache)
    print(f"{len(strips.end)} strips, {int((strips.right == 1).sum())} right; {time.process_time() - began:.0f} s")
    network = train(strips, settings)
    print(f"processor time {time.process_time() - began:.0f} s")
    save_weights(network, out, made_by(settings))
    check = settings.seed + 500_000
    others = {
        "presets held out": LabelledStrips.joined([of_world(check, i, HELD_OUT) for i in range(12)]),
        "other benches": LabelledStrips.joined([of_benches(check, i) for i in range(16)]),
        "other painted strips": painted(check, backgrounds(check, 30, 4), 1500),
    }
    for name, strips in others.items():
        report(network, strips, name)
        report(load_network(torch.device("cpu")), strips, f"{name}, weights of the package")


if __name__ == "__main__":
    main()
