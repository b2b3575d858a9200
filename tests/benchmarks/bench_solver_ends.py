"""Shaft ends at one place of the instrument, at two, or anywhere: what the estimate says, and whether it is right.

    python tests/benchmarks/bench_solver_ends.py [--trials 200] [--laparoscope 1]

Simulated stereo contours and ends, 60 motions, 0.3 px, 0.3 mm, 0.1 deg, levels of noise unknown; two places are 9 mm
apart. Columns: trials of which the truth is in the 95 % ellipsoid and beyond 3 sigma; median sigma; median distance of
the two places with its sigma; share of the ends that were left out.
"""

import argparse
import sys
from dataclasses import replace
from pathlib import Path

sys.path.insert(0, str(Path(__file__).resolve().parents[2]))

import torch

from rmis_calib.geometry.rotations import matrix_to_rotvec
from rmis_calib.solver import Problem, solve
from tests.solver.estimate.mixed_ends import GAP_MM, with_ends

CASES = {
    "all at one place": (0.0, 0.0),
    "70 % ring, 30 % tip": (0.3, 0.0),
    "50 % ring, 50 % tip": (0.5, 0.0),
    "80 % ring, 20 % anywhere": (0.0, 0.2),
    "55 % ring, 25 % tip, 20 % anywhere": (0.25, 0.2),
    "all anywhere": (0.0, 1.0),
}
NOISE = {
    "pixel_noise_px": 0.3, "kinematics_noise_mm": 0.3, "kinematics_noise_deg": 0.1, "stereo_noise_mm": 0.05,
    "stereo_noise_deg": 0.05,
}  # fmt: skip
IN_95, BEYOND_3_SIGMA = 12.592, 20.1
"""Squared distances of 6 unknowns."""


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--trials", type=int, default=200)
    parser.add_argument("--laparoscope", type=int, default=1, help="1: it stands still")
    arguments = parser.parse_args()
    print(f"{'ends':36} in 95 %  beyond 3 sigma  sigma             gap, mm        left out")
    for name, (tip, anywhere) in CASES.items():
        arrays = with_ends(
            tip, anywhere, seed=5, trials=arguments.trials, motion="random", random_motions=60,
            positions_laparoscope=arguments.laparoscope, **NOISE,
        )  # fmt: skip
        truth = torch.as_tensor(arrays.pop("truth")["camera_right_T_arm"])
        del arrays["is_tip_right"], arrays["is_tip_left"]
        problem = Problem.from_arrays(arrays).only("contours", "ends")
        unknown = torch.full_like(problem.noise.image, torch.nan)
        levels = replace(problem.noise, image=unknown, kinematics_mm=unknown, kinematics_rad=unknown)
        solution = solve(replace(problem, noise=levels))
        found = solution.camera_right_T_arm
        turn = matrix_to_rotvec(truth[:, :3, :3] @ found[:, :3, :3].mT)
        off = torch.cat((turn, truth[:, :3, 3] - found[:, :3, 3]), -1)
        distance2 = (off * torch.linalg.solve(solution.covariance, off[..., None])[..., 0]).sum(-1)
        gap = solution.nuisances.get("end_gap")
        two = "" if gap is None else f"{gap.value.abs().median():.3f} +- {gap.sigma.median():.3f}"
        assert solution.ends_elsewhere is not None
        beyond = int((~(distance2 < BEYOND_3_SIGMA) & solution.converged).sum())
        share = (solution.ends_elsewhere / problem.end_measured.sum((1, 2))).mean()
        print(
            f"{name:36} {100 * (distance2 < IN_95).double().mean():5.1f} %  "
            f"{beyond:4d} of {int(solution.converged.sum()):4d}    "
            f"{solution.rotation_sigma_deg.median():.3f} deg {solution.translation_sigma_mm.median():.2f} mm  {two:15} "
            f"{100 * share:.0f} %",
            flush=True,
        )
    print(f"two places are {GAP_MM:g} mm apart")


if __name__ == "__main__":
    main()
