"""Joint offsets and the clock, with the kinematics as a function."""

import sys
from dataclasses import replace
from pathlib import Path

import pytest
import torch

sys.path.insert(0, str(Path(__file__).resolve().parents[2]))

from rmis_calib.solver import SolverSettings, solve
from rmis_calib.solver.estimate.relinearise import scan_clock
from rmis_calib.solver.settings import NoiseSettings, UnknownSettings
from tests.benchmarks.bench_solver_nuisance import record

KNOWN = UnknownSettings(radius_sigma_relative=0.0, stereo=False, joint_offsets="never")
ZERO = torch.zeros(1, 6, dtype=torch.float64)
STILL = torch.zeros(1, 2, dtype=torch.float64)


def kinematics_of(recorded):
    return lambda joints, clock: recorded.kinematics(joints, clock).only("contours", "ends")


@pytest.mark.parametrize("clock_s", [0.04, -2.4])
def test_clock_offset_is_found(clock_s):
    recorded, truth = record(1, 120, 3, clock_s=clock_s)
    kinematics = kinematics_of(recorded)
    offsets = torch.arange(-3.0, 3.01, 0.1, dtype=torch.float64)
    candidates = torch.stack((offsets, torch.zeros_like(offsets)), dim=-1)
    found, _ = scan_clock(recorded.kinematics, 6, candidates)
    assert float(found[0]) == pytest.approx(clock_s, abs=0.11)
    solution = solve(
        kinematics(ZERO, STILL + found), SolverSettings(unknowns=replace(KNOWN, clock=True)), kinematics=kinematics
    )
    clock = solution.nuisances["clock"]
    assert float(clock.value) == pytest.approx(clock_s, abs=4.0 * float(clock.sigma))
    assert float(clock.sigma) < 0.005
    gap = torch.linalg.vector_norm(solution.camera_right_T_arm[0, :3, 3] - truth[0, :3, 3])
    assert float(gap) < 3.5 * float(solution.translation_sigma_mm)


@pytest.mark.parametrize("rate", [0.0, 0.002, -0.01])
def test_the_rate_of_the_clock_is_freed_where_the_data_ask_for_it(rate):
    """200 frames at 10 Hz: 1 % is 0.1 s at either end."""
    recorded, truth = record(1, 200, 3, clock_s=0.03, rate=rate)
    kinematics = kinematics_of(recorded)
    unknowns = replace(KNOWN, clock=True)
    solution = solve(kinematics(ZERO, STILL), SolverSettings(unknowns=unknowns), kinematics=kinematics)
    assert ("clock_rate" in solution.nuisances) == bool(rate)
    gap = torch.linalg.vector_norm(solution.camera_right_T_arm[0, :3, 3] - truth[0, :3, 3])
    assert float(gap) < 3.5 * float(solution.translation_sigma_mm)
    if not rate:
        assert float(solution.evidence["clock_rate"]) > 0.005
        return
    found = solution.nuisances["clock_rate"]
    assert float(found.value) == pytest.approx(rate, abs=4.0 * float(found.sigma))
    assert float(found.sigma) < 5e-4
    never = replace(unknowns, clock_rate="never")
    ignored = solve(kinematics(ZERO, STILL), SolverSettings(unknowns=never), kinematics=kinematics)
    assert "clock_rate" not in ignored.nuisances and "clock_rate" not in ignored.evidence


def test_joint_offsets_are_estimated_or_held():
    offset = torch.tensor([0.0087, -0.0087, 1.0, -0.0087, 0.0087, -1.0], dtype=torch.float64)
    recorded, truth = record(1, 200, 4, offset=offset.numpy())
    kinematics = kinematics_of(recorded)
    start = kinematics(ZERO, STILL)
    ignored = solve(start, SolverSettings(unknowns=KNOWN))
    solution = solve(start, SolverSettings(unknowns=replace(KNOWN, joint_offsets="always")), kinematics=kinematics)
    estimate = solution.nuisances["joint_offset"]
    assert bool(((estimate.value[0] - offset).abs() < 4.0 * estimate.sigma[0]).all())
    seen = ~estimate.held[0]
    assert bool(seen.any()) and not bool(seen.all())  # insertion of the laparoscope is not told from the transform
    gap = torch.linalg.vector_norm((solution.camera_right_T_arm - truth)[0, :3, 3])
    assert float(gap) < 3.5 * float(solution.translation_sigma_mm)
    assert float(gap) < float(torch.linalg.vector_norm((ignored.camera_right_T_arm - truth)[0, :3, 3]))


def test_noise_is_what_it_is_after_the_kinematics_were_evaluated_anew():
    """The shaft ends 10 mm before its nominal place: an estimate that forgot this would see noise of millimetres."""
    offset = torch.tensor([0.0087, -0.0087, 0.0, -0.0087, 0.0087, 0.0], dtype=torch.float64)
    recorded, _ = record(1, 200, 4, offset=offset.numpy())
    settings = SolverSettings(
        unknowns=replace(KNOWN, joint_offsets="always"), noise=NoiseSettings(estimate="always", kinematics_mm=1.0)
    )
    kinematics = kinematics_of(recorded)
    noise = solve(kinematics(ZERO, STILL), settings, kinematics=kinematics).noise
    # As simulated. The least seen of them, of 200 motions, is known to a tenth.
    assert float(noise["kinematics_mm"]) == pytest.approx(0.3, rel=0.25)
    assert float(torch.rad2deg(noise["kinematics_rad"])) == pytest.approx(0.1, rel=0.25)
    assert float(noise["line"]) == pytest.approx(1.0, rel=0.25)
