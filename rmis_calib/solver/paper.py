"""The published method, step by step, and the empirical covariance of it and of `global`.

Paper, Algorithm 1: each camera gives an estimate of its own of the same unknown (the left one through n_lr = R_Z^T n_l, Eq. 8), and the two
are averaged. Everything works on sums over motions (statistics.py).
"""

import torch
from jaxtyping import Float
from torch import Tensor

from rmis_calib.geometry.rotations import chordal_mean, matrix_to_quat, project_to_so3, quat_to_matrix
from rmis_calib.solver.initialise import solve_translation
from rmis_calib.solver.problem import Problem
from rmis_calib.solver.rotation_search import unvec, vec
from rmis_calib.solver.statistics import LineStatistics, plane_normals

QUATERNION_STEPS = 30
QUATERNION_TOLERANCE = 1e-12


def linear_rotation(gram: Float[Tensor, "b 9 9"]) -> Float[Tensor, "b 3 3"]:
    """Eqs. 10 to 13: smallest right singular vector, scaled by sign(det)/|det|^(1/3), then projected to SO(3).

    The smallest eigenvector of the Gram matrix is the smallest right singular vector of the stacked rows. The published scaling makes the
    determinant 1 but leaves the matrix short of orthogonal, hence the projection.
    """
    _, vectors = torch.linalg.eigh(gram)
    V = unvec(vectors[..., 0])
    det = torch.linalg.det(V)
    scaled = torch.where(det < 0, -1.0, 1.0)[..., None, None] * V / det.abs().clamp_min(1e-300).pow(1.0 / 3.0)[..., None, None]
    return project_to_so3(scaled)


def refine_quaternion(gram: Float[Tensor, "b 9 9"], R: Float[Tensor, "b 3 3"]) -> Float[Tensor, "b 3 3"]:
    """Eqs. 14 to 17: minimise sum (n.R(q) v)^2 over the unit quaternion, with autograd.

    The cost is divided by |q|^4, which makes it homogeneous of degree zero: its gradient is tangent to the sphere. Newton steps on autograd's gradient
    and Hessian, with q^T q added to the singular radial direction; a step that does not lower the cost is shortened.
    """

    def cost(q: Tensor, M: Tensor) -> Tensor:
        r = vec(quat_to_matrix(q / torch.linalg.vector_norm(q)))
        return r @ M @ r

    gradient_of = torch.func.vmap(torch.func.grad(cost))
    hessian_of = torch.func.vmap(torch.func.hessian(cost))
    cost_of = torch.func.vmap(cost)
    q = matrix_to_quat(R)
    value, scale = cost_of(q, gram), torch.ones_like(q[:, 0])
    eye = torch.eye(4, dtype=q.dtype, device=q.device)
    for _ in range(QUATERNION_STEPS):
        g, H = gradient_of(q, gram), hessian_of(q, gram)
        size = gram.diagonal(dim1=-2, dim2=-1).sum(-1)[:, None, None]
        radial = q[:, :, None] * q[:, None]
        values, vectors = torch.linalg.eigh(H + size * radial)
        curved = values.abs().clamp_min(1e-9 * size[..., 0])  # negative curvature: go down it
        step = -(vectors @ ((vectors.mT @ g[..., None]) / curved[..., None]))[..., 0]
        step = step - (step * q).sum(-1, keepdim=True) * q
        proposal = q + scale[:, None] * step.clamp(-0.5, 0.5) @ eye
        proposal = proposal / torch.linalg.vector_norm(proposal, dim=-1, keepdim=True)
        new = cost_of(proposal, gram)
        better = new <= value
        q, value = torch.where(better[:, None], proposal, q), torch.where(better, new, value)
        scale = torch.where(better, 1.0, 0.25 * scale)
        if bool((step.abs().amax(-1) * scale < QUATERNION_TOLERANCE).all()):
            break
    return quat_to_matrix(q)


