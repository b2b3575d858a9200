"""The real recording, by measurements used: how far from the reference, and whether the program's own sigma says so.

    python tests/benchmarks/bench_solver_real.py [--observations OUT/observations.npz]

Lines and ends are found by the program itself (`rmis-calib calibrate` writes the observations; it runs here when no
file is given). The reference is itself good to 0.8 mm.
"""

import argparse
import sys
import tempfile
from dataclasses import replace
from pathlib import Path

sys.path.insert(0, str(Path(__file__).resolve().parents[2]))

import numpy as np
import torch
import yaml

from rmis_calib.cli import main as command_line
from rmis_calib.io import ShaftObservations
from rmis_calib.solver import Problem, SolverSettings, solve
from rmis_calib.solver.observability import Verdict
from rmis_calib.solver.settings import UnknownSettings
from tests.benchmarks.solver_common import errors, rotation_deg, translation_mm

REFERENCE_MM = 0.8


def main() -> int:
    parser = argparse.ArgumentParser()
    parser.add_argument("--recording", type=Path, default=Path(__file__).parents[3] / "shared/data/recode_recording")
    parser.add_argument("--observations", type=Path)
    args = parser.parse_args()
    if args.observations is None:
        folder = tempfile.mkdtemp()
        command_line(["calibrate", str(args.recording), "--out", f"{folder}/out", "--overlays", "1"])
        args.observations = Path(folder) / "out" / "observations.npz"
    observations = ShaftObservations.load(args.observations)
    problem = Problem.from_observations(observations)
    X = torch.tensor(yaml.safe_load((args.recording / "reference.yaml").read_text())["camera_right_T_arm"]).double()
    focal = yaml.safe_load((args.recording / "stereo.yaml").read_text())["right"]["fx"]
    known = UnknownSettings(end_offset_sigma_mm=1.0)
    rows = [
        ("contours", problem.only("contours"), UnknownSettings()),
        ("contours, ends", problem.only("contours", "ends"), UnknownSettings()),
        ("contours, head points", problem.only("contours", "heads"), UnknownSettings()),
        ("contours, ends, head points", problem.only("contours", "ends", "heads"), UnknownSettings()),
    ]
    offset = solve(problem.only("contours", "ends", "heads")).nuisances["end_offset"].value[..., 0]
    shifted = replace(problem, rcm_s_end_mm=problem.rcm_s_end_mm + offset)
    rows.insert(1, ("contours, ends, offset known to 1 mm", shifted.only("contours", "ends"), known))
    print(f"{'measurements':38} | used | lines, px | head off, px | from reference | own sigma | d/3sig | verdict")
    bad = 0
    for name, part, unknowns in rows:
        solution = solve(part, SolverSettings(unknowns=unknowns))
        e = errors(solution.camera_right_T_arm, X)
        degrees, mm = float(rotation_deg(e)), float(translation_mm(e))
        sigma_deg, sigma_mm = float(solution.rotation_sigma_deg), float(solution.translation_sigma_mm)
        T = solution.camera_right_T_arm @ problem.arm_T_rcm
        q = (T[..., :3, :3] @ problem.rcm_p_head[..., None])[..., 0] + T[..., :3, 3]
        head = torch.linalg.vector_norm(q[..., :2] / q[..., 2:] - problem.head_xy[0], dim=-1) * focal
        lines = float(solution.residual_lines.nanmedian()) * focal
        ratio = max(degrees / (3.0 * sigma_deg), mm / (3.0 * np.hypot(sigma_mm, REFERENCE_MM)))
        bad += ratio > 1.0
        print(
            f"{name:38} | {int((solution.reason == 0).sum()):4d} | {lines:9.2f} | "
            f"{float(head.nanmedian()):12.2f} | {degrees:8.2f} deg {mm:6.2f} mm | "
            f"{sigma_deg:6.2f} deg {sigma_mm:6.2f} mm | "
            f"{ratio:8.2f} | {Verdict.of(solution.verdict)}",
            flush=True,
        )
    return 1 if bad else 0


if __name__ == "__main__":
    sys.exit(main())
