"""Recordings pooled against one big solve of all their motions: what adding statistics costs.

    python tests/benchmarks/bench_pooling.py [--motions 100000] [--parts 20]

`global`: Gram matrices of the parts, added, against those of the whole. `joint`: results of the parts pooled
(`rc.pool`), against the result of the whole, in its sigmas: without the bias correction, with it, and with another seed
for each part's (its simulations average a sixteenth of the motions; one seed makes the same error in every part).
0.3 px; 0.3 mm, 0.1 deg; stereo 0.05 mm, 0.05 deg.
"""

import argparse
import functools
import sys
import time
from dataclasses import fields, replace
from pathlib import Path

sys.path.insert(0, str(Path(__file__).resolve().parents[2]))

import numpy as np
import torch

import rmis_calib as rc
from data_synth.lines import simulate_lines
from data_synth.settings import LineStudyConfig
from rmis_calib.config import parse_config
from rmis_calib.geometry.rotations import matrix_to_rotvec
from rmis_calib.solver import Problem
from rmis_calib.solver.start.line_statistics import LineStatistics

CASES = (
    ("no bias correction", False, False),
    ("bias correction, one seed", True, False),
    ("bias correction, a seed a part", True, True),
)


def settings(bias: bool, seed: int) -> rc.CalibrationConfig:
    solver = {"noise": {"estimate": "never"}, "unknowns": {"edge_bias": False}, "groups": 0, "advice": {"motions": 0}}
    return parse_config({"solver": solver | {"bias_correction": bias, "seed": seed}})


def observations(motions: int) -> rc.ShaftObservations:
    noise = {"pixel_noise_px": 0.3, "kinematics_noise_mm": 0.3, "kinematics_noise_deg": 0.1}
    stereo = {"stereo_noise_mm": 0.05, "stereo_noise_deg": 0.05}
    arrays = simulate_lines(LineStudyConfig(trials=1, motion="random", random_motions=motions, **noise, **stereo))
    known = {field.name for field in fields(rc.ShaftObservations)}
    values = {key: np.squeeze(np.asarray(value)) for key, value in arrays.items() if key in known}
    return rc.ShaftObservations(**{key: value if value.ndim else float(value) for key, value in values.items()})


def part(seen: rc.ShaftObservations, motions: slice) -> rc.ShaftObservations:
    n = len(seen.arm_T_rcm)
    changes = {
        key: value[motions] for key, value in vars(seen).items() if isinstance(value, np.ndarray) and len(value) == n
    }
    return replace(seen, **changes)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--motions", type=int, default=100_000)
    parser.add_argument("--parts", type=int, default=20)
    arguments = parser.parse_args()
    seen = observations(arguments.motions)
    parts = [part(seen, slice(i, None, arguments.parts)) for i in range(arguments.parts)]
    whole = LineStatistics.from_problem(Problem.from_observations(seen).flatten_batch())
    sums = functools.reduce(
        LineStatistics.__add__,
        (LineStatistics.from_problem(Problem.from_observations(each).flatten_batch()) for each in parts),
    )
    for name in ("rotation_gram", "point_gram"):
        a, b = getattr(whole, name), getattr(sums, name)
        print(
            f"global, {name}: sum of parts and whole differ by {float((a - b).abs().max() / a.abs().max()):.1e} of it"
        )
    for words, bias, own_seeds in CASES:
        start = time.perf_counter()
        big = rc.solve(seen, settings(bias, 0), throw=False)
        took_big = time.perf_counter() - start
        start = time.perf_counter()
        pooled = rc.pool(
            [rc.solve(each, settings(bias, seed * own_seeds), throw=False) for seed, each in enumerate(parts)]
        )
        took_parts = time.perf_counter() - start
        R, t = big.camera_right_T_arm.R, big.camera_right_T_arm.t
        turn = matrix_to_rotvec(pooled.camera_right_T_arm.R @ R.mT)
        gap = torch.cat([turn, pooled.camera_right_T_arm.t - t]).numpy()
        sigma = np.sqrt(np.diag(big.covariance))
        ratio = np.sqrt(np.diag(pooled.covariance)) / sigma
        print(
            f"joint, {words}: off by {np.abs(gap / sigma).max():.4f} sigma at most; sigma of the pooled one "
            f"{ratio.min():.3f} to {ratio.max():.3f} of the whole's; {took_big:.1f} s, parts {took_parts:.1f} s",
            flush=True,
        )


if __name__ == "__main__":
    main()
