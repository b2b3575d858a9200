"""Errors in variables: four ways to weigh noisy kinematics and to remove the bias that they cause, side by side.

    python tests/benchmarks/bench_solver_bias.py [--trials 40] [--pairs 10]

- `marginal`: the latent poses eliminated to first order at the measured ones (`joint` without its correction).
- `Gauss-Helmert`: every motion's pose estimated too, and the rows linearised there (Foerstner & Wrobel 2016, 4.8).
- `+ bootstrap`: Gauss-Helmert less its mean error on simulated data, solved in pairs of opposite noise.
- `joint`: the expected score of simulated data is subtracted (bias.py), without solving any of it.

Axis lines, two cameras. `bias` is the length of the mean translation error over its own uncertainty, sigma of one
trial over the root of the trials: about 1.7 is none.
"""

import argparse
import sys
import time
from dataclasses import replace
from pathlib import Path

sys.path.insert(0, str(Path(__file__).resolve().parents[2]))

import torch

from rmis_calib.solver import SolverSettings
from rmis_calib.solver.estimate.bias import _Draws, _turned, simulate
from rmis_calib.solver.estimate.gauss_newton import solve_system
from rmis_calib.solver.estimate.map_estimate import MapEstimate, map_estimate
from rmis_calib.solver.model.batched_linalg import batch_last, dot, rotate, rotate_back, unit
from rmis_calib.solver.model.jacobian import columns
from rmis_calib.solver.model.measurement_rows import MeasurementRows
from rmis_calib.solver.model.motion_covariance import NoiseModel, covariance, image_variance
from rmis_calib.solver.model.parameters import ParameterLayout
from rmis_calib.solver.model.residuals import linearise
from rmis_calib.solver.model.state import State
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

CELLS = [
    ("realistic", REALISTIC),
    ("c = 0.5", level(0.5)),
    ("c = 1, kinematics", (0.5, 1.0, 1.0, 0.0, 0.0, 0.0, 0.0)),
    ("c = 1", level(1.0)),
]
STEPS = 8


def gauss_helmert(measured: MeasurementRows, state: State, layout: ParameterLayout, noise: NoiseModel) -> State:
    """Transform and latent poses together: each step solves the rows linearised at the latent poses, then moves
    these."""
    shift, turn = torch.zeros_like(measured.p), torch.zeros_like(measured.p)
    D = image_variance(measured, noise)
    for _ in range(STEPS):
        latent = replace(measured, p=measured.p + shift, v=unit(_turned(measured.v, turn)))
        rows, shaft = linearise(latent, state)
        R = batch_last(state.R, 2)[..., None]
        r = rows.r - dot(rows.w, rotate(R, shift)[:, None]) - dot(rows.a, rotate(R, turn)[:, None])
        J = columns(layout, rows, shaft, latent, state)
        k, b, n = r.shape
        S = torch.empty((k, k, b, n), dtype=r.dtype)
        covariance(rows.w, rows.a, D, measured.cameras, noise, S)
        factor = torch.linalg.cholesky(S.permute(2, 3, 0, 1))
        white = torch.cholesky_solve(torch.cat((J, r[:, None]), 1).permute(2, 3, 0, 1), factor)  # (b, n, k, p + 1)
        both = J.permute(2, 3, 1, 0) @ white
        deviation, weight = layout.prior(state)
        H = both[..., :-1].sum(1) + torch.diag_embed(weight)
        g = both[..., -1].sum(1) + weight * deviation
        step, _ = solve_system(H, g)
        lagrange = (white[..., -1] + (white[..., :-1] @ step[:, None, :, None])[..., 0]).permute(2, 0, 1)
        shift = -noise.kinematics_mm[:, None] * rotate_back(R, (rows.w * lagrange).sum(1))
        turn = -noise.kinematics_rad[:, None] * rotate_back(R, (rows.a * lagrange).sum(1))
        state = state.moved(layout.step(step))
    return state


def bootstrapped(fit: MapEstimate, state: State, pairs: int, seed: int) -> State:
    """The state less the mean error of Gauss-Helmert on data simulated at it, in pairs of opposite noise."""
    generator = torch.Generator().manual_seed(seed)
    twice = torch.arange(fit.model.measured.trials).repeat(2)
    twofold = state.take(twice), fit.model.layout.take(twice), fit.model.noise.take(twice)
    total = torch.zeros(fit.model.measured.trials, 6, dtype=state.t.dtype)
    for _ in range(pairs):
        simulated = simulate(
            fit.model.measured.take_trials(twice), twofold[0], twofold[2], _Draws(fit.model.measured, generator)
        )
        again = gauss_helmert(simulated, *twofold)
        total += errors(pose(again), pose(twofold[0])).unflatten(0, (2, -1)).mean(0)
    return state.moved({"rotation": -total[:, :3] / pairs, "translation": -total[:, 3:] / pairs})


def pose(state: State) -> torch.Tensor:
    T = torch.eye(4, dtype=state.t.dtype).repeat(state.t.shape[0], 1, 1)
    T[:, :3, :3], T[:, :3, 3] = state.R, state.t
    return T


def main() -> int:
    parser = argparse.ArgumentParser()
    parser.add_argument("--trials", type=int, default=40)
    parser.add_argument("--pairs", type=int, default=10)
    args = parser.parse_args()
    settings = SolverSettings(unknowns=KNOWN_RADIUS)
    print(
        f"{args.trials} trials of 1,728 motions; rmse over the Cramer-Rao bound, deg and mm; bias; seconds a trial",
        flush=True,
    )
    for name, noise in CELLS:
        trial = study(config(noise, args.trials, 1), ("axis",))
        problem = trial.problem.flatten_batch()
        start = time.perf_counter()
        fit = map_estimate(problem, replace(settings, bias_correction=False))
        times = [time.perf_counter() - start]
        helmert = gauss_helmert(fit.model.measured, fit.state, fit.model.layout, fit.model.noise)
        times.append(time.perf_counter() - start)
        corrected = bootstrapped(fit, helmert, args.pairs, 7)
        times.append(time.perf_counter() - start)
        start = time.perf_counter()
        joint = map_estimate(problem, settings)
        times.append(time.perf_counter() - start)
        for label, state, seconds in zip(
            ("marginal", "Gauss-Helmert", "+ bootstrap", "joint"),
            (fit.state, helmert, corrected, joint.state),
            times,
            strict=True,
        ):
            e = errors(pose(state), trial.truth)
            degrees, mm = rms(rotation_deg(e)) / trial.bound_deg, rms(translation_mm(e)) / trial.bound_mm
            spread = e[:, 3:].std(0).norm() / len(e) ** 0.5
            bias = float(e[:, 3:].mean(0).norm() / spread)
            print(
                f"{name:18} {label:14} | {degrees:5.2f} {mm:5.2f} | {bias:5.1f} | {seconds / args.trials:6.3f}",
                flush=True,
            )
    return 0


if __name__ == "__main__":
    sys.exit(main())
