"""Outliers: 30 % gross wrong lines and 10 % lines of a second instrument, against the same trials without them.

    python tests/benchmarks/bench_solver_outliers.py [--trials 50]

Wrong lines fall into one camera at a time; the second instrument passes through another RCM and is seen by both
cameras consistently.
"""

import argparse
import sys
from dataclasses import replace
from pathlib import Path

sys.path.insert(0, str(Path(__file__).resolve().parents[2]))

import torch

from rmis_calib.geometry.lines import contour_planes
from rmis_calib.geometry.rotations import rotvec_to_matrix
from rmis_calib.solver import Problem, SolverSettings, SolveStatus, solve
from tests.benchmarks.solver_common import (
    KNOWN_RADIUS,
    REALISTIC,
    Study,
    config,
    errors,
    rms,
    rotation_deg,
    study,
    translation_mm,
)

GROSS, SECOND = 0.3, 0.1


def contaminate(trial: Study, gross: float, second: float, seed: int) -> Problem:
    """Some lines of single cameras replaced by random ones, some motions by another instrument's shaft."""
    problem, X = trial.problem, trial.truth
    generator = torch.Generator().manual_seed(seed)
    b, c, n = problem.valid.shape
    wrong = torch.rand(b, c, n, generator=generator) < gross
    other = (torch.rand(b, 1, n, generator=generator) < second).expand(b, c, n)
    points = (torch.rand(b, c, n, 2, 2, generator=generator, dtype=torch.float64) - 0.5) * torch.tensor(
        [1.2, 0.9], dtype=torch.float64
    )
    width = 0.03 + 0.05 * torch.rand(b, c, n, 1, generator=generator, dtype=torch.float64)
    across = points[..., 1, :] - points[..., 0, :]
    across = (
        torch.stack((across[..., 1], -across[..., 0]), -1)
        / torch.linalg.vector_norm(across, dim=-1, keepdim=True)
        * width
    )
    random = {
        "axis_xy": points,
        "contour_xy": torch.stack((points + across[..., None, :], points - across[..., None, :]), -3),
        "end_xy": points[..., 1, :],
    }
    tilt = rotvec_to_matrix(torch.tensor([0.0, 0.2, 2.2], dtype=torch.float64))
    foreign = _seen(problem, X, tilt, torch.tensor([-170.0, 30.0, 5.0], dtype=torch.float64))
    changed = {}
    for name, value in random.items():
        kept = getattr(problem, name)
        shape = (b, c, n, *(1,) * (kept.ndim - 3))
        value = torch.where(other.reshape(shape), foreign[name], torch.where(wrong.reshape(shape), value, kept))
        changed[name] = torch.where(torch.isfinite(kept), value, kept)
    return replace(problem, **changed)


def _seen(problem: Problem, X, tilt, shift) -> dict:
    """What the cameras see of a shaft that moves like the first one but turned and shifted in the right camera's
    frame."""
    right = X[:, None] @ problem.arm_T_rcm
    p = right[..., :3, 3] @ tilt.T + shift
    v = (right[..., :3, :3] @ problem.rcm_v_axis[..., None])[..., 0] @ tilt.T
    out = {"axis_xy": [], "contour_xy": [], "end_xy": []}
    for c in range(problem.n_cameras):
        Z = problem.camera_T_camera_right[:, c, None]
        q, d = (Z[..., :3, :3] @ p[..., None])[..., 0] + Z[..., :3, 3], (Z[..., :3, :3] @ v[..., None])[..., 0]
        along = torch.stack([q + s * d for s in (60.0, 110.0)], dim=-2)  # (b, n, 2, 3)
        out["axis_xy"].append(along[..., :2] / along[..., 2:].clamp_min(1.0))
        planes = contour_planes(q, d, problem.radius_mm[:, None].expand(q.shape[:-1]))
        touch = (
            along[..., None, :, :]
            - (along[..., None, :, :] * planes[..., None, :]).sum(-1, keepdim=True) * planes[..., None, :]
        )
        out["contour_xy"].append(touch[..., :2] / touch[..., 2:].clamp_min(1.0))
        out["end_xy"].append(along[..., 1, :2] / along[..., 1, 2:].clamp_min(1.0))
    return {name: torch.stack(value, dim=1) for name, value in out.items()}


def main() -> int:
    parser = argparse.ArgumentParser()
    parser.add_argument("--trials", type=int, default=50)
    args = parser.parse_args()
    settings = SolverSettings(unknowns=KNOWN_RADIUS)
    bad = 0
    print(
        "motions  laparoscope  measurements     cams |  clean deg / mm  | outliers, deg / mm | worst deg | ratio | lost"
    )
    for laparoscope, instrument in ((3, 4), (2, 3), (1, 5)):
        for kinds in (("axis",), ("contours", "ends")):
            for cameras in (2, 1):
                if laparoscope == 1 and kinds == ("axis",):
                    continue  # not observable (or weak) without outliers
                trial = study(config(REALISTIC, args.trials, 3, laparoscope, instrument), kinds, cameras)
                dirty = contaminate(trial, GROSS, SECOND, 5)
                clean = errors(solve(trial.problem, settings).camera_right_T_arm, trial.truth)
                solution = solve(dirty, settings)
                accepted = (solution.status == SolveStatus.CONVERGED) & (solution.verdict < 2)  # not unobservable
                e = errors(solution.camera_right_T_arm, trial.truth)[accepted]
                ratio = max(
                    rms(rotation_deg(e)) / rms(rotation_deg(clean)), rms(translation_mm(e)) / rms(translation_mm(clean))
                )
                refused = int((~accepted).sum())
                bad += ratio > 1.5 or refused > 0
                print(
                    f"{trial.problem.n_motions:7d}  {'moves' if laparoscope > 1 else 'static':11}  "
                    f"{'+'.join(kinds):16} {cameras:4d} | "
                    f"{rms(rotation_deg(clean)):.4f} / {rms(translation_mm(clean)):.4f} | "
                    f"{rms(rotation_deg(e)):8.4f} / {rms(translation_mm(e)):.4f}     | "
                    f"{float(rotation_deg(e).max()):8.3f}  | {ratio:.2f}  | {refused}",
                    flush=True,
                )
    return 1 if bad else 0


if __name__ == "__main__":
    sys.exit(main())
