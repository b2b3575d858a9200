"""Rotations as matrices, unit quaternions (w, x, y, z) and rotation vectors (rad).

Values and gradients are finite at every rotation, angles 0 and pi included: where a closed form divides by an angle,
its series is taken below `_SMALL_SQUARED`, and the branch not taken is fed a harmless number so that no NaN enters
its gradient.
"""

from collections.abc import Sequence

import torch
from jaxtyping import Float
from torch import Tensor

# The series below keep terms up to angle^2, so they err by less than angle^4 / 1920 = 5e-20 where angle^2 < 1e-8:
# below the rounding of float64. The closed forms are still accurate there, so the switch itself is invisible.
_SMALL_SQUARED = 1e-8


def skew(v: Float[Tensor, "*batch 3"]) -> Float[Tensor, "*batch 3 3"]:
    """Matrix of the cross product: `skew(a) @ b == cross(a, b)`."""
    x, y, z = v.unbind(-1)
    zero = torch.zeros_like(x)
    return torch.stack([zero, -z, y, z, zero, -x, -y, x, zero], dim=-1).unflatten(-1, (3, 3))


def rotvec_to_matrix(rotvec: Float[Tensor, "*batch 3"]) -> Float[Tensor, "*batch 3 3"]:
    """Rotation by `|rotvec|` rad about `rotvec`, right-handed (Rodrigues).

    Args:
        rotvec: axis times angle, rad; any length, also 0.
    """
    squared = (rotvec * rotvec).sum(-1)
    small = squared < _SMALL_SQUARED
    angle = torch.where(small, 1.0, squared).sqrt()
    half = 0.5 * angle
    sin_over_angle = torch.where(small, 1 - squared / 6, angle.sin() / angle)
    # (1 - cos a) / a^2 written with the half angle: no cancellation for small a.
    versine_over_squared = torch.where(small, 0.5 - squared / 24, 0.5 * (half.sin() / half) ** 2)
    k = skew(rotvec)
    eye = torch.eye(3, dtype=rotvec.dtype, device=rotvec.device)
    return eye + sin_over_angle[..., None, None] * k + versine_over_squared[..., None, None] * (k @ k)


def rotvec_to_quat(rotvec: Float[Tensor, "*batch 3"]) -> Float[Tensor, "*batch 4"]:
    """Unit quaternion (w, x, y, z) of a rotation vector in rad."""
    squared = (rotvec * rotvec).sum(-1, keepdim=True)
    small = squared < _SMALL_SQUARED
    angle = torch.where(small, 1.0, squared).sqrt()
    w = torch.where(small, 1 - squared / 8, (0.5 * angle).cos())
    scale = torch.where(small, 0.5 - squared / 48, (0.5 * angle).sin() / angle)
    return torch.cat([w, scale * rotvec], dim=-1)


def quat_to_rotvec(quat: Float[Tensor, "*batch 4"]) -> Float[Tensor, "*batch 3"]:
    """Rotation vector of length at most pi, rad.

    Args:
        quat: (w, x, y, z), not zero; its length and its sign do not matter.
    """
    quat = torch.where(quat[..., :1] < 0, -quat, quat)
    w, xyz = quat[..., :1], quat[..., 1:]
    squared = (xyz * xyz).sum(-1, keepdim=True)
    small = squared < _SMALL_SQUARED * w * w
    norm = torch.where(small, 1.0, squared).sqrt()
    safe_w = torch.where(small, w, 1.0)
    series = 2 / safe_w - 2 * squared / (3 * safe_w**3)
    return xyz * torch.where(small, series, 2 * torch.atan2(norm, w) / norm)


def quat_to_matrix(quat: Float[Tensor, "*batch 4"]) -> Float[Tensor, "*batch 3 3"]:
    """Rotation matrix of a quaternion (w, x, y, z), not zero; its length does not matter."""
    q = quat / quat.norm(dim=-1, keepdim=True)
    w, x, y, z = q.unbind(-1)
    x2, y2, z2 = (q + q)[..., 1:].unbind(-1)  # not 2 * q: torch has no forward-mode rule for that, only a slow detour
    rows = [
        *(1 - (y * y2 + z * z2), x * y2 - w * z2, x * z2 + w * y2),
        *(x * y2 + w * z2, 1 - (x * x2 + z * z2), y * z2 - w * x2),
        *(x * z2 - w * y2, y * z2 + w * x2, 1 - (x * x2 + y * y2)),
    ]
    return torch.stack(rows, dim=-1).unflatten(-1, (3, 3))


