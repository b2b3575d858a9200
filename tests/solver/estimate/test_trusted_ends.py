"""Ends of the shaft that are not measured at one and the same place of it."""

from dataclasses import replace

import pytest
import torch

from rmis_calib.solver import solve
from rmis_calib.solver.estimate.trusted_ends import shortest_half


@pytest.fixture(scope="module")
def scene(simulate, realistic):
    problem, truth, _ = simulate(trials=2, positions_laparoscope=1, positions_instrument=4, seed=11, **realistic)
    return problem.only("contours", "ends"), torch.as_tensor(truth["camera_right_T_arm"])


def moved_ends(problem, offset_mm):
    """Each end moved along the imaged axis by what its place on the shaft moves: to first order in the picture, from
    the two contours' midline and the depth that their distance tells."""
    middle = problem.contour_xy.mean(-3)  # (b, c, n, 2 points, 2)
    along = torch.nn.functional.normalize(middle[..., 1, :] - middle[..., 0, :], dim=-1)
    across = torch.stack((-along[..., 1], along[..., 0]), dim=-1)
    width = ((problem.contour_xy[..., 0, :, :] - problem.contour_xy[..., 1, :, :]).mean(-2) * across).sum(-1).abs()
    per_mm = width / (2.0 * problem.radius_mm[:, None, None])  # normalised units a mm at the shaft's depth
    return problem.end_xy + along * (per_mm * offset_mm)[..., None]


def test_ends_at_two_places_are_told_apart(scene):
    problem, truth = scene
    n = problem.n_motions
    jaws = torch.arange(n) % 10 < 3
    end_xy = torch.where(jaws[:, None], moved_ends(problem, torch.tensor(15.0, dtype=torch.float64)), problem.end_xy)
    clean, mixed = solve(problem), solve(replace(problem, end_xy=end_xy))
    seen = problem.end_measured
    assert mixed.ends_elsewhere.tolist() == (seen & jaws).sum((1, 2)).tolist()
    assert clean.ends_elsewhere.tolist() == [0, 0]
    gap = torch.linalg.vector_norm(mixed.camera_right_T_arm[:, :3, 3] - truth[:, :3, 3], dim=-1)
    assert bool((gap < 3.0 * mixed.translation_sigma_mm).all())
    assert bool((mixed.translation_sigma_mm < 1.3 * clean.translation_sigma_mm).all())
    assert not bool(torch.isfinite(mixed.residual_ends[:, :, jaws]).any())


def test_ends_without_a_common_place_are_left_out_altogether(scene):
    problem, _ = scene
    generator = torch.Generator().manual_seed(0)
    where = 40.0 * torch.rand(problem.end_xy.shape[:-1], generator=generator, dtype=torch.float64)
    mixed = solve(replace(problem, end_xy=moved_ends(problem, where)))
    without = solve(problem.only("contours"))
    assert mixed.ends_elsewhere.tolist() == problem.end_measured.sum((1, 2)).tolist()
    torch.testing.assert_close(mixed.camera_right_T_arm, without.camera_right_T_arm, atol=1e-3, rtol=0.0)
    assert "end_offset" not in mixed.nuisances


def test_shortest_half_ignores_fewer_others():
    """Of 0..6 and five far ones more than half lie within 0..6: the shortest interval of seven is 0 to 6."""
    value = torch.tensor([0.0, 1, 2, 3, 4, 5, 6, 100, 200, 300, 400, 500, 0, 0], dtype=torch.float64)
    known = torch.tensor([True] * 12 + [False] * 2)
    centre, sigma = shortest_half(value.reshape(2, 1, 7), known.reshape(2, 1, 7))
    assert float(centre) == pytest.approx(3.0)
    assert float(sigma) == pytest.approx(6.0 / 1.349)
    few = shortest_half(value.reshape(2, 1, 7), (torch.arange(14) < 3).reshape(2, 1, 7))
    assert bool(torch.isnan(few[0]).all())
