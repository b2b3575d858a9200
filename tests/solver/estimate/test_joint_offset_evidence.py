"""Whether the data ask for joint offsets, and what the covariance says when that is open."""

from dataclasses import replace

import numpy as np
import pytest
import torch
from scipy.stats import multivariate_normal

from rmis_calib.geometry.rotations import rotvec_to_matrix
from rmis_calib.solver import SolverSettings, solve
from rmis_calib.solver.assess.assemble import _mixed
from rmis_calib.solver.assess.offset_sizes import offset_sizes
from rmis_calib.solver.settings import UnknownSettings
from rmis_calib.solver.solution import AlternativeModel, Nuisance
from tests.benchmarks.bench_solver_nuisance import record

OFFSETS = UnknownSettings(radius_sigma_relative=0.0, stereo=False, joint_offsets="always")


@pytest.fixture(scope="module")
def linear():
    """A linear problem with 6 parameters of the transform and 3 offsets, in the place of a solution's: design, data,
    and the solution. The third offset moves next to nothing."""
    recorded, _ = record(1, 40, 4)
    kinematics = lambda joints, clock: recorded.kinematics(joints, clock).only("contours", "ends")  # noqa: E731
    start = kinematics(torch.zeros(1, 6, dtype=torch.float64), torch.zeros(1, 2, dtype=torch.float64))
    solution = solve(start, SolverSettings(unknowns=OFFSETS), kinematics=kinematics)
    generator = np.random.default_rng(1)
    J = generator.standard_normal((30, 9))
    J[:, 8] *= 1e-3
    y = J @ np.array([0.0, 0, 0, 0, 0, 0, 0.7, -0.4, 1.0]) + generator.standard_normal(30)
    sigma = torch.tensor([[torch.inf] * 6 + [0.5] * 3], dtype=torch.float64)
    H = J.T @ J + np.diag([0.0] * 6 + [4.0] * 3)
    estimate = np.linalg.solve(H, J.T @ y)
    blocks = {"rotation": slice(0, 3), "translation": slice(3, 6), "joint_offset": slice(6, 9)}
    posterior = solution.posterior
    layout = replace(posterior.layout, blocks=blocks, sigma=sigma)
    value = torch.as_tensor(estimate[None, 6:])
    held, unseen = torch.zeros_like(value, dtype=torch.bool), torch.zeros(1, 3, 3, dtype=torch.float64)
    offset = Nuisance(value, torch.ones_like(value), "rad", held, value, unseen)
    fitted = replace(
        solution,
        posterior=replace(posterior, layout=layout, information=torch.as_tensor(H)[None]),
        nuisances={"joint_offset": offset},
        chi2_per_dof=torch.ones(1, dtype=torch.float64),
        covariance=torch.as_tensor(np.linalg.inv(H)[None, :6, :6]),
        groups=None,
    )
    return J, y, estimate, fitted


def test_probability_of_a_size_is_its_marginal_likelihood(linear):
    """Against the density of the data (SciPy), everything else integrated out under a very wide prior."""
    J, y, _, fitted = linear
    sizes = offset_sizes(fitted, 0.9, torch.ones(3, dtype=torch.bool))
    wide = 1e5 * J[:, :6] @ J[:, :6].T + np.eye(30)
    prior = np.array([0.1, *(0.9 * sizes.size[1:] / sizes.size[1:].sum())])  # uniform: in proportion to the step
    density = [
        multivariate_normal.logpdf(y, np.zeros(30), wide + (0.5 * size) ** 2 * J[:, 6:] @ J[:, 6:].T)
        for size in sizes.size.tolist()
    ]
    expected = prior * np.exp(np.array(density) - max(density))
    np.testing.assert_allclose(sizes.probability, expected / expected.sum(), rtol=1e-3)
    odds = (expected[1:].sum() / 0.9) / (expected[0] / 0.1)
    assert sizes.log_odds == pytest.approx(np.log(odds), abs=1e-3)


