"""Sufficient statistics: they equal the sums they stand for, add, and carry the direction."""

import pytest
import torch

from rmis_calib.errors import InputError
from rmis_calib.solver import LineStatistics
from rmis_calib.solver.start.candidates import find_candidates, solve_translation
from rmis_calib.solver.start.line_statistics import plane_normals
from rmis_calib.solver.start.rotation_search import rotation_cost


def test_quadratic_form_equals_the_sum_over_motions(simulate, realistic):
    problem, truth, _ = simulate(**realistic)
    R = torch.as_tensor(truth["camera_right_T_arm"])[:, :3, :3]
    statistics = LineStatistics.from_problem(problem)
    n, _, ok = plane_normals(problem)
    v = (problem.arm_T_rcm[..., :3, :3] @ problem.rcm_v_axis[..., None])[..., 0]
    direct = torch.where(ok, (n * (v @ R.mT)[:, None]).sum(-1), 0.0).square().sum((1, 2))
    torch.testing.assert_close(rotation_cost(statistics.rotation_gram.sum(1), R[:, None])[:, 0], direct)


def test_translation_from_sums_equals_least_squares_over_motions(simulate, realistic):
    """Paper, Eqs. 22 and 23, the left camera through n_lr and R_Z^T t_Z."""
    problem, truth, _ = simulate(trials=1, **realistic)
    R = torch.as_tensor(truth["camera_right_T_arm"])[:, :3, :3]
    statistics = LineStatistics.from_problem(problem)
    n, _, ok = plane_normals(problem)
    p = problem.arm_T_rcm[..., :3, 3] @ R.mT
    rows = n.flatten(1, 2)[0][ok.flatten()]
    target = -(n * (p[:, None] + statistics.offset[:, :, None])).sum(-1).flatten()[ok.flatten()]
    expected = torch.linalg.lstsq(rows, target[:, None]).solution[:, 0]
    t, cost = solve_translation(statistics, R[:, None])
    torch.testing.assert_close(t[0, 0], expected, atol=1e-7, rtol=1e-8)
    torch.testing.assert_close(cost[0, 0], (rows @ expected - target).square().sum(), rtol=1e-6, atol=1e-9)


def test_parts_add_up_to_the_whole(simulate, realistic):
    problem, _, _ = simulate(**realistic)
    whole = LineStatistics.from_problem(problem)
    index = torch.arange(problem.n_motions)
    parts = [LineStatistics.from_problem(problem.select_motions(index[k::3])) for k in range(3)]
    merged = parts[0] + parts[1] + parts[2]
    for name in ("rotation_gram", "point_gram", "count"):
        torch.testing.assert_close(getattr(merged, name), getattr(whole, name))
    a, b = find_candidates(whole, 576, 4).best(), find_candidates(merged, 576, 4).best()
    torch.testing.assert_close(a[1], b[1], atol=1e-4, rtol=0)  # descent settles to 1e-9 of the cost


def test_parts_of_different_rigs_do_not_add(simulate):
    problem, _, _ = simulate()
    other, _, _ = simulate(stereo_noise_mm=0.5)
    with pytest.raises(InputError, match="same stereo extrinsics"):
        LineStatistics.from_problem(problem) + LineStatistics.from_problem(other)
