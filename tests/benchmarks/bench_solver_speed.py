"""Speed: warm medians, and SciPy's least_squares on the same problem in the same run.

python tests/benchmarks/bench_solver_speed.py [--quick]
"""

import argparse
import resource
import sys
import time
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import cast

sys.path.insert(0, str(Path(__file__).resolve().parents[2]))

import torch

from rmis_calib.solver import LineStatistics, Problem, SolverSettings, solve
from rmis_calib.solver.model.jacobian import columns
from rmis_calib.solver.model.packing import pack
from rmis_calib.solver.model.parameters import NuisancePriors, initial_state, make_layout
from rmis_calib.solver.model.residuals import linearise, residual_rows
from rmis_calib.solver.start.candidates import find_candidates
from tests.benchmarks.solver_common import (
    KNOWN_RADIUS,
    REALISTIC,
    Study,
    config,
    errors,
    median_seconds,
    rotation_deg,
    study,
    translation_mm,
)
from tests.benchmarks.solver_peers import AnalyticPeer, NumpyPeer, transform

END_OFFSET_MM = 0.0
"""Where SciPy starts the end's offset: its nominal place, 10 mm from the truth."""


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


def show_scipy(trial: Study, settings: SolverSettings, joint_seconds: float, quick: bool) -> None:
    """SciPy on the same problem, from the answer of `global` (solver_peers.py says how each user writes it)."""
    start = solve(trial.problem, settings, "global").camera_right_T_arm[0]
    peer = NumpyPeer(trial.problem)
    analytic = AnalyticPeer(trial.problem, settings, start, END_OFFSET_MM)
    x = peer.start(start.numpy(), END_OFFSET_MM)
    rows: list[tuple[str, Callable[[], torch.Tensor], int]] = [
        ("marginalised, weights of the start, 2-point", lambda: transform(peer.marginalised(x, 1)), 3),
        ("marginalised, weights of the estimate, 2-point", lambda: transform(peer.marginalised(x, 2)), 3),
        ("marginalised, weights of the estimate, our Jacobian", lambda: analytic.solve(2), 3),
    ]
    if not quick:
        rows.append(("latent poses, sparse 2-point", lambda: transform(peer.latent(x)), 1))
    print("SciPy least_squares, 1,728 stereo motions         ms   times joint   error deg       mm")
    for name, function, repeats in rows:
        seconds = median_seconds(function, repeats)
        print(
            f"{name:48}{1e3 * seconds:8.0f} {seconds / joint_seconds:9.1f}     {_error(function(), trial)}", flush=True
        )
    ours = solve(trial.problem, settings).camera_right_T_arm
    print(f"{'joint':48}{1e3 * joint_seconds:8.0f} {1.0:9.1f}     {_error(ours, trial)}")


def _error(estimate: torch.Tensor, trial: Study) -> str:
    e = errors(estimate, trial.truth)
    return f"{float(rotation_deg(e)[0]):10.4f} {float(translation_mm(e)[0]):8.4f}"


def show_jacobians(trial: Study, settings: SolverSettings) -> None:
    """Residuals of all 1,728 motions with their Jacobian in the 13 unknowns: analytic, torch.func and autograd."""
    problem = trial.problem
    measured = pack(problem, settings.noise)
    found = solve(problem, settings)
    X, end_offset = found.camera_right_T_arm, found.nuisances["end_offset"].value[:, 0]
    state = replace(initial_state(NuisancePriors.of(problem), X[:, :3, :3], X[:, :3, 3]), end_offset=end_offset)
    layout = make_layout(NuisancePriors.of(problem), measured, state, settings.unknowns, settings.noise)
    single = measured.gather(torch.zeros(measured.motions, dtype=torch.int64), torch.arange(measured.motions))
    each = state.take(torch.zeros(measured.motions, dtype=torch.int64))

    def analytic() -> torch.Tensor:
        rows, shaft = linearise(measured, state)
        return columns(layout, rows, shaft, measured, state)[:, :, 0]  # (k, p, n)

    def residuals(delta: torch.Tensor) -> torch.Tensor:
        return residual_rows(measured, state.moved(layout.step(delta[None])))[:, 0]

    def forward() -> torch.Tensor:
        zero = torch.zeros(layout.size, dtype=torch.float64)
        return cast(torch.Tensor, torch.func.jacfwd(residuals)(zero)).transpose(1, 2)

    def backward() -> torch.Tensor:
        """Every motion with unknowns of its own, so that one backward pass a row serves all motions."""
        delta = torch.zeros(measured.motions, layout.size, dtype=torch.float64, requires_grad=True)
        r = residual_rows(single, each.moved(layout.step(delta)))[..., 0]
        rows = [torch.autograd.grad(row.sum(), delta, retain_graph=True)[0] for row in r]
        return torch.stack(rows).transpose(1, 2)

    exact, base = analytic(), 0.0
    print("Jacobian of 1,728 stereo motions     ms   times   largest difference of the analytic one, of the column")
    for name, function in (("analytic", analytic), ("torch.func.jacfwd", forward), ("torch.autograd", backward)):
        seconds = median_seconds(function, 9)
        base = base or seconds
        scale = exact.abs().amax((0, 2), keepdim=True)
        gap = float(((function() - exact) / scale).abs().max())
        print(f"{name:28}{1e3 * seconds:10.2f} {seconds / base:7.1f}   {gap:.1e}", flush=True)


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
        print(f"1,728 stereo motions, {method:7}: {1e3 * medians[method]:8.1f} ms", flush=True)
    show_scipy(trial, settings, medians["joint"], args.quick)
    show_jacobians(trial, settings)
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