def test_answer_for_a_size_is_that_of_a_solve_with_it(linear):
    J, y, estimate, fitted = linear
    sizes = offset_sizes(fitted, 0.9, torch.ones(3, dtype=torch.bool))
    for index in (1, 5, 9):
        H = J.T @ J + np.diag([0.0] * 6 + [(0.5 * float(sizes.size[index])) ** -2] * 3)
        np.testing.assert_allclose(sizes.shift[index], (np.linalg.solve(H, J.T @ y) - estimate)[:6], atol=1e-9)
        np.testing.assert_allclose(sizes.covariance[index], np.linalg.inv(H)[:6, :6], atol=1e-9)
    alone = np.linalg.inv(J[:, :6].T @ J[:, :6])
    np.testing.assert_allclose(sizes.covariance[0], alone, atol=1e-9)
    chosen = sizes.chosen
    rest = sizes.besides(chosen)
    assert float(rest.probability) == pytest.approx(1.0 - float(sizes.probability[chosen]))


@pytest.mark.parametrize("size_deg", [0.0, 0.5])
def test_data_tell_how_large_offsets_are(size_deg):
    deg, mm = np.deg2rad(size_deg), 2.0 * size_deg
    recorded, _ = record(1, 200, 5, offset=[deg, -deg, mm, -deg, deg, -mm])
    kinematics = lambda joints, clock: recorded.kinematics(joints, clock).only("contours", "ends")  # noqa: E731
    start = kinematics(torch.zeros(1, 6, dtype=torch.float64), torch.zeros(1, 2, dtype=torch.float64))
    sizes = offset_sizes(
        solve(start, SolverSettings(unknowns=OFFSETS), kinematics=kinematics), 0.8, torch.ones(6, dtype=torch.bool)
    )
    assert sizes.quantile(0.05) > 0.3 if size_deg else sizes.quantile(0.5) < 0.3  # in priors of 0.5 deg
    assert float(sizes.probability[0]) < 0.01 if size_deg else float(sizes.probability[0]) > 0.2


def test_covariance_of_two_models_is_that_of_their_mixture():
    """Against draws from the mixture, about the first model's estimate."""
    generator = np.random.default_rng(3)
    C0, C1 = np.diag([1e-6] * 3 + [0.01] * 3), np.diag([4e-6] * 3 + [0.09] * 3)
    gap = np.array([1e-3, -2e-3, 5e-4, 0.3, -0.2, 0.1])
    T = torch.eye(4, dtype=torch.float64)[None].clone()
    T[:, :3, :3], T[:, :3, 3] = rotvec_to_matrix(torch.as_tensor(gap[None, :3])), torch.as_tensor(gap[3:])
    alternative = AlternativeModel(T, torch.as_tensor(C1)[None], torch.tensor([0.3], dtype=torch.float64))
    found = _mixed(
        torch.as_tensor(C0)[None],
        torch.eye(3, dtype=torch.float64)[None],
        torch.zeros(1, 3, dtype=torch.float64),
        alternative,
    )[0].numpy()
    other = generator.random(400_000) < 0.3
    draws = np.where(
        other[:, None],
        generator.multivariate_normal(gap, C1, 400_000),
        generator.multivariate_normal(np.zeros(6), C0, 400_000),
    )
    expected = draws.T @ draws / len(draws)
    scale = np.sqrt(np.diag(expected))
    assert np.abs((found - expected) / np.outer(scale, scale)).max() < 0.01


def test_belief_widens_sigma_only(simulate, realistic):
    problem, _, _ = simulate(trials=1, **realistic)
    settings = SolverSettings(unknowns=replace(OFFSETS, joint_offsets="never"))
    alone = solve(problem, settings)
    alternative = AlternativeModel(
        alone.camera_right_T_arm, 9.0 * alone.covariance, torch.tensor([0.5], dtype=torch.float64)
    )
    both = solve(problem, settings, alternative=alternative)
    torch.testing.assert_close(both.camera_right_T_arm, alone.camera_right_T_arm)
    torch.testing.assert_close(both.covariance, 5.0 * alone.covariance)
