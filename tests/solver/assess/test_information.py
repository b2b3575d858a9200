"""Thinning by information."""

import pytest
import torch

from rmis_calib.errors import InputError
from rmis_calib.solver import MotionReason, SolverSettings, solve
from rmis_calib.solver.assess.information import motion_information, select_d_optimal
from rmis_calib.solver.estimate.map_estimate import map_estimate


@pytest.fixture(scope="module")
def static(simulate, realistic):
    problem, truth, _ = simulate(trials=1, positions_laparoscope=1, positions_instrument=6, **realistic)
    return problem.only("contours", "ends").cameras(1), truth


def test_information_of_motions_adds_up(static):
    problem, _ = static
    fit = map_estimate(problem, SolverSettings(bias_correction=False, robust="off"))
    each = motion_information(fit.model, fit.state)[0]
    prior = torch.diag(fit.model.layout.sigma[0].square().reciprocal())
    torch.testing.assert_close(torch.linalg.inv(each.sum(0) + prior), fit.covariance[0], rtol=1e-6, atol=1e-12)


def test_thinning_picks_better_motions_than_chance(static):
    problem, _ = static
    fit = map_estimate(problem, SolverSettings())
    each = motion_information(fit.model, fit.state)[0]
    prior = torch.diag(fit.model.layout.sigma[0].square().reciprocal())
    index, kept = select_d_optimal(each, prior, 40)
    assert len(index) == 40 == len(set(index.tolist()))

    def part_kept(chosen):
        full, part = (torch.linalg.inv(each[i].sum(0) + prior)[:6, :6] for i in (slice(None), chosen))
        return float(torch.exp((torch.logdet(full) - torch.logdet(part)) / 6.0))

    generator = torch.Generator().manual_seed(0)
    chance = [part_kept(torch.randperm(216, generator=generator)[:40]) for _ in range(20)]
    assert kept == pytest.approx(part_kept(index), rel=1e-6)
    assert kept > 1.2 * max(chance)  # 40 of 216 at random keep 0.18 to 0.20, these 0.25


def test_thinned_solve_says_what_it_left_out(static):
    problem, truth = static
    solution = solve(problem, SolverSettings(thin_to=60))
    assert int((solution.reason[0] == MotionReason.THINNED).sum()) == 216 - 60
    assert 60 / 216 < solution.information_kept < 1.0
    assert bool(torch.isnan(solution.distance[0][solution.reason[0] == MotionReason.THINNED]).all())
    X = torch.as_tensor(truth["camera_right_T_arm"])
    gap = torch.linalg.vector_norm(solution.camera_right_T_arm[:, :3, 3] - X[:, :3, 3], dim=-1)
    assert bool((gap < 3.5 * solution.translation_sigma_mm).all())


def test_batches_cannot_be_thinned(simulate):
    problem, _, _ = simulate(trials=2)
    with pytest.raises(InputError, match="a single trial"):
        solve(problem, SolverSettings(thin_to=10))
