"""`paper`, `global` and `joint` on lines from the independent simulation."""

from dataclasses import replace

import pytest
import torch

from rmis_calib.geometry.rotations import rotation_angle
from rmis_calib.solver import LineStatistics, Problem, SolverSettings, SolveStatus, Verdict, solve
from rmis_calib.solver.settings import NoiseSettings, UnknownSettings
from rmis_calib.solver.solution import concatenate
from rmis_calib.solver.start.paper import linear_rotation, solve_paper

EXACT = UnknownSettings(radius_sigma_relative=0.0)


def error(solution, truth):
    X = torch.as_tensor(truth["camera_right_T_arm"])
    T = solution.camera_right_T_arm
    return torch.rad2deg(rotation_angle(T[..., :3, :3] @ X[..., :3, :3].mT)), torch.linalg.vector_norm(
        T[..., :3, 3] - X[..., :3, 3], dim=-1
    )


@pytest.mark.parametrize("method", ["paper", "global", "joint"])
@pytest.mark.parametrize("random_hand_eye", [False, True])
def test_exact_lines_give_the_exact_transform(simulate, method, random_hand_eye):
    problem, truth, _ = simulate(trials=4, random_hand_eye=random_hand_eye)
    solution = solve(
        problem, SolverSettings(unknowns=EXACT, noise=NoiseSettings(estimate="never"), bias_correction=False), method
    )
    degrees, mm = error(solution, truth)
    assert solution.status.tolist() == [SolveStatus.CONVERGED] * 4
    assert float(degrees.max()) < 1e-5  # quaternion and score tolerances; data exact to 1e-15
    assert float(mm.max()) < 1e-4


def test_linear_start_is_exact_on_exact_lines(simulate):
    """Eqs. 10 to 13: the right rotation and not its mirror image."""
    problem, truth, _ = simulate(trials=3, random_hand_eye=True)
    R = linear_rotation(torch.linalg.eigh(LineStatistics.from_problem(problem).rotation_gram.sum(1)).eigenvectors)
    torch.testing.assert_close(R, torch.as_tensor(truth["camera_right_T_arm"])[:, :3, :3], atol=1e-9, rtol=0)


def test_paper_averages_two_estimates_of_the_same_unknown(simulate):
    problem, truth, _ = simulate(trials=1)
    R, t = solve_paper(LineStatistics.from_problem(problem))
    X = torch.as_tensor(truth["camera_right_T_arm"])
    for camera in range(2):  # the left camera's own estimate is of camera_right_T_arm too (Eq. 8)
        torch.testing.assert_close(R[:, camera], X[:, :3, :3], atol=1e-8, rtol=0)
        torch.testing.assert_close(t[:, camera], X[:, :3, 3], atol=1e-5, rtol=0)


@pytest.mark.parametrize("kinds", [("axis",), ("contours", "ends"), ("axis", "heads"), ("contours", "ends", "heads")])
@pytest.mark.parametrize("cameras", [1, 2])
def test_joint_is_within_three_sigma_at_realistic_noise(simulate, realistic, kinds, cameras):
    problem, truth, _ = simulate(**realistic)
    solution = solve(problem.only(*kinds).cameras(cameras), SolverSettings(unknowns=EXACT))
    degrees, mm = error(solution, truth)
    assert bool(solution.converged.all())
    assert bool((degrees < 3.0 * solution.rotation_sigma_deg).all())
    assert bool((mm < 3.5 * solution.translation_sigma_mm).all())
    assert float(solution.chi2_per_dof.mean()) == pytest.approx(1.0, abs=0.1)
    assert Verdict.of(solution.verdict[0]) is Verdict.TRUSTWORTHY


@pytest.mark.parametrize("method", ["paper", "global", "joint"])
def test_batched_equals_looped(simulate, realistic, method):
    problem, _, arrays = simulate(trials=3, positions_instrument=2, **realistic)
    settings = SolverSettings(bias_correction=False)  # its draws are another sequence in a batch
    together = solve(problem, settings, method)
    arrays = {key: value for key, value in arrays.items() if key != "truth"}
    for trial in range(3):
        one = Problem.from_arrays({k: v[trial] if hasattr(v, "ndim") and v.ndim > 0 else v for k, v in arrays.items()})
        alone = solve(one, settings, method)
        assert alone.camera_right_T_arm.shape == (4, 4)
        tolerance = 3e-3 * float(alone.translation_sigma_mm)  # both have converged to 1e-3 sigma
        torch.testing.assert_close(alone.camera_right_T_arm, together.camera_right_T_arm[trial], atol=tolerance, rtol=0)


