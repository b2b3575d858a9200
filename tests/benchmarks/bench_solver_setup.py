"""The set-up as an unknown with no prior: error of both transforms against the bound, the basin, and coverage.

    python tests/benchmarks/bench_solver_setup.py [--trials 100] [--scenes NAME ...]

Scenes without pictures: 0.3 px; 0.3 mm, 0.1 deg; stereo 0.05 mm, 0.05 deg; contours, ends and axis; radius, end
offset and stereo extrinsics free. The hand-eye transform and the instrument's base are anywhere, others each trial,
and nothing states them. Columns: error of `camera_right_T_arm` and of the set-up (root mean square) with their bound
(NumPy, tests/solver/estimate/setup_bound.py); error over bound of all 12 numbers; trials in the right basin; truth in
the 95 % ellipsoid of 12 unknowns, and of the 6 of the transform; error over bound where the set-up is known.
"""

import argparse
import sys
import time
from pathlib import Path

sys.path.insert(0, str(Path(__file__).resolve().parents[2]))
sys.path.insert(0, str(Path(__file__).resolve().parents[1] / "solver" / "estimate"))

import numpy as np
import torch
from setup_bound import Scene, bound
from test_setup import SETUP, error, errors, mahalanobis2, measured, unknown, unstated

from data_synth.kinematics import rigid_inverse
from data_synth.lines import simulate_lines
from data_synth.settings import LineStudyConfig
from rmis_calib.solver import solve

NOISE = {"pixel_noise_px": 0.3, "kinematics_noise_mm": 0.3, "kinematics_noise_deg": 0.1}
NOISE |= {"stereo_noise_mm": 0.05, "stereo_noise_deg": 0.05}
SIGMA = (0.3 / 800.0, 0.3, np.deg2rad(0.1), (0.05, np.deg2rad(0.05)))
SCENES = {
    "8 places x 8": {"positions_laparoscope": 2, "positions_instrument": 2},
    "8 places x 27": {"positions_laparoscope": 2, "positions_instrument": 3},
    "27 places x 64": {"positions_laparoscope": 3, "positions_instrument": 4},
    "27 x 64, 20 deg": {
        "positions_laparoscope": 3, "positions_instrument": 4, "rotation_range_deg": 20.0, "translation_range_mm": 40.0,
    },
}  # fmt: skip
INSIDE_95 = {6: 12.592, 12: 21.026}
FAR_FROM_ALL = 1.0
"""Rotation error, rad, beyond which an answer is in another basin."""


def rms(gap: torch.Tensor) -> str:
    turn, shift = (part.square().sum(-1).mean().sqrt() for part in (gap[:, :3], gap[:, 3:]))
    return f"{float(torch.rad2deg(turn)):.3f} deg {float(shift):.2f} mm"


def size(C: np.ndarray) -> str:
    return f"({np.rad2deg(np.sqrt(np.trace(C[:3, :3]))):.3f} {np.sqrt(np.trace(C[3:, 3:])):.2f})"


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--trials", type=int, default=100)
    parser.add_argument("--scenes", nargs="+", default=list(SCENES), choices=list(SCENES))
    arguments = parser.parse_args()
    for name in arguments.scenes:
        fields = SCENES[name]
        exact = simulate_lines(LineStudyConfig(trials=1, pixel_noise_px=0.0, **fields))
        scene = Scene(exact, *SIGMA)
        C, known = bound(scene), bound(scene, setup_known=True)
        trials = LineStudyConfig(trials=arguments.trials, seed=2, random_hand_eye=True, **NOISE, **fields)
        arrays = simulate_lines(trials)
        given, S = unstated(arrays, np.random.default_rng(0))
        started = time.perf_counter()
        solution = solve(measured(given), unknown("known"))
        seconds = time.perf_counter() - started
        X = arrays["truth"]["camera_right_T_arm"]
        own = errors(solution, X, S)
        # The bound is that of the scene's own frames: into them, from those of each trial.
        to_arm = rigid_inverse(X) @ exact["truth"]["camera_right_T_arm"]
        to_base = rigid_inverse(S) @ exact[SETUP]

        scene_X, setup_truth = exact["truth"]["camera_right_T_arm"], exact[SETUP]
        turned = solution.camera_right_T_arm @ torch.as_tensor(to_arm)
        setup = solution.setup.laparoscope_base_T_instrument_base @ torch.as_tensor(to_base)
        gap = torch.cat((error(turned, scene_X), error(setup, setup_truth)), dim=-1)
        right = gap[:, :3].norm(dim=-1) < FAR_FROM_ALL
        d12, d6 = mahalanobis2(own, solution.setup.covariance), mahalanobis2(own[:, :6], solution.covariance)
        known_T = solve(measured(arrays), unknown("known")).camera_right_T_arm
        believed = error(known_T @ torch.as_tensor(to_arm), scene_X)
        every = torch.as_tensor(C).expand(len(gap), 12, 12)
        efficiency = (mahalanobis2(gap[right], every[right]).mean() / 12.0).sqrt()
        print(
            f"{name:16} transform {rms(gap[right, :6])} bound {size(C[:6, :6])}, set-up {rms(gap[right, 6:])} bound "
            f"{size(C[6:, 6:])}; error over bound {float(efficiency):.2f}; right basin "
            f"{int(right.sum())} of {len(right)}; in 95 %: {100 * float((d12 < INSIDE_95[12]).double().mean()):.1f} %, "
            f"{100 * float((d6 < INSIDE_95[6]).double().mean()):.1f} %; set-up known: "
            f"{rms(believed)} bound {size(known)}; {seconds:.1f} s",
            flush=True,
        )


if __name__ == "__main__":
    main()
