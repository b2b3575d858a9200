"""The published method, step by step, and the empirical covariance of it and of `global`.

Paper, Algorithm 1: each camera gives an estimate of its own of the same unknown (the left one through n_lr = R_Z^T n_l,
Eq. 8), and the two are averaged. Everything works on sums over motions (line_statistics.py).
"""

import torch
from jaxtyping import Float
from torch import Tensor

from rmis_calib.geometry.rotations import chordal_mean, matrix_to_quat, project_to_so3, quat_to_matrix
from rmis_calib.solver.model.pose_refinement import refine
from rmis_calib.solver.problem import Problem
from rmis_calib.solver.start.candidates import solve_translation
from rmis_calib.solver.start.line_statistics import LineStatistics, plane_normals
from rmis_calib.solver.start.rotation_search import on_graph, unvec, vec

MIN_LINES = 8
"""Axis lines that a camera needs to vote: Eq. 10 has one solution, up to its scale, from the eighth line on."""
QUATERNION_STEPS = 60
MAX_TURN_RAD = 0.1
"""Steps stay below 6 degrees, as those of a line search do: the published refinement is a local one. Unbounded
Gauss-Newton steps leap from the wrong basin, into which the linear start falls at c = 0.5 already (164 degrees off), to
the right one in about nine of ten trials; that is luck, and `global` does it by search."""
QUATERNION_TOLERANCE = 1e-7
"""rad. Steps shrink quadratically near the minimum, so what is left after such a step is far smaller still."""


def linear_rotation(vectors: Float[Tensor, "b 9 9"]) -> Float[Tensor, "b 3 3"]:
    """Eqs. 10 to 13: smallest right singular vector, scaled by sign(det)/|det|^(1/3), then projected to SO(3).

    Args:
        vectors: eigenvectors of the Gram matrix as columns, that of the smallest eigenvalue first.

    The smallest eigenvector of the Gram matrix is the smallest right singular vector of the stacked rows. The published
    scaling makes the determinant 1 but leaves the matrix short of orthogonal, hence the projection.
    """
    V = unvec(vectors[..., 0])
    det = torch.linalg.det(V)
    scaled = (
        torch.where(det < 0, -1.0, 1.0)[..., None, None]
        * V
        / det.abs().clamp_min(1e-300).pow(1.0 / 3.0)[..., None, None]
    )
    return project_to_so3(scaled)


def refine_quaternion(
    values: Float[Tensor, "b 9"], vectors: Float[Tensor, "b 9 9"], R: Float[Tensor, "b 3 3"]
) -> Float[Tensor, "b 3 3"]:
    """Eqs. 14 to 17: minimise sum (n.R(q) v)^2 over the unit quaternion.

    With the Gram matrix as F^T F the sum is |F vec(R)|^2: nine residuals, whatever the number of motions.

    Args:
        values: eigenvalues of the Gram matrix.
        vectors: its eigenvectors as columns.
        R: where to start.
    """
    factor = values.clamp_min(0.0).sqrt()[..., None] * vectors.mT

    def residual(q: Float[Tensor, "*k b 4"], _: Tensor) -> Float[Tensor, "*k b 9"]:
        return (factor @ vec(quat_to_matrix(q))[..., None])[..., 0]

    found = refine(
        residual,
        matrix_to_quat(R),
        R.new_zeros((*R.shape[:-2], 3)),
        free="rotation",
        max_iterations=QUATERNION_STEPS,
        tolerance=QUATERNION_TOLERANCE,
        max_turn_rad=MAX_TURN_RAD,
    )
    return quat_to_matrix(found.quaternion)


def solve_paper(statistics: LineStatistics) -> tuple[Float[Tensor, "b c 3 3"], Float[Tensor, "b c 3"]]:
    """The estimate of each camera on its own (`camera_right_T_arm` both times)."""
    gram = statistics.rotation_gram.flatten(0, 1)
    with torch.no_grad():
        values, vectors = torch.linalg.eigh(gram)
        R = refine_quaternion(values, vectors, linear_rotation(vectors))
    R = (on_graph(gram, R) if gram.requires_grad else R).unflatten(0, statistics.rotation_gram.shape[:2])
    t, _ = solve_translation(statistics.apart(), R.flatten(0, 1)[:, None])
    return R, t[:, 0].unflatten(0, R.shape[:2])


