"""Variance components, robust weights and the bias, each against an independent answer."""

from dataclasses import replace

import pytest
import torch
from scipy.stats import chi2

from rmis_calib.solver import MotionReason, SolverSettings, solve
from rmis_calib.solver.estimate.bias import expected_score
from rmis_calib.solver.estimate.map_estimate import map_estimate
from rmis_calib.solver.estimate.outliers import chi2_quantile, classify
from rmis_calib.solver.model.motion_covariance import camera_distance2
from rmis_calib.solver.model.normal_equations import normal_equations
from rmis_calib.solver.settings import NoiseSettings, UnknownSettings

EXACT = UnknownSettings(radius_sigma_relative=0.0)


@pytest.mark.parametrize("cameras", [1, 2])
def test_noise_levels_are_found(simulate, realistic, unknown_noise, cameras):
    """True: 0.3 px of 800, 0.3 mm, 0.1 deg; assumed: 0.56 px, 0.6 mm, 0.3 deg."""
    problem, _, _ = simulate(trials=2, **realistic)
    settings = SolverSettings(unknowns=EXACT, noise=NoiseSettings(kinematics_mm=0.6, kinematics_deg=0.3))
    solution = solve(unknown_noise(problem).only("contours", "ends").cameras(cameras), settings)
    assert (solution.noise["line"] * 7e-4 * 800.0).tolist() == pytest.approx([0.3, 0.3], rel=0.1)
    assert solution.noise["kinematics_mm"].tolist() == pytest.approx([0.3, 0.3], rel=0.2)
    assert torch.rad2deg(solution.noise["kinematics_rad"]).tolist() == pytest.approx([0.1, 0.1], rel=0.2)
    assert solution.chi2_per_dof.tolist() == pytest.approx([1.0, 1.0], abs=0.1)


def test_given_noise_levels_are_left_alone(simulate, realistic):
    problem, _, _ = simulate(trials=1, **realistic)
    solution = solve(problem.only("contours", "ends"))
    assert float(solution.noise["kinematics_mm"]) == pytest.approx(0.3)
    assert float(solution.noise["line"]) == 1.0


@pytest.mark.parametrize("probability", [0.5, 1e-2, 1e-4])
def test_chi2_quantile(probability):
    rows = torch.tensor([1.0, 2.0, 5.0, 10.0, 20.0], dtype=torch.float64)
    expected = torch.as_tensor(chi2.isf(probability, rows.numpy()))
    torch.testing.assert_close(chi2_quantile(rows, probability), expected)


def test_suspicion_by_motion_finds_what_every_camera_test_finds(simulate, realistic):
    problem, _, _ = simulate(trials=2, **realistic)
    fit = map_estimate(problem, SolverSettings(robust="off"))
    xy = fit.model.measured.line_xy.clone()
    xy[0, :, 0, :, ::40] += 0.01  # right camera
    model = replace(fit.model, measured=replace(fit.model.measured, line_xy=xy))
    normal = normal_equations(model, fit.state)
    everywhere = classify(model, fit.state, 1e-4)
    where_suspicious = classify(model, fit.state, 1e-4, normal.distance2)
    assert torch.equal(everywhere, where_suspicious)
    measured = fit.model.measured.line_ok[:, 0].any(0)[:, ::40]
    assert float((everywhere[0, :, ::40] < 0.5)[measured].double().mean()) > 0.8  # some lines run along the shift
    assert float((everywhere[1] > 0.5).double().mean()) > 0.99


def test_distances_follow_chi2(simulate, realistic):
    problem, _, _ = simulate(trials=4, **realistic)
    fit = map_estimate(problem.only("contours", "ends"), SolverSettings(robust="off"))
    distance2, rows = camera_distance2(fit.model.measured, fit.state, fit.model.noise)
    assert float(distance2[rows == 5].mean()) == pytest.approx(5.0, rel=0.05)
    assert float((distance2[rows == 5] > chi2.isf(0.05, 5)).double().mean()) == pytest.approx(0.05, abs=0.02)


def test_one_wrong_line_is_named_and_does_no_harm(simulate, realistic):
    problem, _, _ = simulate(trials=1, **realistic)
    problem = problem.only("contours", "ends")
    clean = solve(problem)
    contour = problem.contour_xy.clone()
    contour[0, 0, 7] += 0.05
    solution = solve(replace(problem, contour_xy=contour))
    assert int(solution.reason[0, 7]) == MotionReason.OUTLIER_ONE_CAMERA
    assert int((solution.reason[0] != 0).sum()) <= 2
    gap = torch.linalg.vector_norm(solution.camera_right_T_arm[0, :3, 3] - clean.camera_right_T_arm[0, :3, 3])
    assert float(gap) < 0.3 * float(clean.translation_sigma_mm)


def test_expected_score_equals_brute_force(simulate):
    """Antithetic pairs against plain simulation with 60 times as many draws."""
    problem, _, _ = simulate(
        trials=1, positions_instrument=2, pixel_noise_px=0.3, kinematics_noise_mm=1.0, kinematics_noise_deg=1.0
    )
    fit = map_estimate(problem.only("axis"), SolverSettings(bias_correction=False))
    pairs, again = (expected_score(fit.model, fit.state, 64 * 60, seed=seed) for seed in (0, 1))
    sigma = torch.linalg.inv(fit.covariance[0, :6, :6]).diagonal().sqrt()  # of the score
    assert float(((pairs.g - again.g)[0, :6] / sigma).abs().max()) < 0.1
    assert float((pairs.g[0, :6] / sigma).abs().max()) > 0.1  # there is a bias to find


def test_noise_free_scores_have_no_bias(simulate):
    problem, _, _ = simulate(trials=1, positions_instrument=2)
    fit = map_estimate(
        problem.only("axis"), SolverSettings(noise=NoiseSettings(estimate="never"), bias_correction=False)
    )
    quiet = replace(
        fit.model.noise, **{name: value * 0.0 for name, value in vars(fit.model.noise).items() if "_" in name}
    )
    score = expected_score(replace(fit.model, noise=quiet), fit.state, 64, seed=0)
    sigma = torch.linalg.inv(fit.covariance[0, :6, :6]).diagonal().sqrt()
    assert float((score.g[0, :6] / sigma).abs().max()) < 1e-3
