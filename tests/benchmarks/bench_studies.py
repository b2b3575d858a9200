"""Monte-Carlo trials in one batch against the same trials one by one through the same solver.

    python tests/benchmarks/bench_studies.py [--trials 500]

Kinematics 0.3 mm and 0.1 deg, 0.5 px, stereo; seconds, and their ratio. The answers are the same.
"""

import argparse
import sys
import time
from dataclasses import replace
from pathlib import Path

sys.path.insert(0, str(Path(__file__).resolve().parents[2]))

import torch

from rmis_calib.solver import Solution
from rmis_calib.studies.registry import find_method
from rmis_calib.studies.settings import SetupSettings
from rmis_calib.studies.simulation import Condition, make_setup, simulate

LEVELS = (("kinematics_noise_mm", 0.3), ("kinematics_noise_deg", 0.1))
METHODS = ("paper", "global", "joint-axis", "joint-contours")
GRIDS = ((1, 3), (2, 2), (2, 3), (3, 4))
ONE_BY_ONE = 20
"""Trials that are timed one by one; all others take as long."""


def main() -> None:
    parser = argparse.ArgumentParser()
    parser.add_argument("--trials", type=int, default=500)
    trials = parser.parse_args().trials
    setup = make_setup(SetupSettings())
    print(f"{torch.get_num_threads()} threads, torch {torch.__version__}; {trials} trials, s")
    print(f"{'method':15} {'motions':>7} {'batch':>8} {'one by one':>11} {'ratio':>6}   largest difference")
    for lap, tool in GRIDS:
        problem = simulate(
            setup, replace(Condition.on_grid("", 0.0, lap, tool), levels=LEVELS), None, trials, 0
        ).problem
        for name in METHODS:
            method = find_method(name)
            seen = problem.only(*method.measurements)
            method.solve(seen.take_trials(slice(0, 2)))  # warm
            start = time.perf_counter()
            together = _transforms(method.solve(seen))
            batch_s = time.perf_counter() - start
            start = time.perf_counter()
            alone = [_transforms(method.solve(seen.take_trials(slice(i, i + 1)))) for i in range(ONE_BY_ONE)]
            each_s = (time.perf_counter() - start) * trials / ONE_BY_ONE
            gap = float((torch.cat(alone) - together[:ONE_BY_ONE]).abs().max())
            row = f"{name:15} {problem.n_motions:7d} {batch_s:8.2f} {each_s:11.1f} {each_s / batch_s:6.1f}   {gap:.1e}"
            print(row, flush=True)


def _transforms(found: Solution | torch.Tensor) -> torch.Tensor:
    return found.camera_right_T_arm if isinstance(found, Solution) else found


if __name__ == "__main__":
    main()