def votes(count: Float[Tensor, "b c"]) -> Float[Tensor, "b c"]:
    """Weight of each camera in the average; the weights of a trial add up to 1.

    A camera with fewer than MIN_LINES lines does not vote, since its estimate is any of many solutions. Where no
    camera has as many, the one with most lines answers alone.
    """
    able = (count >= MIN_LINES).to(count.dtype)
    most = torch.nn.functional.one_hot(count.argmax(-1), count.shape[-1]).to(count.dtype)
    weight = torch.where(able.any(-1, keepdim=True), able, most)
    return weight / weight.sum(-1, keepdim=True)


def average(
    R: Float[Tensor, "b c 3 3"], t: Float[Tensor, "b c 3"], weight: Float[Tensor, "b c"]
) -> tuple[Float[Tensor, "b 3 3"], Float[Tensor, "b 3"]]:
    """Last line of Algorithm 1, over the cameras that vote: chordal mean of the rotations, mean of the translations."""
    R = torch.where(weight[..., None, None] > 0, R, 0.0)  # an estimate from no line at all may be NaN
    return chordal_mean(R, weight), (weight[..., None] * torch.where(weight[..., None] > 0, t, 0.0)).sum(1)


def influence(
    problem: Problem,
    R: Float[Tensor, "b c 3 3"],
    t: Float[Tensor, "b c 3"],
    weight: Float[Tensor, "b c"] | None = None,
) -> Float[Tensor, "b n 6"]:
    """Each motion's share in the error of the two-step estimate (rotation, then translation).

    With one R and t a camera (c > 1), each camera's own estimate from its own lines, and the mean of their shares by
    `weight` (of `votes`); with c = 1, one estimate from the lines of all cameras.

    The estimate solves sum psi_1 = 0, psi_1 = (R v x n)(n.R v), and sum psi_2 = 0, psi_2 = n (n.(R p + t + o)). To
    first order the error is -A^-1 sum psi with A the block-triangular derivative: dphi = -H1^-1 sum psi_1, dt = -H2^-1
    (sum psi_2 + B dphi). The empirical covariance is the sum of squared shares: it needs no noise model (White 1980).
    """
    b, estimates = R.shape[:2]
    n, _, ok = plane_normals(problem)
    R_Z, t_Z = problem.camera_T_camera_right[..., :3, :3], problem.camera_T_camera_right[..., :3, 3]
    offset = (R_Z.mT @ t_Z[..., None])[..., 0]
    arm_v = (problem.arm_T_rcm[..., :3, :3] @ problem.rcm_v_axis[..., None])[..., 0]
    v, turned = ((x[:, None] @ R.mT).flatten(0, 1)[:, None] for x in (arm_v, problem.arm_T_rcm[..., :3, 3]))
    # Estimates of each camera become trials of one camera; (b e, c / e, n, 3) from here.
    n, ok, offset = (x.reshape(b * estimates, -1, *x.shape[2:]) for x in (n, ok, offset))
    known = ok.to(n.dtype)[..., None]
    j = torch.linalg.cross(v.expand_as(n), n) * known  # d(n.Rv)/dphi
    e1 = (n * v).sum(-1, keepdim=True)
    e2 = (n * (turned + t.flatten(0, 1)[:, None, None] + offset[:, :, None])).sum(-1, keepdim=True)
    k = torch.linalg.cross(turned.expand_as(n), n)
    weighted = n * known
    H1, H2 = _outer(j, j), _outer(weighted, n)
    B = _outer(weighted, k)
    psi1, psi2 = (j * e1).sum(1), (weighted * e2).sum(1)
    eye = 1e-12 * torch.eye(3, dtype=n.dtype, device=n.device)
    phi = -torch.linalg.solve(H1 + eye * H1.diagonal(dim1=-2, dim2=-1).sum(-1)[:, None, None], psi1.mT).mT
    shift = -torch.linalg.solve(
        H2 + eye * H2.diagonal(dim1=-2, dim2=-1).sum(-1)[:, None, None], (psi2 + phi @ B.mT).mT
    ).mT
    shares = torch.cat((phi, shift), dim=-1).unflatten(0, (b, estimates))
    if weight is None:
        return shares.mean(1)
    weight = weight[..., None, None]
    return (weight * torch.where(weight > 0, shares, 0.0)).sum(1)


def _outer(a: Float[Tensor, "b c n 3"], b: Float[Tensor, "b c n 3"]) -> Float[Tensor, "b 3 3"]:
    """Sum of a b^T over cameras and motions."""
    return a.flatten(1, 2).mT @ b.flatten(1, 2)


def empirical_covariance(shares: Float[Tensor, "b n 6"]) -> Float[Tensor, "b 6 6"]:
    """Sum of the outer products of the shares, with the degrees of freedom of 6 parameters restored."""
    n = shares.shape[-2]
    return shares.mT @ shares * (n / max(n - 6, 1))
