"""Detection and `joint` on a device beside the same machine's CPU, as a table.

    python tests/device/measure.py [--device cuda] [--small]

Each number is the least of a few repeats after a warm call, the device's queue drained. `--small` is for trying the
script where there is no GPU.
"""

import argparse
import platform
import sys
import time
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

sys.path.insert(0, str(Path(__file__).resolve().parents[2]))

import torch

from data_synth.lines import simulate_lines
from rmis_calib.solver import Problem, SolverSettings, solve
from rmis_calib.vision import ShaftDetector
from tests.benchmarks.bench_vision_speed import drawn_picture
from tests.benchmarks.solver_common import REALISTIC, config

BATCHES, MOTIONS, TRIALS = (8, 16, 32, 64, 128, 256), (1_000, 10_000, 100_000, 1_000_000), 1_000
CPU_SECONDS = 8.0
"""The CPU leaves out what would take it longer, by the size before: it is there to compare with."""


def seconds(action: Callable[[], object], device: str, repeats: int = 3) -> float:
    """Least time of a call."""
    least = float("inf")
    for _ in range(repeats + 1):  # the first warms up
        _drain(device)
        began = time.perf_counter()
        action()
        _drain(device)
        took, first = time.perf_counter() - began, least == float("inf")
        least = min(least, took)
        if first and took > CPU_SECONDS:
            break
    return least


def _drain(device: str) -> None:
    if device.startswith("cuda"):
        torch.cuda.synchronize()


def detect(device: str, count: int) -> float:
    """Seconds for a batch of pictures of 1280x720, already on the device."""
    images = torch.from_numpy(drawn_picture()).permute(2, 0, 1)[None].repeat(count, 1, 1, 1).to(device)
    detector = ShaftDetector()
    return seconds(lambda: detector.detect(images), device)


def trials_of(problem: dict, device: str) -> Problem:
    return Problem.from_arrays(problem, device=device).only("contours", "ends")


def joint_motions(device: str, count: int) -> float:
    """Seconds for one recording of that many motions: a grid of 1,728, repeated with noise of its own."""
    problem = trials_of(simulate_lines(config(REALISTIC, 1)), device)
    index = torch.arange(count, device=device) % problem.n_motions
    many = problem.select_motions(index)
    shifted = many.arm_T_rcm.clone()
    shifted[..., :3, 3] += 0.05 * torch.randn_like(shifted[..., :3, 3])
    many = replace(many, arm_T_rcm=shifted)
    return seconds(lambda: solve(many, SolverSettings()), device)


def joint_trials(device: str, count: int) -> float:
    """Seconds for that many trials of 216 motions as one batch."""
    problem = trials_of(simulate_lines(config(REALISTIC, count, 0, 2, 3)), device)
    return seconds(lambda: solve(problem, SolverSettings()), device, repeats=1)


def rows(name: str, measure: Callable[[str, int], float], sizes: tuple[int, ...], devices: list[str]) -> None:
    """Rows of the table: items a second on each device, and how many times as fast the last one is."""
    too_long: set[str] = set()
    for before, size in zip((sizes[0], *sizes), sizes, strict=False):
        took: dict[str, float] = {}
        for device in devices:
            if device in too_long:
                continue
            took[device] = measure(device, size)
            if device == "cpu" and len(devices) > 1 and took[device] * max(2.0, size / before) > CPU_SECONDS:
                too_long.add(device)
        cells = [f"{took[d]:.3g} s, {size / took[d]:.3g}/s" if d in took else "-" for d in devices]
        times = f"{took['cpu'] / took[devices[-1]]:.1f}" if len(devices) > 1 and len(took) == len(devices) else "-"
        print(f"| {name} | {size:,} | {' | '.join(cells)} | {times} |", flush=True)


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--device", default="cuda")
    parser.add_argument("--small", action="store_true", help="small sizes")
    options = parser.parse_args()
    devices = list(dict.fromkeys(["cpu", options.device]))
    card = torch.cuda.get_device_name() if options.device.startswith("cuda") else "no GPU"
    cpu = f"{platform.processor() or platform.machine()}, {torch.get_num_threads()} threads"
    print(f"{card}; CPU: {cpu}; torch {torch.__version__}")
    print(f"| what | size | {' | '.join(devices)} | times as fast |\n| --- | --- |{' --- |' * (len(devices) + 1)}")
    rows("detection, 1280x720, pictures", detect, (2,) if options.small else BATCHES, devices)
    rows("joint, motions", joint_motions, (1_000,) if options.small else MOTIONS, devices)
    rows("joint, trials of 216 motions", joint_trials, (4,) if options.small else (TRIALS,), devices)
    return 0


if __name__ == "__main__":
    sys.exit(main())
