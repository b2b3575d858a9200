"""A trial's answer is its own: the same alone and beside any others, whatever these need."""

from dataclasses import replace

import numpy as np
import pytest
import torch

from data_synth.lines import simulate_lines
from data_synth.settings import LineStudyConfig
from rmis_calib.solver import Problem, SolverSettings, api, solve
from rmis_calib.solver.settings import NoiseSettings


@pytest.fixture(scope="module")
def mixed(realistic):
    """Good trials beside one with outliers, one that is nearly all noise, one without ends, and one without a left
    picture."""
    arrays = simulate_lines(
        LineStudyConfig(trials=6, positions_laparoscope=2, positions_instrument=2, random_hand_eye=True, **realistic)
    )
    generator = np.random.default_rng(0)
    arrays["contour_right"][1, ::4] += generator.normal(scale=0.1, size=arrays["contour_right"][1, ::4].shape)
    arrays["contour_right"][2] += generator.normal(scale=5e-3, size=arrays["contour_right"][2].shape)
    arrays["end_right"][3], arrays["end_left"][3] = np.nan, np.nan
    arrays["contour_left"][4], arrays["end_left"][4] = np.nan, np.nan
    return Problem.from_arrays(arrays).only("contours", "ends")


@pytest.mark.parametrize("estimate", ["never", "always"])
@pytest.mark.parametrize("robust", ["auto", "off"])
def test_joint_does_not_depend_on_batch_mates(mixed, estimate, robust):
    settings = SolverSettings(noise=NoiseSettings(estimate=estimate), robust=robust)
    together = solve(mixed, settings)
    for b in range(mixed.n_trials):
        alone = solve(mixed.take_trials(b), settings)
        scale = alone.covariance.diagonal().sqrt()
        gap = (together.camera_right_T_arm[b] - alone.camera_right_T_arm).abs()
        assert float(gap[:3, :3].max() / scale[:3].min()) < 1e-9
        assert float(gap[:3, 3].max() / scale[3:].min()) < 1e-9
        torch.testing.assert_close(together.covariance[b], alone.covariance, rtol=1e-8, atol=0)
        assert int(together.status[b]) == int(alone.status)
        torch.testing.assert_close(together.reason[b], alone.reason)


@pytest.mark.parametrize("method", ["paper", "global", "joint"])
def test_groups_of_trials_make_no_difference(realistic, method, monkeypatch):
    arrays = simulate_lines(LineStudyConfig(trials=5, positions_laparoscope=2, positions_instrument=2, **realistic))
    problem = Problem.from_arrays(arrays)
    whole = solve(problem, method=method)
    monkeypatch.setattr(api, "GROUP_MOTIONS", 2 * problem.n_motions)
    in_groups = solve(problem, method=method)
    gap = (whole.camera_right_T_arm - in_groups.camera_right_T_arm)[:, :3, 3].norm(dim=-1)
    assert float((gap / whole.translation_sigma_mm).max()) < 1e-9


def test_the_order_of_trials_makes_no_difference(mixed):
    order = torch.tensor([3, 0, 5, 2, 4, 1])
    forth, back = solve(mixed), solve(mixed.take_trials(order))
    gap = (forth.camera_right_T_arm[order] - back.camera_right_T_arm)[:, :3, 3].norm(dim=-1)
    assert float((gap / back.translation_sigma_mm).max()) < 1e-9


def test_chunks_make_no_difference(mixed):
    """The bias draws do not depend on how trials are cut into chunks."""
    small = solve(mixed, replace(SolverSettings(), chunk=256))
    gap = (small.camera_right_T_arm - solve(mixed).camera_right_T_arm)[:, :3, 3].norm(dim=-1)
    assert float((gap / small.translation_sigma_mm).max()) < 1e-9
