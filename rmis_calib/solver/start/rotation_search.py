"""Global search for the rotation: every basin of the quadratic form vec(R)^T M vec(R) on SO(3).

A deterministic covering grid is scored at once, its best rotations descend together by Newton steps with the exact
Hessian, and the distinct minima are kept. Only the 9x9 matrix M enters, so the cost does not depend on the number of
motions.

**Derivatives.** With R <- exp([phi]x) R, E_i = [e_i]x, Y = unvec(M vec R) and A = R Y^T, F = vec(R)^T M vec(R) has

    dF/dphi_i = 2 <Y, E_i R> = 2 tr(E_i A),  so  dF/dphi = 2 (A23 - A32, A31 - A13, A12 - A21),
    d2F/dphi_i dphi_j = 2 vec(E_i R)^T M vec(E_j R) + A_ij + A_ji - 2 delta_ij tr A,

the last three terms from E_i E_j = e_j e_i^T - delta_ij I in the second-order part of exp.
`tests/solver/test_rotation_search.py` holds both against autograd.
"""

from functools import lru_cache

import torch
from jaxtyping import Float
from torch import Tensor

from rmis_calib.geometry.rotations import quat_to_matrix, rotvec_to_matrix

KEPT = 96
"""Grid rotations that descend. With 576 on the grid the true basin was among the best 40 in all of 2,000 trials at c
= 1."""
DESCENT_STEPS = 12
DISTINCT_COS = 0.995
"""Cosine of the angle below which two minima are one (5.7 degrees)."""
MAX_STEP_RAD = 0.5
SETTLED = 1e-9
"""Descent ends when no candidate lowers its cost by more than this part."""


@lru_cache(maxsize=4)
def _grid_quaternions(count: int) -> Tensor:
    """Super-Fibonacci spirals (Alexa, CVPR 2022): a low-discrepancy covering of SO(3) for any count."""
    phi, psi = 2.0**0.5, 1.533751168755204288118041
    s = torch.arange(count, dtype=torch.float64) + 0.5
    t, turn = s / count, 2.0 * torch.pi * s
    inner, outer = t.sqrt(), (1.0 - t).sqrt()
    alpha, beta = turn / phi, turn / psi
    return torch.stack((inner * alpha.sin(), inner * alpha.cos(), outer * beta.sin(), outer * beta.cos()), dim=-1)


def rotation_grid(count: int, like: Tensor) -> Float[Tensor, "g 3 3"]:
    """`count` rotations that cover SO(3) evenly; 576 leave no rotation further than about 25 degrees away."""
    return quat_to_matrix(_grid_quaternions(count).to(like))


def vec(R: Float[Tensor, "*b 3 3"]) -> Float[Tensor, "*b 9"]:
    """Columns of R one below the other."""
    return R.mT.flatten(-2)


def unvec(r: Float[Tensor, "*b 9"]) -> Float[Tensor, "*b 3 3"]:
    """Inverse of `vec`."""
    return r.unflatten(-1, (3, 3)).mT


def rotation_cost(gram: Float[Tensor, "b 9 9"], R: Float[Tensor, "b g 3 3"]) -> Float[Tensor, "b g"]:
    """vec(R)^T M vec(R)."""
    r = vec(R)
    return ((r @ gram) * r).sum(-1)


def derivatives(
    gram: Float[Tensor, "b 9 9"], R: Float[Tensor, "b g 3 3"]
) -> tuple[Float[Tensor, "b g"], Float[Tensor, "b g 3"], Float[Tensor, "b g 3 3"], Float[Tensor, "b g 3 3"]]:
    """Cost, gradient, Hessian, and the Hessian's positive semidefinite (Gauss-Newton) part."""
    r = vec(R)
    y = r @ gram
    A = R @ unvec(y).mT
    gradient = 2.0 * torch.stack(
        (A[..., 1, 2] - A[..., 2, 1], A[..., 2, 0] - A[..., 0, 2], A[..., 0, 1] - A[..., 1, 0]), dim=-1
    )
    zero = torch.zeros_like(R[..., 0, :])
    x, y_row, z = R[..., 0, :], R[..., 1, :], R[..., 2, :]
    turned = torch.stack(  # E_i R, rows from E_i's pattern
        (torch.stack((zero, -z, y_row), -2), torch.stack((z, zero, -x), -2), torch.stack((-y_row, x, zero), -2)), dim=-3
    )
    tangent = vec(turned)  # (b, g, 3, 9)
    pushed = (tangent.flatten(1, 2) @ gram).view_as(tangent)
    gauss_newton = 2.0 * (tangent[..., :, None, :] * pushed[..., None, :, :]).sum(-1)
    trace = A.diagonal(dim1=-2, dim2=-1).sum(-1)
    eye = torch.eye(3, dtype=R.dtype, device=R.device)
    return (r * y).sum(-1), gradient, gauss_newton + A + A.mT - 2.0 * trace[..., None, None] * eye, gauss_newton


