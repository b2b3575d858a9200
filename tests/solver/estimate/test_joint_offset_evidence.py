"""Whether the data ask for joint offsets, and what the covariance says when that is open."""

from dataclasses import replace

import numpy as np
import pytest
import torch
from scipy.stats import norm

from rmis_calib.geometry.rotations import rotvec_to_matrix
from rmis_calib.solver import SolverSettings, solve
from rmis_calib.solver.assess.assemble import _log_odds_nominal, _mixed
from rmis_calib.solver.settings import UnknownSettings
from rmis_calib.solver.solution import AlternativeModel
from tests.benchmarks.bench_solver_nuisance import record

OFFSETS = UnknownSettings(radius_sigma_relative=0.0, stereo=False, joint_offsets="always")


def test_log_odds_are_the_ratio_of_marginal_likelihoods():
    """One unknown, prior N(0, 0.5^2), one datum of sigma 0.2: both evidences in closed form (SciPy)."""
    prior, sigma, datum = 0.5, 0.2, 0.37
    variance = 1.0 / (prior**-2 + sigma**-2)
    expected = norm.logpdf(datum, 0.0, sigma) - norm.logpdf(datum, 0.0, np.hypot(prior, sigma))
    found = _log_odds_nominal(
        torch.tensor([[variance * datum / sigma**2]]), torch.tensor([[[variance]]]), torch.tensor([[prior]])
    )
    assert float(found) == pytest.approx(expected, abs=1e-6)


def test_unseen_offsets_say_nothing():
    sigma = torch.tensor([[0.1, 2.0]], dtype=torch.float64)
    unseen = _log_odds_nominal(torch.zeros_like(sigma), torch.diag_embed(sigma.square()), sigma)
    assert float(unseen) == pytest.approx(0.0, abs=1e-12)


@pytest.mark.parametrize("size_deg", [0.0, 0.5])
def test_data_tell_a_robot_with_offsets_from_one_without(size_deg):
    deg, mm = np.deg2rad(size_deg), 2.0 * size_deg
    recorded, _ = record(3, 200, 4, offset=[deg, -deg, mm, -deg, deg, -mm])
    kinematics = lambda joints, clock: recorded.kinematics(joints, clock).only("contours", "ends")  # noqa: E731
    start = kinematics(torch.zeros(3, 6, dtype=torch.float64), torch.zeros(3, 2, dtype=torch.float64))
    odds = solve(start, SolverSettings(unknowns=OFFSETS), kinematics=kinematics).nuisances["joint_offset"]
    assert bool(odds.log_odds_nominal.median() < -2.0 if size_deg else odds.log_odds_nominal.min() > 1.0)


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
