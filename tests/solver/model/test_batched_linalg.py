"""Component-first vectors and the batched elimination against plain torch."""

import torch

from rmis_calib.solver.model.batched_linalg import (
    batch_last,
    cross,
    dot,
    eliminate,
    forward_substitute,
    rotate,
    rotate_back,
    unit,
)


def systems(k=5, b=2, n=3):
    generator = torch.Generator().manual_seed(0)
    A = torch.randn(b, n, k, k, generator=generator, dtype=torch.float64)
    S = A @ A.mT + torch.eye(k, dtype=torch.float64)
    return S, torch.randn(b, n, k, 4, generator=generator, dtype=torch.float64)


def test_elimination_gives_the_quadratic_form_of_the_inverse():
    S, B = systems()
    augmented = torch.cat((S, B), dim=-1).permute(2, 3, 0, 1).contiguous()
    eliminate(augmented)
    pivots = augmented.diagonal(dim1=0, dim2=1)
    white = augmented[:, 5:] * pivots.permute(2, 0, 1).rsqrt()[:, None]
    torch.testing.assert_close(torch.einsum("kpbn,kqbn->bnpq", white, white), B.mT @ torch.linalg.solve(S, B))
    torch.testing.assert_close(pivots.log().sum(-1), torch.logdet(S))


def test_kept_factor_whitens_another_right_hand_side():
    S, B = systems()
    augmented = eliminate(torch.cat((S, B), dim=-1).permute(2, 3, 0, 1).contiguous())
    torch.testing.assert_close(forward_substitute(augmented[:, :5], B[..., 1].permute(2, 0, 1)), augmented[:, 6])


def test_vectors_with_components_first():
    generator = torch.Generator().manual_seed(0)
    a, b = (torch.randn(4, 3, generator=generator, dtype=torch.float64) for _ in range(2))
    R = torch.linalg.qr(torch.randn(4, 3, 3, generator=generator, dtype=torch.float64))[0]
    first_a, first_b, first_R = batch_last(a, 1), batch_last(b, 1), batch_last(R, 2)
    torch.testing.assert_close(dot(first_a, first_b), (a * b).sum(-1))
    torch.testing.assert_close(cross(first_a, first_b), torch.linalg.cross(a, b).T)
    torch.testing.assert_close(rotate(first_R, first_a), (R @ a[..., None])[..., 0].T)
    torch.testing.assert_close(rotate_back(first_R, rotate(first_R, first_a)), first_a)
    torch.testing.assert_close(dot(unit(first_a), unit(first_a)), torch.ones(4, dtype=torch.float64))
