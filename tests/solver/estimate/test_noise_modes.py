"""Noise levels that could settle in more than one way."""

from dataclasses import replace

import torch

from rmis_calib.solver import SolverSettings, solve
from rmis_calib.solver.estimate.map_estimate import map_estimate
from rmis_calib.solver.estimate.noise_levels import restricted_likelihood
from rmis_calib.solver.model.jacobian import columns
from rmis_calib.solver.model.motion_covariance import image_variance
from rmis_calib.solver.model.residuals import linearise


def test_restricted_likelihood_is_that_of_all_rows_together(simulate, realistic):
    """Against the textbook's formula on the stacked system: log |V| + log |X^T V^-1 X| + r^T V^-1 r."""
    problem, _, _ = simulate(trials=1, positions_laparoscope=1, positions_instrument=2, **realistic)
    fit = map_estimate(problem.only("axis"), SolverSettings(bias_correction=False, robust="off"))
    found = restricted_likelihood(fit.model, fit.state)
    louder = replace(fit.model, noise=replace(fit.model.noise, kinematics_mm=4.0 * fit.model.noise.kinematics_mm))
    difference = float(restricted_likelihood(louder, fit.state) - found)
    dense = [_dense(model, fit.state) for model in (fit.model, louder)]
    assert abs(difference - (dense[1] - dense[0])) < 1e-6


def _dense(model, state):
    measured, noise = model.measured, model.noise
    linear, shaft = linearise(measured, state)
    J = columns(model.layout, linear, shaft, measured, state)[:, :, 0]  # (k, p, n)
    k, p, n = J.shape
    blocks = []
    for i in range(n):
        w, a = linear.w[:, :, 0, i], linear.a[:, :, 0, i]
        D = torch.diag(image_variance(measured, noise)[:, 0, i])
        blocks.append(D + noise.kinematics_mm * w.T @ w + noise.kinematics_rad * a.T @ a)
    V = torch.block_diag(*blocks)
    X, r = J.permute(2, 0, 1).reshape(n * k, p), linear.r[:, 0].T.reshape(-1)
    deviation, weight = model.layout.prior(state)
    H = X.T @ torch.linalg.solve(V, X) + torch.diag(weight[0])
    quadratic = r @ torch.linalg.solve(V, r) + (weight * deviation.square()).sum()
    return float(-0.5 * (torch.logdet(V) + torch.logdet(H) + quadratic))


def test_pictures_ten_times_worse_than_assumed_are_not_blamed_on_the_joints(simulate, unknown_noise):
    """Image noise of 5 px where 0.6 px are assumed, and good joints."""
    problem, _, _ = simulate(
        trials=8, positions_laparoscope=1, positions_instrument=4, pixel_noise_px=5.0, kinematics_noise_mm=0.05,
        kinematics_noise_deg=0.02, seed=3,
    )  # fmt: skip
    solution = solve(unknown_noise(problem.only("contours")))
    line = solution.noise["line"] * 7e-4 * 800.0
    assert bool(((line > 4.0) & (line < 6.0)).all())
    assert bool((torch.rad2deg(solution.noise["kinematics_rad"]) < 0.3).all())
