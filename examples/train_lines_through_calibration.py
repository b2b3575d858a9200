"""Train a line detector through the calibration: no edge is labelled, only a tracked head point.

Specular highlights lie beside the contour of a metal shaft, and an edge detector that looks for the steepest change of
brightness takes them for it. Here a small network looks at the brightness across each contour (a rendered profile of 21
samples) and says where the contour is. What it is told is not where: it learns from how far the calibrated transform
puts the instrument's head point from where it was tracked, and the gradient passes through the whole calibration
(`rc.solve(..., differentiable=True)`). The score is the same distance in scenes that it has not seen.

    python examples/train_lines_through_calibration.py

It takes about twenty seconds on two cores.
"""

import math
from typing import Any

import torch
from torch import Tensor

import rmis_calib as rc
from data_synth.lines import simulate_lines
from data_synth.settings import LineStudyConfig
from rmis_calib.config import parse_config

FOCAL_PX = 800.0
SAMPLES_PX = torch.linspace(-5.0, 5.0, 21)
"""Where a profile is sampled, from the place that is guessed first; positive on the side of the tissue."""
GUESS_PX, BLUR_PX, GRAIN = 1.0, 0.8, 0.02
CONFIG = parse_config({"measurements": ["contours"], "solver": {"robust": "off", "bias_correction": False}})
SIDES = ("right", "left")


def scenes(count: int, seed: int) -> dict[str, Any]:
    """Exact contours of `count` scenes, in the keys of an observations file, and what is tracked."""
    study = LineStudyConfig(
        trials=count, seed=seed, motion="random", random_motions=24, rotation_range_deg=30.0, pixel_noise_px=0.0,
        kinematics_noise_mm=0.1, kinematics_noise_deg=0.03,
    )  # fmt: skip
    arrays = simulate_lines(study)
    arrays["sigma_image"] = 0.3 / FOCAL_PX
    return arrays


def profiles(shape: torch.Size, generator: torch.Generator) -> tuple[Tensor, Tensor]:
    """Brightness across contours, (*shape, 21), and where each contour is, px from the first guess."""

    def uniform(low: float, high: float) -> Tensor:
        return low + (high - low) * torch.rand(*shape, 1, generator=generator)

    edge = uniform(-GUESS_PX, GUESS_PX)
    from_edge = SAMPLES_PX - edge
    step = 0.5 * (1.0 + torch.erf(from_edge / (math.sqrt(2.0) * BLUR_PX)))
    highlight = uniform(0.0, 0.8) * torch.exp(-0.5 * ((from_edge + uniform(1.5, 2.5)) / 0.7) ** 2)
    grain = GRAIN * torch.randn(*shape, len(SAMPLES_PX), generator=generator)
    return uniform(0.1, 0.2) + uniform(0.3, 0.6) * step + highlight + grain, edge[..., 0]


def steepest(profile: Tensor) -> Tensor:
    """Where the brightness changes most, px: centroid of the squared gradient."""
    weight = profile.diff(dim=-1).square()
    middle = 0.5 * (SAMPLES_PX[1:] + SAMPLES_PX[:-1])
    return (weight * middle).sum(-1) / weight.sum(-1)


class LineNetwork(torch.nn.Module):
    """Corrects `steepest` by what the profile looks like. At first it corrects nothing."""

    def __init__(self) -> None:
        super().__init__()
        last = torch.nn.Linear(32, 1)
        torch.nn.init.zeros_(last.weight)
        torch.nn.init.zeros_(last.bias)
        tanh = torch.nn.Tanh()
        self.layers = torch.nn.Sequential(
            torch.nn.Linear(len(SAMPLES_PX), 32), tanh, torch.nn.Linear(32, 32), tanh, last
        )

    def forward(self, profile: Tensor) -> Tensor:
        # Around each profile's own steepest place, and of one contrast: the rest is for the network to see.
        spread = profile.std(dim=-1, keepdim=True)
        return steepest(profile) + self.layers((profile - profile.mean(dim=-1, keepdim=True)) / spread)[..., 0]


def measured(arrays: dict[str, Any], find_edge: Any, generator: torch.Generator) -> dict[str, Any]:
    """The scenes as `find_edge` sees them (None: exactly): each contour point moved by the error of its edge."""
    out = {key: value for key, value in arrays.items() if not key.startswith(("axis_", "end_", "head_", "truth"))}
    for side in SIDES:
        exact = torch.as_tensor(arrays[f"contour_{side}"])  # (scene, motion, edge, point, xy)
        profile, edge = profiles(exact.shape[:-1], generator)
        error = (torch.zeros_like(edge) if find_edge is None else find_edge(profile) - edge).double() / FOCAL_PX
        along = exact[..., 1:, :] - exact[..., :1, :]
        along = along / torch.linalg.vector_norm(along, dim=-1, keepdim=True)
        outward = torch.stack((along[..., 1], -along[..., 0]), dim=-1)  # edge 0 lies left of the axis
        outward = outward * torch.tensor([1.0, -1.0], dtype=outward.dtype)[:, None, None]
        outward = torch.nan_to_num(outward)  # what is not in the picture stays NaN, and must not reach the gradient
        out[f"contour_{side}"] = exact + error[..., None] * outward
    return out


def head_error_mm(arrays: dict[str, Any], observations: dict[str, Any]) -> Tensor:
    """How far the calibrated transform puts the head point from where it was tracked; root mean square of a scene."""
    solution = rc.solve(observations, CONFIG, differentiable=True)
    truth = {key: torch.as_tensor(value) for key, value in arrays["truth"].items() if key.startswith("camera")}
    arm_T_rcm, rcm_p_head = torch.as_tensor(arrays["arm_T_rcm"]), torch.as_tensor(arrays["rcm_p_head"])
    X = solution.camera_right_T_arm[:, None] @ arm_T_rcm
    found = (X[..., :3, :3] @ rcm_p_head[..., None])[..., 0] + X[..., :3, 3]
    tracked = truth["camera_right_T_rcm"]
    there = (tracked[..., :3, :3] @ rcm_p_head[..., None])[..., 0] + tracked[..., :3, 3]
    return (found - there).square().sum(-1).mean(-1).sqrt()


def train(steps: int = 60, batch: int = 4, seed: int = 0) -> LineNetwork:
    """A network that has seen `steps` times `batch` scenes."""
    torch.manual_seed(seed)
    network, generator = LineNetwork(), torch.Generator().manual_seed(seed)
    optimiser = torch.optim.Adam(network.parameters(), lr=5e-3)
    for step in range(steps):
        arrays = scenes(batch, seed=1000 + step)
        error = head_error_mm(arrays, measured(arrays, network, generator))
        optimiser.zero_grad()
        error.mean().backward()
        optimiser.step()
        if step % 10 == 0:
            print(f"step {step:3d}: head point off by {float(error.detach().mean()):.2f} mm in training")
    return network


def held_out_mm(find_edge: Any, count: int = 24) -> float:
    """Median head-point error in scenes that nothing was trained on."""
    arrays, generator = scenes(count, seed=1), torch.Generator().manual_seed(1)
    with torch.no_grad():
        return float(head_error_mm(arrays, measured(arrays, find_edge, generator)).median())


def main() -> tuple[float, float]:
    before = held_out_mm(steepest)
    network = train()
    after = held_out_mm(network)
    print(
        f"held-out scenes: head point off by {before:.2f} mm with the steepest edge, {after:.2f} mm with the network, "
        f"{held_out_mm(None):.2f} mm with exact edges"
    )
    return before, after


if __name__ == "__main__":
    main()
