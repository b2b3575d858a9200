"""A small network that looks along a straight picture of a strip: is it a shaft, which way is its tip, where and how
does it end. The detector asks it for the end, where it recognises a shaft.

It was trained on rendered pictures only (tests/benchmarks/train_strip_network.py, which also writes the weights).
"""

import json
from dataclasses import dataclass
from functools import lru_cache
from importlib.resources import files
from typing import Any

import numpy as np
import torch
from jaxtyping import Float, Int64
from torch import Tensor, nn

from rmis_calib.vision.coarse.straight_pictures import ALONG, CHANNELS

KINDS = 2
"""Of ends in view: the tube's end, and a ring that closes it."""
_FEATURES, _DILATIONS = 32, (1, 2, 4, 8)
_WEIGHTS = "strip_network.npz"
_MADE_BY = "made_by"


@dataclass(frozen=True, eq=False)
class StripVerdict:
    """What the network says of m strips."""

    shaft: Float[Tensor, " m"]
    """Log odds that it is a shaft and both contours are its own."""
    forwards: Float[Tensor, " m"]
    """Log odds that the tip lies in the direction of growing t."""
    ends: Float[Tensor, "m kinds along"]
    """Probability that the shaft ends at a column, as a tube's end or as a ring."""
    border: Float[Tensor, " m"]
    """Probability that it leaves the picture before it ends."""
    hidden: Float[Tensor, " m"]
    """Probability that its end is hidden by something else."""
    chord: Float[Tensor, "m 2"]
    """Stations of the first and the last column, px."""

    @property
    def column_px(self) -> Float[Tensor, " m"]:
        """Distance of neighbouring columns."""
        return (self.chord[:, 1] - self.chord[:, 0]) / (ALONG - 1)

    def best_end(self) -> tuple[Float[Tensor, " m"], Int64[Tensor, " m"], Float[Tensor, " m"]]:
        """Station of the likeliest end, its kind, and the probability that it lies within two columns of there."""
        share = self.ends.sum(1)
        near = torch.nn.functional.avg_pool1d(share[:, None], 5, 1, 2, count_include_pad=True)[:, 0] * 5
        best = near.argmax(1, keepdim=True)
        window = (best + torch.arange(-2, 3, device=best.device)).clamp(0, ALONG - 1)
        weight = share.gather(1, window)
        column = (weight * window).sum(1) / weight.sum(1).clamp(min=1e-9)
        kind = self.ends.gather(2, window[:, None].expand(-1, KINDS, -1)).sum(2).argmax(1)
        return self.chord[:, 0] + column * self.column_px, kind, near.gather(1, best)[:, 0].clamp(max=1.0)


class StripNetwork(nn.Module):
    """Convolutions that narrow the strip to a line, then look along it."""

    def __init__(self) -> None:
        super().__init__()
        self.across = nn.ModuleList(
            [
                nn.Conv2d(CHANNELS, 12, (3, 5), 2, (1, 2)),  # 12 x 64
                nn.Conv2d(12, 16, 3, (2, 1), 1),  # 6 x 64
                nn.Conv2d(16, 24, 3, (2, 1), 1),  # 3 x 64
                nn.Conv2d(24, _FEATURES, 3, 1, (0, 1)),  # 1 x 64
            ]
        )
        self.along = nn.ModuleList([nn.Conv1d(_FEATURES, _FEATURES, 5, 1, 2 * d, d) for d in _DILATIONS])
        self.ends = nn.Conv1d(_FEATURES, 2 * KINDS, 3, 1, 1)
        self.hidden = nn.Linear(2 * _FEATURES, 24)
        self.whole = nn.Linear(24, 4)

    def forward(self, strip: Float[Tensor, "m 6 across along"]) -> tuple[Tensor, Tensor]:
        """Logits: (m, 2) of shaft and direction; (m, kinds * along + 2) of the end's kind and place, border, hidden."""
        x = strip
        for layer in self.across:
            x = layer(x).relu()
        x = x[:, :, 0]
        for layer in self.along:
            x = x + layer(x).relu()
        pooled = torch.cat([x.mean(-1), x.amax(-1)], 1)
        whole = self.whole(self.hidden(pooled).relu())
        ends = self.ends(x).unflatten(1, (KINDS, 2)).movedim(2, 3).flatten(2)  # two columns of the picture a station
        return whole[:, :2], torch.cat([ends.flatten(1), whole[:, 2:]], 1)

    def judge(self, strip: Float[Tensor, "m 6 across along"], chord: Float[Tensor, "m 2"]) -> StripVerdict:
        """The logits as a verdict on strips whose first and last columns are these stations."""
        # One strip alone would be convolved by another algorithm, and rounded otherwise than among others.
        whole, ends = (
            logits[: len(strip)] for logits in self(strip if len(strip) != 1 else strip.expand(2, -1, -1, -1))
        )
        share = ends.softmax(1)
        place = share[:, :-2].unflatten(1, (KINDS, ALONG))
        return StripVerdict(whole[:, 0], whole[:, 1], place, share[:, -2], share[:, -1], chord)


@lru_cache(maxsize=8)
def load_network(device: torch.device) -> StripNetwork:
    """The trained network, its weights in half precision in the package."""
    network = StripNetwork()
    with (files("rmis_calib.vision.coarse") / _WEIGHTS).open("rb") as file, np.load(file) as stored:
        weights = {name: torch.from_numpy(stored[name].astype(np.float32)) for name in stored.files if name != _MADE_BY}
    network.load_state_dict(weights)
    return network.eval().requires_grad_(False).to(device)


def made_by() -> dict[str, Any]:
    """What the weights in the package were made by: script, version, seed, settings and their hash."""
    with (files("rmis_calib.vision.coarse") / _WEIGHTS).open("rb") as file, np.load(file) as stored:
        return json.loads(str(stored[_MADE_BY]))


def save_weights(network: StripNetwork, path: str, made_by: dict[str, Any]) -> None:
    """Write the weights in half precision, and what they were made by."""
    arrays = {name: w.detach().cpu().numpy().astype(np.float16) for name, w in network.state_dict().items()}
    arrays[_MADE_BY] = np.array(json.dumps(made_by, sort_keys=True))
    np.savez_compressed(path, **arrays)  # pyright: ignore[reportArgumentType]
