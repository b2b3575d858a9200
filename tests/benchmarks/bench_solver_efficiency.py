"""Efficiency: rmse over the Cramer-Rao bound, rotation and translation, of `joint` with and without the bias
correction.

python tests/benchmarks/bench_solver_efficiency.py [--trials 200] [--out FILE.json]
"""

import argparse
import json
import sys
import time
from dataclasses import replace
from pathlib import Path

sys.path.insert(0, str(Path(__file__).resolve().parents[2]))

from rmis_calib.solver import SolverSettings, solve
from tests.benchmarks.solver_common import (
    KNOWN_RADIUS,
    REALISTIC,
    config,
    errors,
    level,
    rms,
    rotation_deg,
    study,
    translation_mm,
)

CELLS = [("realistic", REALISTIC), ("c = 0.5", level(0.5)), ("c = 1", level(1.0)), ("c = 2", level(2.0))]
LIMITS = {"realistic": 1.1, "c = 0.5": 1.15, "c = 1": 1.2}
KINDS = [("axis", ("axis",)), ("contours", ("contours", "ends"))]


def cell(name, noise, kinds, laparoscope, instrument, cameras, trials, **more):
    """One row of the table."""
    start = time.time()
    trial = study(config(noise, trials, 1, laparoscope, instrument, **more), kinds, cameras)
    row = {
        "noise": name,
        "N": trial.problem.n_motions,
        "kinds": "+".join(kinds),
        "cameras": cameras,
        "static": laparoscope == 1,
    }
    row |= {"bound_deg": trial.bound_deg, "bound_mm": trial.bound_mm}
    settings = SolverSettings(unknowns=KNOWN_RADIUS)
    for label, chosen in (("plain", replace(settings, bias_correction=False)), ("joint", settings)):
        solution = solve(trial.problem, chosen)
        e = errors(solution.camera_right_T_arm, trial.truth)
        row[f"{label}_deg"], row[f"{label}_mm"] = rms(rotation_deg(e)), rms(translation_mm(e))
        row[f"{label}_worst_deg"] = float(rotation_deg(e).max())
        row[f"{label}_ratio_deg"], row[f"{label}_ratio_mm"] = (
            row[f"{label}_deg"] / trial.bound_deg,
            row[f"{label}_mm"] / trial.bound_mm,
        )
    row["seconds"] = time.time() - start
    return row


def main():
    parser = argparse.ArgumentParser()
    parser.add_argument("--trials", type=int, default=200)
    parser.add_argument("--out", type=Path)
    args = parser.parse_args()
    rows, bad = [], []
    print(
        f"{'noise':10} {'N':>5} {'measurements':14} {'cams':>4} | {'bound':>17} | {'plain':>17} | {'joint':>12} | worst"
    )
    for name, noise in CELLS:
        for _, kinds in KINDS:
            for more in (
                {},
                {"motion": "random", "random_motions": 343},
            ):  # the grid of 1,728, and 343 at random in the same range
                rows.append(cell(name, noise, kinds, 3, 4, 2, args.trials, **more))
                report(rows[-1], bad)
    rows.append(cell("realistic", REALISTIC, ("contours", "ends"), 1, 7, 1, args.trials))
    report(rows[-1], bad, 1.15)
    if args.out:
        args.out.write_text(json.dumps(rows, indent=1))
    print("\n".join(bad) or "all within the limits")
    return 1 if bad else 0


def report(row, bad, limit=None):
    label = "static" if row["static"] else row["noise"]
    print(
        f"{label:10} {row['N']:5d} {row['kinds']:14} {row['cameras']:4d} | "
        f"{row['bound_deg']:.4f} {row['bound_mm']:7.4f} mm | "
        f"{row['plain_ratio_deg']:8.2f} {row['plain_ratio_mm']:8.2f} | "
        f"{row['joint_ratio_deg']:5.2f} {row['joint_ratio_mm']:5.2f} | "
        f"{row['joint_worst_deg']:.2f}",
        flush=True,
    )
    limit = limit or LIMITS.get(row["noise"])
    if limit and (row["joint_ratio_deg"] > limit or row["joint_ratio_mm"] > limit or row["joint_worst_deg"] > 5.0):
        bad.append(f"above {limit}: {row['noise']} N={row['N']} {row['kinds']}")


if __name__ == "__main__":
    sys.exit(main())
