"""Coverage: how often the 95 % ellipsoid of the reported covariance holds the truth, with given and with estimated
noise levels.

python tests/benchmarks/bench_solver_coverage.py [--trials 1000]
"""

import argparse
import sys
from dataclasses import replace
from pathlib import Path

sys.path.insert(0, str(Path(__file__).resolve().parents[2]))

import torch

from rmis_calib.solver import SolverSettings, solve
from tests.benchmarks.solver_common import KNOWN_RADIUS, REALISTIC, config, errors, study

QUANTILE_95 = 12.5916  # chi^2, 6 degrees of freedom
CELLS = [
    ("moving, stereo, axis", ("axis",), 2, {"motion": "random", "random_motions": 343}, 3),
    ("moving, stereo, contours + ends", ("contours", "ends"), 2, {"motion": "random", "random_motions": 343}, 3),
    ("moving, mono, contours + ends", ("contours", "ends"), 1, {"motion": "random", "random_motions": 60}, 3),
    ("static, mono, contours + ends", ("contours", "ends"), 1, {"motion": "random", "random_motions": 343}, 1),
    ("static, stereo, contours + ends", ("contours", "ends"), 2, {"motion": "random", "random_motions": 60}, 1),
]


def main() -> int:
    parser = argparse.ArgumentParser()
    parser.add_argument("--trials", type=int, default=1000)
    parser.add_argument("--only", type=int, nargs="*")
    args = parser.parse_args()
    bad = 0
    print(f"{'scene':34} {'N':>4} | noise given | noise estimated  (inside, of {args.trials}; 0.93 to 0.97)")
    for i, (name, kinds, cameras, motion, laparoscope) in enumerate(CELLS):
        if args.only and i not in args.only:
            continue
        trial = study(config(REALISTIC, args.trials, 11, laparoscope, 1, **motion), kinds, cameras)
        inside, scale = [], []
        noise = trial.problem.noise
        unknown = torch.full_like(noise.image, torch.nan)
        # Image points keep their nominal sigma, as a detector gives it; the common factor and the kinematics are
        # unknown.
        free = replace(trial.problem, noise=replace(noise, kinematics_mm=unknown, kinematics_rad=unknown))
        always = replace(SolverSettings(unknowns=KNOWN_RADIUS).noise, estimate="always")
        for problem, settings in (
            (trial.problem, SolverSettings(unknowns=KNOWN_RADIUS)),
            (free, SolverSettings(unknowns=KNOWN_RADIUS, noise=always)),
        ):
            solution = solve(problem, settings)
            e = errors(solution.camera_right_T_arm, trial.truth)
            distance2 = (e[:, None] @ torch.linalg.solve(solution.covariance, e[..., None]))[:, 0, 0]
            inside.append(float((distance2 < QUANTILE_95).double().mean()))
            scale.append(float(distance2.mean() / 6.0))
            bad += not 0.93 <= inside[-1] <= 0.97
        print(
            f"{name:34} {trial.problem.n_motions:4d} |   {inside[0]:.3f}     |   {inside[1]:.3f}"
            f"      mean d^2/6: {scale[0]:.2f}, {scale[1]:.2f}",
            flush=True,
        )
    return 1 if bad else 0


if __name__ == "__main__":
    sys.exit(main())
