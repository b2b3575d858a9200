"""A clock that jumps is told with its motion; one that does not is left alone."""

import sys
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch

sys.path.insert(0, str(Path(__file__).resolve().parents[3]))

from rmis_calib.pipeline.answer.records.consistency import consistency_of
from rmis_calib.pipeline.answer.records.tests_in_words import told_tests
from rmis_calib.pipeline.answer.result import judge
from rmis_calib.solver import SolverSettings, solve
from rmis_calib.solver.observability import Verdict
from rmis_calib.solver.settings import UnknownSettings
from rmis_calib.solver.test_list import CLOCK, TIME_STEP
from tests.benchmarks.bench_solver_nuisance import record

SETTINGS = SolverSettings(
    bias_correction=False,
    unknowns=UnknownSettings(joint_offsets="never", stereo=False, radius_sigma_relative=0.0, clock_rate="never"),
)
N = 192


def solved(trials: int, seed: int, clock_s: float | np.ndarray = 0.0):
    """Recordings of 19 s at 10 Hz, the noise new in each."""
    recorded, _ = record(trials, N, seed, clock_s=clock_s)

    def kinematics(joints, clock):
        return recorded.kinematics(joints, clock).only("contours", "ends")

    zero = torch.zeros(trials, 6, dtype=torch.float64), torch.zeros(trials, 2, dtype=torch.float64)
    return solve(kinematics(*zero), SETTINGS, kinematics=kinematics)


def test_right_clocks_do_not_jump() -> None:
    """60 recordings; the largest of 31 borders passes 4.5 sigmas in fewer than one of 1,000."""
    found = solved(60, 5)
    assert found.clock_jump is not None
    assert found.tests is not None and not bool(found.tests.fails(CLOCK, TIME_STEP).any())
    # Of right models the largest of 31 correlated standard normals is near 2.3.
    assert 1.2 < float(found.clock_jump.sigmas.median()) < 3.0


@pytest.mark.parametrize(("at", "jump_s"), [(120, 0.04), (60, -0.05), (150, 0.2)])
def test_a_jump_is_told_with_its_motion_and_takes_ok_away(at, jump_s) -> None:
    found = solved(1, 6, np.where(np.arange(N) >= at, jump_s, 0.0))
    assert found.clock_jump is not None and found.tests is not None and bool(found.tests.fails(CLOCK, TIME_STEP))
    assert abs(int(found.clock_jump.at) - at) <= 6  # blocks of 6
    assert float(found.clock_jump.jump_s) == pytest.approx(jump_s, rel=0.4)
    assert int(found.verdict) != Verdict.TRUSTWORTHY.code
    status, message = judge(found, told_tests(found))
    assert (
        status != "ok" and f"({float(found.clock_jump.jump_s):+.3f} s)" in message and "jumps before motion" in message
    )
    consistency = consistency_of(found)
    assert consistency is not None and consistency.clock_jump is not None
    assert consistency.clock_jump.before_motion == int(found.clock_jump.at)


def test_without_a_clock_among_the_unknowns_nothing_is_said() -> None:
    recorded, _ = record(1, N, 7)
    zero = torch.zeros(1, 6, dtype=torch.float64), torch.zeros(1, 2, dtype=torch.float64)
    problem = replace(recorded.kinematics(*zero).only("contours", "ends"), clock_derivative=None)
    assert solve(problem, SETTINGS).clock_jump is None