def newton_step(gradient: Tensor, hessian: Tensor, gauss_newton: Tensor) -> Tensor:
    """-H^-1 g where H is positive definite, else a damped Gauss-Newton step; never longer than MAX_STEP_RAD."""
    size = gauss_newton.diagonal(dim1=-2, dim2=-1).sum(-1)[..., None, None] / 3.0
    eye = torch.eye(3, dtype=gradient.dtype, device=gradient.device)
    a, b, c = hessian[..., 0, 0], hessian[..., 0, 1], hessian[..., 1, 1]
    definite = (a > 0) & (a * c - b * b > 0) & (_determinant(hessian) > 1e-9 * size[..., 0, 0] ** 3)
    system = torch.where(definite[..., None, None], hessian, gauss_newton + 0.1 * size * eye)
    step = -_solve3(system, gradient)
    length = torch.linalg.vector_norm(step, dim=-1, keepdim=True)
    return step * (MAX_STEP_RAD / length.clamp_min(MAX_STEP_RAD))


def _determinant(H: Tensor) -> Tensor:
    return (H[..., 0, :] * torch.linalg.cross(H[..., 1, :], H[..., 2, :])).sum(-1)


def _solve3(H: Float[Tensor, "*b 3 3"], g: Float[Tensor, "*b 3"]) -> Float[Tensor, "*b 3"]:
    """H^-1 g by the adjugate: for batches of 3x3 far faster than LAPACK."""
    c0, c1, c2 = H[..., 0], H[..., 1], H[..., 2]
    k0, k1, k2 = torch.linalg.cross(c1, c2), torch.linalg.cross(c2, c0), torch.linalg.cross(c0, c1)
    det = (c0 * k0).sum(-1, keepdim=True)
    det = torch.where(det.abs() < 1e-300, 1e-300, det)
    return torch.stack(((k0 * g).sum(-1), (k1 * g).sum(-1), (k2 * g).sum(-1)), dim=-1) / det


def on_graph(gram: Float[Tensor, "b 9 9"], R: Float[Tensor, "b 3 3"]) -> Float[Tensor, "b 3 3"]:
    """The minimum R of the rotation cost as a function of the Gram matrix: a Newton step from it (model/implicit.py),
    with the derivatives above."""

    def stepped(gram: Tensor, R: Tensor) -> Tensor:
        _, gradient, hessian, _ = derivatives(gram, R[:, None])
        step = -torch.linalg.solve_ex(hessian[:, 0].detach(), gradient[:, 0, :, None]).result[..., 0]
        return rotvec_to_matrix(step) @ R

    with torch.no_grad():  # to the minimum as exactly as can be told: the search ends earlier
        R = stepped(gram, stepped(gram, R))
    return stepped(gram, R)


def descend(gram: Float[Tensor, "b 9 9"], R: Float[Tensor, "b g 3 3"], steps: int) -> tuple[Tensor, Tensor]:
    """Every rotation moved to its local minimum: (rotations, costs). A step that raises the cost is not taken."""
    cost, gradient, hessian, gauss_newton = derivatives(gram, R)
    scale = torch.ones_like(cost)
    active = torch.ones_like(cost[:, :1], dtype=torch.bool)  # by trial: what becomes of one is not for others to decide
    for _ in range(steps):
        proposal = rotvec_to_matrix(scale[..., None] * newton_step(gradient, hessian, gauss_newton)) @ R
        new_cost, new_gradient, new_hessian, new_gauss_newton = derivatives(gram, proposal)
        better = (new_cost <= cost) & active
        active = active & (cost - new_cost > SETTLED * cost).any(-1, keepdim=True)
        R = torch.where(better[..., None, None], proposal, R)
        cost = torch.where(better, new_cost, cost)
        gradient = torch.where(better[..., None], new_gradient, gradient)
        hessian = torch.where(better[..., None, None], new_hessian, hessian)
        gauss_newton = torch.where(better[..., None, None], new_gauss_newton, gauss_newton)
        scale = torch.where(better, 1.0, 0.25 * scale)
        if not bool(active.any()):
            break
    return R, cost


def distinct_minima(R: Float[Tensor, "b g 3 3"], cost: Float[Tensor, "b g"], count: int) -> tuple[Tensor, Tensor]:
    """The `count` lowest minima that are not the same rotation: (rotations (b, count, 3, 3), costs; infinite where
    there are fewer)."""
    cost = cost.clone()
    rotations, costs = [], []
    for _ in range(count):
        best = cost.argmin(-1)
        chosen = R[torch.arange(R.shape[0], device=R.device), best]
        rotations.append(chosen)
        costs.append(cost.gather(1, best[:, None])[:, 0])
        cosine = 0.5 * ((R * chosen[:, None]).sum((-2, -1)) - 1.0)
        cost = torch.where(cosine > DISTINCT_COS, torch.inf, cost)
    return torch.stack(rotations, dim=1), torch.stack(costs, dim=1)


def search_rotations(gram: Float[Tensor, "b 9 9"], grid: int, minima: int) -> tuple[Tensor, Tensor]:
    """Distinct minima of vec(R)^T M vec(R) over SO(3), lowest first: (rotations (b, minima, 3, 3), costs (b,
    minima))."""
    rotations = rotation_grid(grid, gram)
    r = vec(rotations)
    scores = gram.flatten(1) @ (r[:, :, None] * r[:, None]).flatten(1).T  # (b, grid)
    kept = scores.topk(min(KEPT, grid), dim=-1, largest=False).indices
    R, cost = descend(gram, rotations[kept], DESCENT_STEPS)
    return distinct_minima(R, cost, minima)