def matrix_to_quat(R: Float[Tensor, "*batch 3 3"]) -> Float[Tensor, "*batch 4"]:
    """Unit quaternion (w, x, y, z) with w >= 0.

    The outer product 4 q q^T is linear in R. Its row with the largest diagonal is q times a number of at least 2, so
    normalising that row is accurate and has a finite gradient at every rotation, angle pi included.
    """
    (r00, r01, r02), (r10, r11, r12), (r20, r21, r22) = (row.unbind(-1) for row in R.unbind(-2))
    wx, wy, wz = r21 - r12, r02 - r20, r10 - r01
    xy, xz, yz = r10 + r01, r02 + r20, r21 + r12
    ww, xx = 1 + r00 + r11 + r22, 1 + r00 - r11 - r22
    yy, zz = 1 - r00 + r11 - r22, 1 - r00 - r11 + r22
    outer = torch.stack([ww, wx, wy, wz, wx, xx, xy, xz, wy, xy, yy, yz, wz, xz, yz, zz], dim=-1).unflatten(-1, (4, 4))
    largest = outer.diagonal(dim1=-2, dim2=-1).argmax(-1)
    row = torch.take_along_dim(outer, largest[..., None, None], dim=-2).squeeze(-2)
    row = torch.where(row[..., :1] < 0, -row, row)
    return row / row.norm(dim=-1, keepdim=True)


def matrix_to_rotvec(R: Float[Tensor, "*batch 3 3"]) -> Float[Tensor, "*batch 3"]:
    """Rotation vector of length at most pi, rad; at exactly pi, one of the two."""
    return quat_to_rotvec(matrix_to_quat(R))


def quat_multiply(left: Float[Tensor, "*#batch 4"], right: Float[Tensor, "*#batch 4"]) -> Float[Tensor, "*#batch 4"]:
    """Hamilton product: the rotation `right` first, then `left`, as in `R_left @ R_right`."""
    aw, ax, ay, az = left.unbind(-1)
    bw, bx, by, bz = right.unbind(-1)
    product = [
        aw * bw - ax * bx - ay * by - az * bz,
        aw * bx + ax * bw + ay * bz - az * by,
        aw * by - ax * bz + ay * bw + az * bx,
        aw * bz + ax * by - ay * bx + az * bw,
    ]
    return torch.stack(product, dim=-1)


def quat_conjugate(quat: Float[Tensor, "*batch 4"]) -> Float[Tensor, "*batch 4"]:
    """Inverse of a unit quaternion."""
    return torch.cat([quat[..., :1], -quat[..., 1:]], dim=-1)


def rotation_angle(R: Float[Tensor, "*batch 3 3"]) -> Float[Tensor, "*batch"]:
    """Angle in [0, pi], rad, accurate near both ends (an arc cosine of the trace loses half of the digits there).

    Its gradient at exactly 0 and exactly pi, where the angle has a kink, is 0.
    """
    quat = matrix_to_quat(R)
    squared = (quat[..., 1:] ** 2).sum(-1)
    zero = squared == 0
    norm = torch.where(zero, 0.0, torch.where(zero, 1.0, squared).sqrt())
    return 2 * torch.atan2(norm, quat[..., 0].abs())


def project_to_so3(M: Float[Tensor, "*batch 3 3"]) -> Float[Tensor, "*batch 3 3"]:
    """The rotation nearest to M in the Frobenius norm.

    The derivative (first order) is that of the projection itself, which divides by sums of singular values. The
    derivative of the decomposition, which autograd would take, divides by their differences and is infinite where M
    is a rotation.
    """
    with torch.no_grad():
        U, S, Vh = torch.linalg.svd(M)
        sign = torch.sign(torch.linalg.det(U @ Vh))
        flip = torch.stack([torch.ones_like(sign), torch.ones_like(sign), sign], dim=-1)
        R = (U * flip[..., None, :]) @ Vh
        S = S * flip
        sums = S[..., :, None] + S[..., None, :]
        # A vanishing sum means that the nearest rotation is not unique: no derivative there, 0 instead of infinity.
        tiny = torch.finfo(M.dtype).eps * S[..., :1, None]
        inverse_sums = torch.where(sums > tiny, 1 / torch.where(sums > tiny, sums, 1.0), 0.0)
    if not M.requires_grad:
        return R
    # d R = R W with W skew and W P + P W = R^T dM - dM^T R, P the polar factor (Higham 2008, section 8.1).
    change = R.mT @ M
    change = change - change.mT
    W = Vh.mT @ ((Vh @ change @ Vh.mT) * inverse_sums) @ Vh
    return R + R @ (W - W.detach())


def chordal_mean(
    R: Float[Tensor, "*batch n 3 3"], weights: Float[Tensor, "*#batch n"] | None = None
) -> Float[Tensor, "*batch 3 3"]:
    """Rotation with the least weighted sum of squared Frobenius distances to those given.

    Args:
        R: rotations to average over the axis before the last two.
        weights: not negative, any scale; equal when absent.
    """
    if weights is not None:
        R = R * weights[..., None, None]
    return project_to_so3(R.sum(-3))


def random_quat(
    shape: Sequence[int],
    generator: torch.Generator | None = None,
    dtype: torch.dtype = torch.float64,
    device: torch.device | str = "cpu",
) -> Float[Tensor, "..."]:
    """Unit quaternions of shape (*shape, 4), uniform over rotations.

    Args:
        shape: leading shape; () gives one quaternion.
        generator: on `device`; torch's global one when absent.
        dtype: of the result.
        device: of the result.
    """
    quat = torch.randn((*shape, 4), generator=generator, dtype=dtype, device=device)
    return quat / quat.norm(dim=-1, keepdim=True)
