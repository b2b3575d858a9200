"""Robot-world and hand-eye at once: A X = Z B with A = anchor_T_mount, B = board_T_camera, X and Z both unknown."""

import torch
from jaxtyping import Float
from torch import Tensor

from rmis_calib.baselines.linalg import extreme_eigenvectors, nearest_rotation, solve_symmetric
from rmis_calib.baselines.motions import Samples, kronecker_sum
from rmis_calib.geometry import rigid_from_rotation_translation, rigid_inverse

Transforms = tuple[Float[Tensor, "*batch 4 4"], Float[Tensor, "*batch 4 4"]]
"""mount_T_camera, anchor_T_board."""


def shah(samples: Samples) -> Transforms:
    """Rotations from the first singular pair of the Kronecker product summed over samples, then both translations.

    Source: Shah (2013), ASME J. Mechanisms and Robotics 5(3).
    """
    A, board_T_camera = samples.anchor_T_mount, rigid_inverse(samples.camera_T_board)
    product = kronecker_sum(A[..., :3, :3], board_T_camera[..., :3, :3].mT)  # takes X to sum R_A X R_B^T, which is N Z
    right = extreme_eigenvectors(product.mT @ product, 1, largest=True)
    X, Z = (entries[..., 0].unflatten(-1, (3, 3)) for entries in (right, product @ right))
    sign = torch.linalg.det(X).sign()[..., None, None]
    RX, RZ = nearest_rotation(X * sign), nearest_rotation(Z * sign)
    # R_A t_X - t_Z = R_Z t_B - t_A: t_Z is the mean, so what is left is about the means.
    RA, rhs = A[..., :3, :3], board_T_camera[..., :3, 3] @ RZ.mT - A[..., :3, 3]
    centred, centred_rhs = RA - RA.mean(-3, keepdim=True), rhs - rhs.mean(-2, keepdim=True)
    normal = (centred.mT @ centred).mean(-3)
    tX = solve_symmetric(normal, (centred.mT @ centred_rhs[..., None])[..., 0].mean(-2))
    tZ = (RA.mean(-3) @ tX[..., None])[..., 0] - rhs.mean(-2)
    return rigid_from_rotation_translation(RX, tX), rigid_from_rotation_translation(RZ, tZ)


def li(samples: Samples) -> Transforms:
    """One linear least-squares problem in all 24 entries of X and Z, whose rotations are then made rotations.

    Lengths are divided by the size of the motion, so that the result does not depend on the unit.

    Source: Li, Wang, Wu (2010), Int. J. Physical Sciences 5(10) (Kronecker product).
    """
    A, board_T_camera = samples.anchor_T_mount, rigid_inverse(samples.camera_T_board)
    length = _travel(A[..., :3, 3], board_T_camera[..., :3, 3])[..., None, None]
    RA, RB = A[..., :3, :3], board_T_camera[..., :3, :3]
    tA, tB = A[..., :3, 3] / length, board_T_camera[..., :3, 3] / length
    eye = torch.eye(3, dtype=A.dtype, device=A.device)
    zeros = A.new_zeros(*A.shape[:-2], 9, 3)
    # Entries row by row: (R_A X)_rc = R_A[r, k] X[k, c], and (Z R_B)_rc = Z[r, l] R_B[l, c].
    of_X = torch.einsum("...rk,cl->...rckl", RA, eye).flatten(-2).flatten(-3, -2)
    of_Z = torch.einsum("rk,...lc->...rckl", eye, RB).flatten(-2).flatten(-3, -2)
    turning = torch.cat([of_X, -of_Z, zeros, zeros], dim=-1)
    moved = torch.einsum("rk,...l->...rkl", eye, tB).flatten(-2)
    shifting = torch.cat([torch.zeros_like(moved), moved, -RA, eye.expand_as(RA)], dim=-1)
    rows = torch.cat([turning, shifting], dim=-2).flatten(-3, -2)
    rhs = torch.cat([A.new_zeros(*tA.shape[:-1], 9), tA], dim=-1).flatten(-2)
    Q, R = torch.linalg.qr(rows)
    entries = torch.linalg.solve_ex(R, Q.mT @ rhs[..., None]).result[..., 0]
    X, Z = entries[..., :9].unflatten(-1, (3, 3)), entries[..., 9:18].unflatten(-1, (3, 3))
    tX, tZ = entries[..., 18:21] * length[..., 0], entries[..., 21:] * length[..., 0]
    return (
        rigid_from_rotation_translation(nearest_rotation(X), tX),
        rigid_from_rotation_translation(nearest_rotation(Z), tZ),
    )


def _travel(*shifts: Float[Tensor, "*batch n 3"]) -> Float[Tensor, "*batch"]:
    """Root mean square distance from the mean position, mm; 1 where nothing moves."""
    square = torch.stack([(t - t.mean(-2, keepdim=True)).square().sum(-1).mean(-1) for t in shifts]).sum(0)
    return torch.where(square > 0, square, 1.0).sqrt()
