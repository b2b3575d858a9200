"""Closed-form solutions of A X = X B: the rotation first, then the translation (dual quaternions: both at once).

The rotations need only sums of products over all motions.
"""

import torch
from jaxtyping import Float
from torch import Tensor

from rmis_calib.baselines.linalg import extreme_eigenvectors, solve_symmetric
from rmis_calib.baselines.motions import Motions, kronecker_sum, rotate_by_quat, rotation_vectors
from rmis_calib.geometry import (
    project_to_so3,
    quat_conjugate,
    quat_multiply,
    quat_to_matrix,
    rigid_from_rotation_translation,
    skew,
)


def tsai(motions: Motions) -> Float[Tensor, "*batch 4 4"]:
    """Modified Rodrigues vectors.

    With P = 2 sin(angle / 2) axis of each motion, skew(P_A + P_B) P' = P_B - P_A and X turns by 2 atan |P'| about P'.
    P' is infinite where X is a half turn. The system is therefore also set up with the camera frame turned by half
    about each of its axes, and the best conditioned of the four is solved.

    Source: Tsai, Lenz (1989), IEEE Trans. Robotics and Automation 5(3); the turned frames are the sequential rotations
    of Shuster, Oh (1981).
    """
    turns = torch.eye(4, dtype=motions.qa.dtype, device=motions.qa.device)  # unit, and half turns about x, y, z
    a = motions.qa[..., None, :, 1:]
    b = motions.qb[..., None, :, 1:] * (2 * turns[:, None, 1:] ** 2 - 1 + 2 * turns[:, None, :1])
    s = a + b
    square = (s * s).sum((-2, -1))[..., None, None] * turns[1:, 1:] - s.mT @ s
    rodrigues = solve_symmetric(square, -2 * torch.linalg.cross(a, b).sum(-2))
    quats = quat_multiply(torch.cat([torch.ones_like(rodrigues[..., :1]), rodrigues], dim=-1), turns)
    best = torch.linalg.det(square.detach()).argmax(-1)[..., None, None]
    q = torch.take_along_dim(quats, best, dim=-2)[..., 0, :]
    return with_translation(motions, quat_to_matrix(q))


def park(motions: Motions) -> Float[Tensor, "*batch 4 4"]:
    """Least squares on log R_A = R_X log R_B: the polar factor of sum (log R_A)(log R_B)^T.

    Source: Park, Martin (1994), IEEE Trans. Robotics and Automation 10(5).
    """
    profile = rotation_vectors(motions.qa).mT @ rotation_vectors(motions.qb)
    return with_translation(motions, project_to_so3(profile))


def horaud(motions: Motions) -> Float[Tensor, "*batch 4 4"]:
    """Least squares on q_A q_X = q_X q_B over unit quaternions.

    The solution is the eigenvector of sum (Q(q_A) - W(q_B))^T (Q(q_A) - W(q_B)) with the smallest eigenvalue. The
    scalar parts only add a multiple of the identity, so it is the rotation that best takes the vector parts of q_B to
    those of q_A, which the polar factor gives directly.

    Source: Horaud, Dornaika (1995), Int. J. Robotics Research 14(3); in this form Chou, Kamel (1991).
    """
    profile = motions.qa[..., 1:].mT @ motions.qb[..., 1:]
    return with_translation(motions, project_to_so3(profile))


def andreff(motions: Motions) -> Float[Tensor, "*batch 4 4"]:
    """Null vector of the linear system R_A X - X R_B = 0 in the nine entries of X, made a rotation.

    Source: Andreff, Horaud, Espiau (2001), Int. J. Robotics Research 20(3): rotation first, then translation.
    """
    # ||R_A X - X R_B||^2 = 2 ||X||^2 - 2 <X, R_A X R_B^T>: the null vector is the product's largest eigenvector.
    product = kronecker_sum(quat_to_matrix(motions.qa), quat_to_matrix(quat_conjugate(motions.qb)))
    entries = extreme_eigenvectors(product + product.mT, 1, largest=True)[..., 0].unflatten(-1, (3, 3))
    sign = torch.linalg.det(entries).sign()[..., None, None]
    return with_translation(motions, project_to_so3(entries * sign))


def with_translation(motions: Motions, R: Float[Tensor, "*batch 3 3"]) -> Float[Tensor, "*batch 4 4"]:
    """X of a rotation, with the least-squares translation."""
    return rigid_from_rotation_translation(R, translation(motions, R))


