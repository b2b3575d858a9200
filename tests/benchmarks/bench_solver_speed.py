"""Speed: warm medians, and SciPy's least_squares on the same problem in the same run.

python tests/benchmarks/bench_solver_speed.py [--quick]
"""

import argparse
import resource
import sys
import time
from dataclasses import fields, replace
from pathlib import Path

sys.path.insert(0, str(Path(__file__).resolve().parents[2]))

import numpy as np
import torch
from scipy.optimize import least_squares
from scipy.spatial.transform import Rotation

from rmis_calib.solver import LineStatistics, Problem, SolverSettings, solve
from rmis_calib.solver.initialise import find_candidates
from tests.benchmarks.solver_common import (
    KNOWN_RADIUS,
    REALISTIC,
    config,
    errors,
    median_seconds,
    rotation_deg,
    study,
    translation_mm,
)


def scipy_joint(problem: Problem, start: np.ndarray, end_offset: float) -> np.ndarray:
    """The same weighted joint estimate by SciPy: a plain user's residual function in NumPy, with latent poses
    eliminated by whitening with the noise at the start.

    Twelve shared unknowns and the end offset; residuals of both contours, ends, both cameras; Jacobian by finite
    differences, as by default.
    """
    P = {
        f.name: getattr(problem, f.name)[0].numpy()
        for f in fields(problem)
        if isinstance(getattr(problem, f.name), torch.Tensor) and getattr(problem, f.name).ndim > 1
    }
    radius = float(problem.radius_mm[0])
    noise = {f.name: float(getattr(problem.noise, f.name)[0]) for f in fields(problem.noise)}
    Z0 = P["camera_T_camera_right"][1]

    def rows(x, A, v):
        R, t = Rotation.from_rotvec(x[:3]).as_matrix(), x[3:6]
        Z = np.eye(4)
        Z[:3, :3], Z[:3, 3] = Rotation.from_rotvec(x[6:9]).as_matrix() @ Z0[:3, :3], Z0[:3, 3] + x[9:12]
        p0, d0 = A[:, :3, 3] @ R.T + t, np.einsum("nij,nj->ni", A[:, :3, :3], v) @ R.T
        out = []
        for c, T in enumerate((np.eye(4), Z)):
            p, d = p0 @ T[:3, :3].T + T[:3, 3], d0 @ T[:3, :3].T
            M = np.cross(p, d)
            D = np.linalg.norm(M, axis=1)
            m = M / D[:, None]
            u = np.cross(d, m)
            sine = radius / D
            for edge, sign in enumerate((1.0, -1.0)):
                n = np.sqrt(1.0 - sine**2)[:, None] * m + sign * sine[:, None] * u
                scale = np.hypot(n[:, 0], n[:, 1])
                for point in range(2):
                    xy = P["contour_xy"][c, :, edge, point]
                    out.append((n[:, 0] * xy[:, 0] + n[:, 1] * xy[:, 1] + n[:, 2]) / scale)
            q = p + (P["rcm_s_end_mm"] + x[12])[:, None] * d
            along = np.stack((-m[:, 1], m[:, 0]), 1) / np.hypot(m[:, 0], m[:, 1])[:, None]
            out.append(((P["end_xy"][c] - q[:, :2] / q[:, 2:]) * along).sum(1))
        return np.nan_to_num(np.stack(out, 1))

    A, v = P["arm_T_rcm"], P["rcm_v_axis"]
    x0 = np.concatenate((Rotation.from_matrix(start[:3, :3]).as_rotvec(), start[:3, 3], np.zeros(6), [end_offset]))
    base = rows(x0, A, v)
    covariance = np.tile(noise["image"] ** 2 * np.eye(10), (len(A), 1, 1))
    for axis in range(6):
        step = np.zeros(6)
        step[axis] = 1e-5 if axis < 3 else 1e-4
        E = np.eye(4)
        E[:3, :3], E[:3, 3] = Rotation.from_rotvec(step[:3]).as_matrix(), step[3:]
        J = (rows(x0, A @ E, v) - base) / step[axis] * (noise["kinematics_rad"] if axis < 3 else noise["kinematics_mm"])
        covariance += J[:, :, None] * J[:, None]
    whiten = np.linalg.inv(np.linalg.cholesky(covariance))
    prior = np.concatenate((np.full(3, noise["stereo_rad"]), np.full(3, noise["stereo_mm"])))

    def residuals(x):
        return np.concatenate((np.einsum("nij,nj->ni", whiten, rows(x, A, v)).ravel(), x[6:12] / prior))

    x = least_squares(residuals, x0, method="trf", x_scale="jac").x
    out = np.eye(4)
    out[:3, :3], out[:3, 3] = Rotation.from_rotvec(x[:3]).as_matrix(), x[3:6]
    return out


