"""Advice on the next motion: what is left of the uncertainty after advised motions, random ones, and more of the same.

    python tests/benchmarks/bench_solver_advice.py [--trials 20] [--draws 20]

Both arms' poses, the pictures and their noise come from the independent simulation at chosen joint readings. Candidates
are random readings within 10 deg and 20 mm of the middle; those of which the camera sees nothing are left out, for all
three ways alike. Advice is asked for after every motion, from a solve of what one trial measured up to then; other
trials then measure the same motions with their own noise.
"""

import argparse
import sys
from dataclasses import dataclass, replace
from pathlib import Path

sys.path.insert(0, str(Path(__file__).resolve().parents[2]))

import numpy as np
import torch
from torch import Tensor

from data_synth.lines import simulate_lines
from data_synth.scene import build_scene
from rmis_calib.solver import Problem, Solution, SolverSettings, solve
from rmis_calib.solver.assess.next_motion import Advice, advise, measured_alike
from rmis_calib.solver.assess.observability import working_point_jacobian
from rmis_calib.solver.settings import AdviceSettings
from tests.benchmarks.solver_common import REALISTIC, config, errors

SETTINGS = SolverSettings(robust="off", advice=AdviceSettings(motions=1))
REACH = np.array([np.deg2rad(10.0), np.deg2rad(10.0), 20.0] * 2)
STEPS = 5
VIEW = (-0.76, -0.57, 0.76, 0.57)
"""Of the simulated cameras (0.8 x 0.6), less 5 per cent on every side, as the pipeline takes it."""


@dataclass(frozen=True)
class Weak:
    """A recording that leaves a direction weak.

    Attributes:
        kinds: of measurement.
        cameras: how many.
        unit: (n, 6) its readings, in units of REACH from the middle.
    """

    name: str
    kinds: tuple[str, ...]
    cameras: int
    unit: np.ndarray


def weak_recordings() -> tuple[Weak, ...]:
    """One axis alone; a laparoscope that stands still, without a radius; small motions."""
    yaw, small, still = (np.zeros((n, 6)) for n in (15, 20, 20))
    yaw[:, 3] = np.linspace(-1.0, 1.0, 15)
    generator = np.random.default_rng(4)
    small += 0.12 * generator.uniform(-1.0, 1.0, small.shape)
    still[:, 3:] = 0.5 * generator.uniform(-1.0, 1.0, (20, 3))
    return (
        Weak("one axis alone (instrument yaw), contours and ends, mono", ("contours", "ends"), 1, yaw),
        Weak("laparoscope still and no radius, axis lines, stereo", ("axis",), 2, still),
        Weak("motions of 2.4 deg and 4.8 mm, contours and ends, mono", ("contours", "ends"), 1, small),
    )


def measure(weak: Weak, unit: np.ndarray, trials: int, seed: int = 0) -> tuple[Problem, Tensor]:
    """What the cameras measure at these readings, and the true transforms."""
    settings = config(REALISTIC, trials, seed)
    scene = build_scene(settings.scene)
    readings = np.concatenate((scene.laparoscope_home, scene.instrument_home)) + unit * REACH
    data = simulate_lines(settings, (readings[:, :3], readings[:, 3:]))
    problem = Problem.from_arrays(data).only(*weak.kinds).cameras(weak.cameras)
    return problem, torch.as_tensor(data["truth"]["camera_right_T_arm"])


def next_motion(
    weak: Weak, unit: np.ndarray, candidates: np.ndarray, settings: SolverSettings = SETTINGS
) -> tuple[Advice, Solution]:
    """Advice among candidate readings after a recording, and the solution of that recording."""
    problem, _ = measure(weak, unit, 1)
    solution = solve(problem, settings)
    assert solution.posterior is not None
    at, _ = measure(weak, candidates, 1)
    base = measured_alike(problem, len(candidates))
    at = replace(base, **{key: getattr(at, key) for key in ("arm_T_rcm", "rcm_v_axis", "rcm_s_end_mm", "rcm_p_head")})
    view = torch.tensor([VIEW] * weak.cameras, dtype=torch.float64)
    point = solution.observability.working_point_mm[0]
    return advise(at, solution.posterior, point, view, settings), solution


def left(weak: Weak, unit: np.ndarray, trials: int, settings: SolverSettings = SETTINGS) -> tuple[float, float]:
    """After a recording: 1 sigma of the weakest direction as the solver reports it, and the rms error that it really
    made over lever * rotation and displacement of the working point; mm."""
    problem, truth = measure(weak, unit, trials, seed=1)
    solution = solve(problem, settings)
    t = solution.camera_right_T_arm[:, :3, 3]
    A = working_point_jacobian(t, solution.observability.working_point_mm, settings.verdict.lever_mm)
    error = (A @ errors(solution.camera_right_T_arm, truth)[..., None])[..., 0]
    return float(solution.observability.sigma_mm[:, 0].median()), float(error.square().sum(-1).median().sqrt())


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--trials", type=int, default=20)
    parser.add_argument("--draws", type=int, default=20)
    arguments = parser.parse_args()
    for weak in weak_recordings():
        print(f"\n{weak.name}: 1 sigma of the weakest direction, mm (median error, mm)")
        print(
            f"{'motions added':>14} {'predicted':>10} {'advised':>16} {'random, median':>16} {'more of the same':>17}"
        )
        study(weak, arguments.trials, arguments.draws)


def study(weak: Weak, trials: int, draws: int) -> None:
    """Prints one line a motion added."""
    generator = np.random.default_rng(9)
    candidates = generator.uniform(-1.0, 1.0, (400, 6))
    seen = next_motion(weak, weak.unit, candidates)[0].visible.numpy()
    candidates = candidates[seen]
    unit = weak.unit
    sigma, error = left(weak, unit, trials)
    print(f"{0:>14} {'':>10} {sigma:8.3f} ({error:5.2f})")
    for step in range(1, STEPS + 1):
        advice, _ = next_motion(weak, unit, candidates)
        unit = np.concatenate((unit, candidates[advice.chosen.numpy()]))
        random = [
            left(weak, np.concatenate((weak.unit, generator.permutation(candidates)[:step])), trials)
            for _ in range(draws)
        ]
        same = left(weak, np.concatenate((weak.unit, generator.permutation(weak.unit)[:step])), trials)
        cells = (left(weak, unit, trials), tuple(np.median(random, axis=0)), same)
        text = " ".join(f"{s:8.3f} ({e:5.2f})" for s, e in cells)
        print(f"{step:>14} {float(advice.weakest_mm[1]):10.3f} {text}")


if __name__ == "__main__":
    main()
