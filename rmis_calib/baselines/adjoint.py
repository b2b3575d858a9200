"""The adjoint transformation algorithm: rotation and translation in turns, from the twists of the motions."""

import torch
from jaxtyping import Bool, Float
from torch import Tensor

from rmis_calib.baselines.fixed_point import fixed_point
from rmis_calib.baselines.linalg import nearest_rotation, solve_symmetric
from rmis_calib.baselines.motions import Motions, rotation_vectors, screw_translation
from rmis_calib.geometry import rigid_from_rotation_translation, rigid_inverse, skew

_STEPS, _TOLERANCE = 300, 1e-12


def ata(motions: Motions) -> tuple[Float[Tensor, "*batch 4 4"], Bool[Tensor, "*batch"]]:
    """X, and whether the iteration settled.

    With the twist (omega, v) of a motion and X = camera_T_mount, the adjoint gives v_A - t x omega_A = R v_B.
    Starting from t = 0, two steps alternate. Rotation: the unit quaternion that best solves q_A q = q q_B together with
    that equation at the current t (computed as a polar factor, see `horaud`). Translation: least squares on
    omega_A x t = R v_B - v_A. Lengths are divided by the size of the motions' translations, so that the result does not
    depend on the unit. The published program stops after 50 steps; this one runs to the fixed point.

    Source: Pachtrachai et al. (2018), Annals of Biomedical Engineering 46(10), and the authors' program
    (github.com/surgical-vision/handeye-ata, HandEye_ST.m). Stereo: its HandEye.m; see `Samples`.
    """
    motions = motions.swapped()
    length = motions.length()
    vA = screw_translation(motions.qa, motions.ta) / length[..., None, None]
    vB = screw_translation(motions.qb, motions.tb) / length[..., None, None]
    omega = rotation_vectors(motions.qa)
    turning = motions.qa[..., 1:].mT @ motions.qb[..., 1:] + vA.mT @ vB
    square = (omega * omega).sum((-2, -1))[..., None, None] * torch.eye(3, dtype=vA.dtype, device=vA.device)
    data = (turning, omega.mT @ vA, omega.mT @ vB, square - omega.mT @ omega)
    data = tuple(values / vA.shape[-2] for values in data)
    t, settled = fixed_point(_translation, torch.zeros_like(vA[..., 0, :]), data, steps=_STEPS, tolerance=_TOLERANCE)
    camera_T_mount = rigid_from_rotation_translation(_rotation(t, data[0], data[2]), t * length[..., None])
    return rigid_inverse(camera_T_mount), settled


def _rotation(t: Tensor, turning: Tensor, omega_vB: Tensor) -> Float[Tensor, "*batch 3 3"]:
    """R at a translation: the polar factor of sum q_A q_B^T + (v_A - t x omega_A) v_B^T."""
    return nearest_rotation(turning - skew(t) @ omega_vB)


def _translation(
    t: Tensor, turning: Tensor, omega_vA: Tensor, omega_vB: Tensor, square: Tensor
) -> Float[Tensor, "*batch 3"]:
    """The next translation: least squares on omega_A x t = R v_B - v_A, from sums of omega v^T."""
    product = omega_vB @ _rotation(t, turning, omega_vB).mT - omega_vA
    return solve_symmetric(square, -_axial(product))


def _axial(product: Float[Tensor, "*batch 3 3"]) -> Float[Tensor, "*batch 3"]:
    """sum a x b of product = sum a b^T."""
    return torch.stack(
        [
            product[..., 1, 2] - product[..., 2, 1],
            product[..., 2, 0] - product[..., 0, 2],
            product[..., 0, 1] - product[..., 1, 0],
        ],
        dim=-1,
    )