def translation(motions: Motions, R: Float[Tensor, "*batch 3 3"]) -> Float[Tensor, "*batch 3"]:
    """Least squares on (R_A - I) t = R t_B - t_A over all motions and their inverses, mm.

    With noise, a motion and its inverse give different equations. Using both makes the result independent of the order
    of the samples. R may be any matrix; the result is linear in it.
    """
    return solve_symmetric(*translation_system(motions, R))


def translation_system(
    motions: Motions, R: Float[Tensor, "*batch 3 3"]
) -> tuple[Float[Tensor, "*batch 3 3"], Float[Tensor, "*batch 3"]]:
    """Normal equations of `translation`, over the number of equations."""
    RA = quat_to_matrix(motions.qa)
    eye = torch.eye(3, dtype=R.dtype, device=R.device)
    mean = RA.mean(-3)
    back_ta = -rotate_by_quat(quat_conjugate(motions.qa), motions.ta)
    back_tb = -rotate_by_quat(quat_conjugate(motions.qb), motions.tb)
    forth = motions.tb @ R.mT - motions.ta
    back = back_tb @ R.mT - back_ta
    # (R_A - I)^T applied to the right-hand sides of both senses.
    rhs = (RA.mT @ forth[..., None] + RA @ back[..., None])[..., 0] - forth - back
    return 2 * (2 * eye - mean - mean.mT), rhs.mean(-2)


def daniilidis(motions: Motions) -> Float[Tensor, "*batch 4 4"]:
    """Dual quaternions: rotation and translation at once, from the two least singular vectors of the 6M x 8 system.

    Lengths are divided by the size of the motions' translations, so that the result does not depend on the unit.

    Source: Daniilidis (1999), Int. J. Robotics Research 18(3).
    """
    length = motions.length()[..., None]
    a, a_dual = motions.qa, _dual_part(motions.qa, motions.ta / length[..., None])
    b, b_dual = motions.qb, _dual_part(motions.qb, motions.tb / length[..., None])
    real, dual = _difference_rows(a, b), _difference_rows(a_dual, b_dual)
    rows = torch.cat([torch.cat([real, torch.zeros_like(real)], -1), torch.cat([dual, real], -1)], -2).flatten(-3, -2)
    basis = extreme_eigenvectors(rows.mT @ rows, 2)
    # q = c1 u1 + c2 u2 with <q, q'> = 0 and |q| = 1: the isotropic directions of a 2x2 form.
    u, v = basis[..., :4, :], basis[..., 4:, :]
    form, gram = u.mT @ v, u.mT @ u
    q, q_dual = (part @ _on_study_quadric(form + form.mT, gram)[..., None] for part in (u, v))
    q, q_dual = q[..., 0], q_dual[..., 0]
    t = 2 * quat_multiply(q_dual, quat_conjugate(q))[..., 1:] / (q * q).sum(-1, keepdim=True)
    return rigid_from_rotation_translation(quat_to_matrix(q), t * length)


def _dual_part(q: Float[Tensor, "*batch 4"], t: Float[Tensor, "*batch 3"]) -> Float[Tensor, "*batch 4"]:
    return 0.5 * quat_multiply(torch.cat([torch.zeros_like(t[..., :1]), t], dim=-1), q)


def _difference_rows(a: Float[Tensor, "*batch 4"], b: Float[Tensor, "*batch 4"]) -> Float[Tensor, "*batch 3 4"]:
    """Vector part of a q - q b, as a matrix for q."""
    a, b = a[..., 1:], b[..., 1:]
    return torch.cat([(a - b)[..., None], skew(a + b)], dim=-1)


def _on_study_quadric(
    form: Float[Tensor, "*batch 2 2"], gram: Float[Tensor, "*batch 2 2"]
) -> Float[Tensor, "*batch 2"]:
    """c with c^T form c = 0 and c^T gram c = 1; of the two the one with the larger real part, as published."""
    a, b, c = form[..., 0, 0], form[..., 0, 1], form[..., 1, 1]
    root = (b * b - a * c).clamp_min(0).sqrt()
    # a s^2 + 2 b s + c = 0 for c1 / c2 = s, written so that neither root loses digits.
    sum_ = b + torch.where(b < 0, -root, root)
    directions = torch.stack([torch.stack([-sum_, a], -1), torch.stack([-c, sum_], -1)], -2)
    directions = directions / directions.norm(dim=-1, keepdim=True).clamp_min(1e-300)
    size = torch.einsum("...ki,...ij,...kj->...k", directions, gram, directions)
    best = size.detach().argmax(-1)[..., None]
    chosen = torch.take_along_dim(directions, best[..., None], dim=-2)[..., 0, :]
    return chosen / torch.take_along_dim(size, best, dim=-1).sqrt()
