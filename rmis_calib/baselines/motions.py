"""Poses in pairs: what moved between every two samples, as the robot and as the camera see it.

Names. The camera is carried by the frame `mount`, the board by the frame `anchor`: flange and base where the camera is
in the hand, base and flange where it watches the hand. So one equation serves both:
`anchor_T_mount @ mount_T_camera @ camera_T_board = anchor_T_board`, and for two samples A X = X B with
A = mount_T_mount' of the robot, B = camera_T_camera' seen by the board, X = mount_T_camera.
"""

from dataclasses import dataclass

import torch
from jaxtyping import Float, Int
from torch import Tensor

from rmis_calib.baselines.linalg import extreme_eigenvectors
from rmis_calib.geometry import matrix_to_quat, project_to_so3, quat_conjugate, quat_multiply, rigid_inverse

# Below this square of the angle the series of `screw_translation` is exact to the rounding of float64.
_SMALL_SQUARED = 1e-6


@dataclass(frozen=True, eq=False)
class Samples:
    """Pairs of poses, mm; samples of a second camera follow those of the first, already in the first one's frame.

    Attributes:
        anchor_T_mount: of the robot.
        camera_T_board: of the board.
        cameras: number of cameras; samples i and i + N / cameras have the robot pose in common.
    """

    anchor_T_mount: Float[Tensor, "*batch n 4 4"]
    camera_T_board: Float[Tensor, "*batch n 4 4"]
    cameras: int = 1

    def __len__(self) -> int:
        return self.anchor_T_mount.shape[-3]


@dataclass(frozen=True, eq=False)
class Motions:
    """Relative motions between all pairs of samples, each pair once; its inverse is implied.

    The quaternions of a pair have one sense: the rotation angles that belong to them agree, also about half a turn.

    Attributes:
        qa, ta: of the robot, unit quaternion (w, x, y, z) and translation, mm.
        qb, tb: of the camera.
    """

    qa: Float[Tensor, "*batch p 4"]
    ta: Float[Tensor, "*batch p 3"]
    qb: Float[Tensor, "*batch p 4"]
    tb: Float[Tensor, "*batch p 3"]

    def swapped(self) -> "Motions":
        """Camera first: the motions of the equation for X^-1."""
        return Motions(self.qb, self.tb, self.qa, self.ta)

    def length(self) -> Float[Tensor, "*batch"]:
        """Size of the translations, root mean square, mm: makes equations that mix lengths and angles free of units."""
        square = ((self.ta**2).sum(-1) + (self.tb**2).sum(-1)).mean(-1)
        return torch.where(square > 0, square, 1.0).sqrt()


def pair_indices(n: int, cameras: int, device: torch.device) -> tuple[Int[Tensor, " p"], Int[Tensor, " p"]]:
    """All pairs i < j of samples, without those of two cameras at one robot pose."""
    i, j = torch.triu_indices(n, n, 1, device=device)
    moved = (j - i) % (n // cameras) != 0
    return i[moved], j[moved]


def relative_motions(samples: Samples) -> Motions:
    """Motions between all pairs of samples."""
    mount_T_anchor, camera_T_board = rigid_inverse(samples.anchor_T_mount), samples.camera_T_board
    i, j = pair_indices(len(samples), samples.cameras, camera_T_board.device)
    qa, ta = _between(mount_T_anchor, i, j)
    qb, tb = _between(camera_T_board, i, j)
    qa = torch.where(qa[..., :1] < 0, -qa, qa)
    with torch.no_grad():
        # <qa q, q qb> is positive for the sense of qb that belongs to qa.
        X = _kronecker_rotation(samples)
        vector = (qa[..., 1:] * (X[..., None, :, :] @ qb[..., 1:, None])[..., 0]).sum(-1, keepdim=True)
        sense = torch.where(qa[..., :1] * qb[..., :1] + vector < 0, -1.0, 1.0).to(qb.dtype)
    return Motions(qa, ta, qb * sense, tb)


def _between(a_T_b: Float[Tensor, "*batch n 4 4"], i: Tensor, j: Tensor) -> tuple[Tensor, Tensor]:
    """a_T_b(i) @ b_T_a(j) as quaternions and translations."""
    quats, shifts = matrix_to_quat(a_T_b[..., :3, :3]), a_T_b[..., :3, 3]
    q = quat_multiply(quats[..., i, :], quat_conjugate(quats[..., j, :]))
    return q, shifts[..., i, :] - rotate_by_quat(q, shifts[..., j, :])


def _kronecker_rotation(samples: Samples) -> Float[Tensor, "*batch 3 3"]:
    """Rotation of X from R_A R_X R_B = R_Z over all samples, linear in X and blind to the sense of quaternions."""
    product = kronecker_sum(samples.anchor_T_mount[..., :3, :3], samples.camera_T_board[..., :3, :3])
    vector = extreme_eigenvectors(product.mT @ product, 1, largest=True)[..., 0].unflatten(-1, (3, 3))
    return project_to_so3(vector * torch.linalg.det(vector).sign()[..., None, None])


def kronecker_sum(
    left: Float[Tensor, "*batch n 3 3"], right: Float[Tensor, "*batch n 3 3"]
) -> Float[Tensor, "*batch 9 9"]:
    """The matrix that takes the nine entries of X, row by row, to those of sum_i left_i X right_i."""
    product = left.flatten(-2).mT @ right.flatten(-2)  # (r, c) of left against (r, c) of right
    return product.unflatten(-1, (3, 3)).unflatten(-3, (3, 3)).movedim(-1, -3).flatten(-4, -3).flatten(-2)


def rotate_by_quat(q: Float[Tensor, "*#batch 4"], v: Float[Tensor, "*#batch 3"]) -> Float[Tensor, "*#batch 3"]:
    """R(q) v for unit quaternions, without the matrix."""
    xyz = q[..., 1:]
    twice = 2 * torch.linalg.cross(xyz, v)
    return v + q[..., :1] * twice + torch.linalg.cross(xyz, twice)


def rotation_vectors(q: Float[Tensor, "*batch 4"]) -> Float[Tensor, "*batch 3"]:
    """Axis times angle, rad, of quaternions whose sign is meant: w < 0 is an angle beyond half a turn."""
    w, xyz = q[..., :1], q[..., 1:]
    squared = (xyz * xyz).sum(-1, keepdim=True)
    small = squared < 1e-8
    norm = torch.where(small, 1.0, squared).sqrt()
    return xyz * torch.where(small & (w > 0), 2 + squared / 3, 2 * torch.atan2(norm, w) / norm)


def screw_translation(q: Float[Tensor, "*batch 4"], t: Float[Tensor, "*batch 3"]) -> Float[Tensor, "*batch 3"]:
    """v of the twist (omega, v) whose exponential is the motion: v = (I - [omega]/2 + c [omega]^2) t.

    Source: Murray, Li, Sastry (1994), A Mathematical Introduction to Robotic Manipulation, section 2.3.
    """
    omega = rotation_vectors(q)
    squared = (omega * omega).sum(-1, keepdim=True)
    small = squared < _SMALL_SQUARED
    safe = torch.where(small, 1.0, squared)
    sine = (q[..., 1:] ** 2).sum(-1, keepdim=True)
    half_cotangent = 0.5 * safe.sqrt() * q[..., :1] / torch.where(small, 1.0, sine).sqrt()
    c = torch.where(small, 1 / 12 + squared / 720, (1 - half_cotangent) / safe)
    once = torch.linalg.cross(omega, t)
    return t - 0.5 * once + c * torch.linalg.cross(omega, once)