def test_same_seed_same_result(simulate, realistic):
    problem, _, _ = simulate(positions_instrument=2, **realistic)
    a, b = solve(problem), solve(problem)
    assert torch.equal(a.camera_right_T_arm, b.camera_right_T_arm)


@pytest.mark.slow
def test_bias_correction_removes_the_errors_in_variables_bias(simulate):
    """At c = 1 the plain estimate is off by the same 0.5 mm in every trial."""
    problem, truth, _ = simulate(
        trials=24, positions_laparoscope=3, pixel_noise_px=0.5, kinematics_noise_mm=1.0, kinematics_noise_deg=1.0
    )
    problem = problem.only("axis").with_exact_setup()
    X = torch.as_tensor(truth["camera_right_T_arm"])[:, :3, 3]
    mean_error, sigma = {}, {}
    for corrected in (False, True):
        solution = solve(problem, SolverSettings(bias_correction=corrected))
        gap = solution.camera_right_T_arm[:, :3, 3] - X
        mean_error[corrected] = float(torch.linalg.vector_norm(gap.mean(0)))
        sigma[corrected] = float(gap.std(0).norm()) / 24**0.5
    assert mean_error[False] > 4.0 * sigma[False]
    assert mean_error[True] < 3.0 * sigma[True]


def test_radius_and_end_offset_are_estimated_with_their_sigma(simulate, realistic):
    problem, truth, _ = simulate(**realistic)
    wrong = replace(problem, radius_mm=problem.radius_mm * 1.03).only("contours", "ends")
    solution = solve(wrong, SolverSettings())
    radius, offset = solution.nuisances["radius"], solution.nuisances["end_offset"]
    assert bool(((radius.value[:, 0] - problem.radius_mm).abs() < 4.0 * radius.sigma[:, 0]).all())
    assert bool(((offset.value[:, 0] - truth["shaft_end_offset_mm"]).abs() < 4.0 * offset.sigma[:, 0]).all())
    assert not bool(radius.held.any())
    _, mm = error(solution, truth)
    assert bool((mm < 3.5 * solution.translation_sigma_mm).all())


@pytest.mark.parametrize("method", ["global", "joint"])
def test_groups_of_trials_are_solved_as_one_batch(simulate, realistic, method, monkeypatch):
    """Up to the solver's tolerance: in one batch no trial stops before the last."""
    problem, _, _ = simulate(**realistic | {"trials": 3})
    settings = SolverSettings(unknowns=EXACT, bias_correction=False)  # simulations draw anew in each group
    whole = solve(problem, settings, method)
    monkeypatch.setattr("rmis_calib.solver.api.GROUP_MOTIONS", 2 * problem.n_motions)
    grouped = solve(problem, settings, method)
    for name in ("camera_right_T_arm", "covariance", "distance", "residual_lines"):
        torch.testing.assert_close(getattr(grouped, name), getattr(whole, name), equal_nan=True, rtol=1e-3, atol=1e-7)
    assert grouped.status.tolist() == whole.status.tolist()
    assert grouped.noise.keys() == whole.noise.keys() and grouped.nuisances.keys() == whole.nuisances.keys()
    assert grouped.observability.sigma_mm.shape == whole.observability.sigma_mm.shape


def test_an_unknown_that_some_trials_lack_is_held_in_them(simulate, realistic):
    problem, _, _ = simulate(**realistic)
    with_radius, without = solve(problem), solve(problem.only("axis"))
    both = concatenate([with_radius, without])
    b = problem.n_trials
    torch.testing.assert_close(both.nuisances["radius"].value[:b], with_radius.nuisances["radius"].value)
    assert bool(both.nuisances["radius"].value[b:].isnan().all()) and bool(both.nuisances["radius"].held[b:].all())