def tiled(problem: Problem, n: int) -> Problem:
    """One trial with n motions: those of a 1,728 grid repeated with fresh noise in the kinematics, image noise kept."""
    index = torch.arange(n) % problem.n_motions
    big = problem.select_motions(index)
    generator = torch.Generator().manual_seed(0)
    shifted = big.arm_T_rcm.clone()
    shifted[..., :3, 3] += 0.05 * torch.randn(*shifted.shape[:-2], 3, generator=generator, dtype=shifted.dtype)
    return replace(big, arm_T_rcm=shifted)


def peak_gb() -> float:
    return resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1e6


def main() -> int:
    parser = argparse.ArgumentParser()
    parser.add_argument("--quick", action="store_true")
    args = parser.parse_args()
    settings = SolverSettings(unknowns=KNOWN_RADIUS)
    print(f"{torch.get_num_threads()} threads, torch {torch.__version__}")
    trial = study(config(REALISTIC, 1, 0), ("axis", "contours", "ends"))
    medians = {}
    for method in ("paper", "global", "joint"):
        medians[method] = median_seconds(lambda method=method: solve(trial.problem, settings, method), 15)
        print(f"1,728 stereo motions, {method:7}: {1e3 * medians[method]:8.1f} ms")
    start = solve(trial.problem, settings, "global").camera_right_T_arm[0].numpy()
    seconds = median_seconds(lambda: scipy_joint(trial.problem, start, -18.0), 3)
    e = errors(torch.as_tensor(scipy_joint(trial.problem, start, -18.0))[None], trial.truth)
    ours = errors(solve(trial.problem, settings).camera_right_T_arm, trial.truth)
    print(f"1,728 stereo motions, SciPy  : {1e3 * seconds:8.1f} ms, {seconds / medians['joint']:.1f} times joint")
    for name, error in (("SciPy", e), ("joint", ours)):
        print(f"    error of {name}: {float(rotation_deg(error)[0]):.4f} deg, {float(translation_mm(error)[0]):.4f} mm")
    for n in (1_000, 10_000, 100_000) + (() if args.quick else (1_000_000,)):
        big = tiled(trial.problem, n)
        begin = time.perf_counter()
        statistics = LineStatistics.from_problem(big)
        find_candidates(statistics, settings.grid, settings.minima).best()
        middle = time.perf_counter()
        solution = solve(big, settings)
        end = time.perf_counter()
        print(
            f"{n:9,} motions: global {middle - begin:6.2f} s ({1e6 * (middle - begin) / n:6.2f} us each), "
            f"joint {end - middle:6.2f} s ({1e6 * (end - middle) / n:6.2f} us), "
            f"peak {peak_gb():.2f} GB, status {int(solution.status[0])}",
            flush=True,
        )
    if not args.quick:
        many = study(config(REALISTIC, 1000, 5), ("contours", "ends"))
        for method, kinds in (("global", ("axis",)), ("joint", ("contours", "ends"))):
            problem = many.problem if method == "joint" else study(config(REALISTIC, 1000, 5), kinds).problem
            begin = time.perf_counter()
            solve(problem, settings, method)
            print(f"1,000 trials of 1,728 stereo motions, {method}: {time.perf_counter() - begin:.1f} s", flush=True)
    return 0


if __name__ == "__main__":
    sys.exit(main())
