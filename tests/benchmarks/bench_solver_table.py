"""The table of the design, in the independent simulation: where `paper` collapses, where `global` is biased, and the
bound.

    python tests/benchmarks/bench_solver_table.py [--trials 20]

N = 1,728 (3 positions a laparoscope joint, 4 an instrument joint), 10 degrees and 20 mm, axis lines of both cameras.
"""

import argparse
import sys
from pathlib import Path

sys.path.insert(0, str(Path(__file__).resolve().parents[2]))

from rmis_calib.solver import SolverSettings, solve
from tests.benchmarks.solver_common import KNOWN_RADIUS, config, errors, rms, rotation_deg, study, translation_mm

ROWS = [
    ("pixel only, 0.5 px", (0.5, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0)),
    ("0.3 mm, 0.1 deg; stereo 0.05", (0.5, 0.3, 0.1, 0.0, 0.0, 0.05, 0.05)),
    ("c=1 kinematics", (0.5, 1.0, 1.0, 0.0, 0.0, 0.0, 0.0)),
    ("c=1 kinematics and camera", (0.5, 1.0, 1.0, 1.0, 1.0, 0.0, 0.0)),
    ("c=1 all three", (0.5, 1.0, 1.0, 1.0, 1.0, 1.0, 1.0)),
]


def main() -> int:
    parser = argparse.ArgumentParser()
    parser.add_argument("--trials", type=int, default=20)
    parser.add_argument("--range-deg", type=float, default=10.0)
    parser.add_argument("--range-mm", type=float, default=20.0)
    args = parser.parse_args()
    settings = SolverSettings(unknowns=KNOWN_RADIUS)
    print(f"deg / mm, median [rmse] of {args.trials} trials, axis lines, stereo; (paper: trials off by > 20 deg)")
    print(f"{'noise':30} | {'paper':32} | {'global':30} | {'joint':30} | {'bound':15} | joint, contours + ends (bound)")
    for name, noise in ROWS:
        settings_of = config(
            noise, args.trials, 7, rotation_range_deg=args.range_deg, translation_range_mm=args.range_mm
        )
        trial = study(settings_of, ("axis",))
        cells = []
        for method in ("paper", "global", "joint"):
            e = errors(solve(trial.problem, settings, method).camera_right_T_arm, trial.truth)
            turn, shift = rotation_deg(e), translation_mm(e)
            text = f"{float(turn.median()):.3f} / {float(shift.median()):.3f} [{rms(turn):.3f} / {rms(shift):.3f}]"
            cells.append(text + (f" ({int((turn > 20).sum())})" if method == "paper" else ""))
        more = study(settings_of, ("contours", "ends"))
        e = errors(solve(more.problem, settings).camera_right_T_arm, more.truth)
        cells.append(f"{trial.bound_deg:.3f} / {trial.bound_mm:.3f}")
        cells.append(
            f"[{rms(rotation_deg(e)):.3f} / {rms(translation_mm(e)):.3f}] ({more.bound_deg:.3f} / {more.bound_mm:.3f})"
        )
        print(f"{name:30} | {cells[0]:32} | {cells[1]:30} | {cells[2]:30} | {cells[3]:15} | {cells[4]}", flush=True)
    return 0


if __name__ == "__main__":
    sys.exit(main())