def solve_paper(statistics: LineStatistics) -> tuple[Float[Tensor, "b c 3 3"], Float[Tensor, "b c 3"]]:
    """The estimate of each camera on its own (`camera_right_T_arm` both times)."""
    rotations, translations = [], []
    for camera in range(statistics.rotation_gram.shape[1]):
        one = statistics.camera(camera)
        gram = one.rotation_gram[:, 0]
        R = refine_quaternion(gram, linear_rotation(gram))
        rotations.append(R)
        translations.append(solve_translation(one, R[:, None])[0][:, 0])
    return torch.stack(rotations, dim=1), torch.stack(translations, dim=1)


def average(R: Float[Tensor, "b c 3 3"], t: Float[Tensor, "b c 3"]) -> tuple[Float[Tensor, "b 3 3"], Float[Tensor, "b 3"]]:
    """Last line of Algorithm 1: chordal mean of the rotations, mean of the translations."""
    return chordal_mean(R), t.mean(1)


def influence(
    problem: Problem, R: Float[Tensor, "b 3 3"], t: Float[Tensor, "b 3"], cameras: tuple[int, ...]
) -> Float[Tensor, "b n 6"]:
    """Each motion's share in the error of the two-step estimate (rotation, then translation) from these cameras.

    The estimate solves sum psi_1 = 0, psi_1 = (R v x n)(n.R v), and sum psi_2 = 0, psi_2 = n (n.(R p + t + o)). To first order the error is
    -A^-1 sum psi with A the block-triangular derivative: dphi = -H1^-1 sum psi_1, dt = -H2^-1 (sum psi_2 + B dphi). The empirical covariance is the sum of
    squared shares: it needs no noise model (White 1980).
    """
    n, _, ok = plane_normals(problem)
    n, known = n[:, list(cameras)], ok[:, list(cameras)].to(n.dtype)[..., None]
    arm_v = (problem.arm_T_rcm[..., :3, :3] @ problem.rcm_v_axis[..., None])[..., 0]
    v = (arm_v @ R.mT)[:, None].expand_as(n)
    turned = problem.arm_T_rcm[..., :3, 3] @ R.mT
    R_Z, t_Z = problem.camera_T_camera_right[:, list(cameras), :3, :3], problem.camera_T_camera_right[:, list(cameras), :3, 3]
    offset = (R_Z.mT @ t_Z[..., None])[..., 0][:, :, None]
    j = torch.linalg.cross(v, n) * known  # d(n.Rv)/dphi
    e1 = (n * v).sum(-1, keepdim=True)
    e2 = (n * (turned[:, None] + t[:, None, None] + offset)).sum(-1, keepdim=True)
    k = torch.linalg.cross(turned[:, None].expand_as(n), n)
    weighted = n * known
    H1, H2 = _outer(j, j), _outer(weighted, n)
    B = _outer(weighted, k)
    psi1, psi2 = (j * e1).sum(1), (weighted * e2).sum(1)
    eye = 1e-12 * torch.eye(3, dtype=n.dtype, device=n.device)
    phi = -torch.linalg.solve(H1 + eye * H1.diagonal(dim1=-2, dim2=-1).sum(-1)[:, None, None], psi1.mT).mT
    shift = -torch.linalg.solve(H2 + eye * H2.diagonal(dim1=-2, dim2=-1).sum(-1)[:, None, None], (psi2 + phi @ B.mT).mT).mT
    return torch.cat((phi, shift), dim=-1)


def _outer(a: Float[Tensor, "b c n 3"], b: Float[Tensor, "b c n 3"]) -> Float[Tensor, "b 3 3"]:
    """Sum of a b^T over cameras and motions."""
    return a.flatten(1, 2).mT @ b.flatten(1, 2)


def empirical_covariance(shares: Float[Tensor, "b n 6"]) -> Float[Tensor, "b 6 6"]:
    """Sum of the outer products of the shares, with the degrees of freedom of 6 parameters restored."""
    n = shares.shape[-2]
    return shares.mT @ shares * (n / max(n - 6, 1))
