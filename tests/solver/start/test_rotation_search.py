"""The quadratic form on SO(3): derivatives, descent, and every basin found."""

import torch

from rmis_calib.geometry.rotations import quat_to_matrix, random_quat, rotation_angle, rotvec_to_matrix
from rmis_calib.solver.start.rotation_search import (
    derivatives,
    distinct_minima,
    rotation_cost,
    rotation_grid,
    search_rotations,
    unvec,
    vec,
)


def random_gram(seed=0, batch=3):
    generator = torch.Generator().manual_seed(seed)
    A = torch.randn(batch, 20, 9, generator=generator, dtype=torch.float64)
    return A.mT @ A


def test_vec_stacks_columns():
    R = torch.arange(9.0, dtype=torch.float64).view(3, 3)
    assert vec(R).tolist() == [0, 3, 6, 1, 4, 7, 2, 5, 8]  # rows first would be 0, 1, 2, ...
    torch.testing.assert_close(unvec(vec(R)), R)


def test_gradient_and_hessian_equal_autodiff():
    gram = random_gram()[:1]
    R = quat_to_matrix(random_quat((4,), generator=torch.Generator().manual_seed(1), dtype=torch.float64))[None]
    _, gradient, hessian, _ = derivatives(gram, R)
    for i in range(4):

        def cost(phi, i=i):
            x, y, z = phi
            K = torch.stack((torch.stack((0 * x, -z, y)), torch.stack((z, 0 * x, -x)), torch.stack((-y, x, 0 * x))))
            turned = R[0, i] + K @ R[0, i] + 0.5 * K @ K @ R[0, i]  # exp to second order
            return rotation_cost(gram, turned[None, None])[0, 0]

        zero = torch.zeros(3, dtype=torch.float64)
        torch.testing.assert_close(gradient[0, i], torch.autograd.functional.jacobian(cost, zero))
        torch.testing.assert_close(hessian[0, i], torch.autograd.functional.hessian(cost, zero), atol=1e-8, rtol=1e-8)


def test_grid_covers_all_rotations():
    grid = rotation_grid(576, torch.zeros((), dtype=torch.float64))
    probes = quat_to_matrix(random_quat((500,), generator=torch.Generator().manual_seed(2), dtype=torch.float64))
    nearest = rotation_angle(probes[:, None].mT @ grid).amin(1)
    assert float(torch.rad2deg(nearest).max()) < 26.0  # measured 24.6 over 20,000 probes


def test_known_minimum_is_found_from_anywhere():
    """vec(R)^T M vec(R) with M = sum of kron(v, n) rows of an exact rotation has its zero there, whatever the
    rotation."""
    generator = torch.Generator().manual_seed(3)
    R = quat_to_matrix(random_quat((32,), generator=generator, dtype=torch.float64))
    v = torch.nn.functional.normalize(torch.randn(32, 40, 3, generator=generator, dtype=torch.float64), dim=-1)
    n = torch.nn.functional.normalize(
        torch.linalg.cross(v @ R.mT, torch.randn(32, 40, 3, generator=generator, dtype=torch.float64)), dim=-1
    )
    rows = (v[..., :, None] * n[..., None, :]).flatten(-2)
    found, cost = search_rotations(rows.mT @ rows, 576, 4)
    assert float(cost[:, 0].max()) < 1e-12
    assert float(rotation_angle(found[:, 0].mT @ R).max()) < 1e-6


def test_distinct_minima_are_apart_and_sorted():
    R = rotvec_to_matrix(torch.tensor([[0.0, 0.0, 0.0], [0.0, 0.0, 0.05], [0.0, 1.0, 0.0]], dtype=torch.float64))[None]
    minima, cost = distinct_minima(R, torch.tensor([[2.0, 1.0, 3.0]], dtype=torch.float64), 3)
    assert cost[0].tolist() == [1.0, 3.0, float("inf")]
    torch.testing.assert_close(minima[0, :2], R[0, [1, 2]])
