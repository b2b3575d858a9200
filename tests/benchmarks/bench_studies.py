"""Monte-Carlo trials in one batch against the same trials one by one through the same solver.

    python tests/benchmarks/bench_studies.py [--trials 200]

Kinematics 0.3 mm and 0.1 deg, 0.5 px, stereo; milliseconds of one core's processor time a trial, so that other work on
the machine does not count. The answers are the same. Below: what `paper` spends them on with most motions.
"""

import argparse
import sys
import time
from dataclasses import replace
from pathlib import Path

sys.path.insert(0, str(Path(__file__).resolve().parents[2]))

import torch

from rmis_calib.solver import Problem, Solution, api
from rmis_calib.solver.api import GROUP_MOTIONS
from rmis_calib.solver.start.line_statistics import LineStatistics
from rmis_calib.solver.start.paper import average, empirical_covariance, influence, solve_paper, votes
from rmis_calib.studies.builtin import SETTINGS
from rmis_calib.studies.registry import find_method
from rmis_calib.studies.settings import SetupSettings
from rmis_calib.studies.simulation import Condition, make_setup, simulate

LEVELS = (("kinematics_noise_mm", 0.3), ("kinematics_noise_deg", 0.1))
METHODS = ("paper", "global", "joint-axis", "joint-contours")
GRIDS = ((1, 3), (2, 2), (2, 3), (3, 4))
ONE_BY_ONE = 20
"""Trials that are timed one by one; all others take as long."""
REPEATS = 5


def main() -> None:
    parser = argparse.ArgumentParser()
    parser.add_argument("--trials", type=int, default=200)
    trials = parser.parse_args().trials
    torch.set_num_threads(1)
    setup = make_setup(SetupSettings())
    print(f"torch {torch.__version__}; {trials} trials, ms a trial")
    print(f"{'method':15} {'motions':>7} {'batch':>8} {'one by one':>11} {'ratio':>6}   largest difference")
    for lap, tool in GRIDS:
        condition = replace(Condition.on_grid("", 0.0, lap, tool), levels=LEVELS)
        problem = simulate(setup, condition, None, trials, 0).problem.with_exact_setup()
        for name in METHODS:
            method = find_method(name)
            seen = problem.only(*method.measurements)
            method.solve(seen.take_trials(slice(0, 2)))  # warm
            start = time.process_time()
            together = _transforms(method.solve(seen))
            batch_ms = (time.process_time() - start) / trials * 1e3
            start = time.process_time()
            alone = [_transforms(method.solve(seen.take_trials(slice(i, i + 1)))) for i in range(ONE_BY_ONE)]
            each_ms = (time.process_time() - start) / ONE_BY_ONE * 1e3
            gap = float((torch.cat(alone) - together[:ONE_BY_ONE]).abs().max())
            print(
                f"{name:15} {problem.n_motions:7d} {batch_ms:8.2f} {each_ms:11.1f} "
                f"{each_ms / batch_ms:6.1f}   {gap:.1e}",
                flush=True,
            )
    _print_stages(problem.only("axis").take_trials(slice(0, GROUP_MOTIONS // problem.n_motions)))


def _print_stages(problem: Problem) -> None:
    """Times of the parts of `paper` on a batch that the solver works on at once."""
    with torch.inference_mode():
        statistics = LineStatistics.from_problem(problem)
        R, t = solve_paper(statistics)
        weight = votes(statistics.count)
        mean_R, mean_t = average(R, t, weight)
        covariance = empirical_covariance(influence(problem, R, t, weight))
        stages = {
            "check of the data": lambda: api._check(problem),
            "Gram matrices": lambda: LineStatistics.from_problem(problem),
            "rotations and translations": lambda: solve_paper(statistics),
            "covariance": lambda: empirical_covariance(influence(problem, R, t, weight)),
            "status, residuals, what is seen": lambda: api.two_step_solution(
                problem, mean_R, mean_t, covariance, SETTINGS, "paper"
            ),
        }
        print(f"\npaper, {problem.n_motions} motions, {problem.n_trials} trials at once, ms a trial")
        for name, stage in stages.items():
            stage()
            start = time.process_time()
            for _ in range(REPEATS):
                stage()
            print(f"{name:32} {(time.process_time() - start) / REPEATS / problem.n_trials * 1e3:6.2f}", flush=True)


def _transforms(found: Solution | torch.Tensor) -> torch.Tensor:
    return found.camera_right_T_arm if isinstance(found, Solution) else found


if __name__ == "__main__":
    main()
