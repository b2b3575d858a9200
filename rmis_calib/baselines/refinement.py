"""Maximum likelihood for A X C = Z with noise of board and robot, whose levels the data tell."""

import torch
from jaxtyping import Bool, Float
from torch import Tensor

from rmis_calib.baselines.fixed_point import fixed_point
from rmis_calib.baselines.motions import Samples
from rmis_calib.baselines.noise import NoiseLevels, Residuals, noise_levels, residuals
from rmis_calib.baselines.robot_world import Transforms, shah
from rmis_calib.geometry import matrix_to_rotvec, rigid_from_rotation_translation, rotvec_to_matrix, skew
from rmis_calib.solver.model.batched_linalg import unit_diagonal

_STEPS, _TOLERANCE = 200, 1e-9


def refine(samples: Samples) -> tuple[Transforms, Bool[Tensor, "*batch"]]:
    """(mount_T_camera, anchor_T_board), and whether the iteration settled.

    Gauss-Newton over both transforms from `shah`; every step uses the noise levels of the residuals where it starts.

    Source: the equation is A X = Z B as in `shah`, the noise model is in noise.py; Nocedal & Wright, Numerical
    Optimization, ch. 10.
    """
    X, Z = (transform.detach() for transform in shah(samples))
    length = residuals(samples, X, Z).lever.detach().norm(dim=-1).mean(-1)
    scales = torch.stack([torch.ones_like(length), length] * 2, -1).repeat_interleave(3, -1)
    # x is the step from the start, with lengths divided by the lever's.
    data = (samples.anchor_T_mount, samples.camera_T_board, X, Z, scales)
    x, settled = fixed_point(_update, torch.zeros_like(scales), data, steps=_STEPS, tolerance=_TOLERANCE)
    return moved(X, Z, x * scales), settled


def _update(
    x: Tensor, anchor_T_mount: Tensor, camera_T_board: Tensor, X: Tensor, Z: Tensor, scales: Tensor
) -> Float[Tensor, "*batch 12"]:
    """The next x of `refine`: a Gauss-Newton step with the noise levels of the residuals at x."""
    samples = Samples(anchor_T_mount, camera_T_board)
    X, Z = moved(X, Z, x * scales)
    step = gauss_newton_step(samples, X, Z)
    turns = [
        matrix_to_rotvec(rotvec_to_matrix(step[..., k : k + 3]) @ rotvec_to_matrix(x[..., k : k + 3])) for k in (0, 6)
    ]
    sums = x + step / scales
    return torch.cat([turns[0], sums[..., 3:6], turns[1], sums[..., 9:]], -1)


def moved(
    X: Float[Tensor, "*batch 4 4"], Z: Float[Tensor, "*batch 4 4"], step: Float[Tensor, "*batch 12"]
) -> Transforms:
    """X and Z after a step: rotation (left perturbation, rad) and translation (mm) of each."""
    X_moved, Z_moved = (
        rigid_from_rotation_translation(rotvec_to_matrix(part[..., :3]) @ T[..., :3, :3], T[..., :3, 3] + part[..., 3:])
        for T, part in zip((X, Z), step.split(6, -1), strict=True)
    )
    return X_moved, Z_moved


def gauss_newton_step(
    samples: Samples, X: Float[Tensor, "*batch 4 4"], Z: Float[Tensor, "*batch 4 4"]
) -> Float[Tensor, "*batch 12"]:
    """Step of X and Z, as in `moved`, weighted by the noise levels of the residuals."""
    found = residuals(samples, X, Z)
    turning, shifting = _jacobian(samples, X, Z)
    turn, shift = found.turn[..., None], found.shift[..., None]
    share, shift_weight = _weights(noise_levels(found), found)
    # The robot's share of the turn moves the board by its lever: with that off the shift, both are independent.
    S = -share[..., None, None, None] * skew(found.lever)
    shifting, shift = shifting - S @ turning, shift - S @ turn
    normal = (turning.mT @ turning + shifting.mT @ (shift_weight @ shifting)).sum(-3)
    rhs = (turning.mT @ turn + shifting.mT @ (shift_weight @ shift)).sum(-3)
    scaled, size = unit_diagonal(normal)
    return size * torch.linalg.solve_ex(scaled, size[..., None] * rhs).result[..., 0]


def _weights(noise: NoiseLevels, found: Residuals) -> tuple[Tensor, Tensor]:
    """Robot's share of the turn's variance, and inverse covariance of the shift given the turn.

    All of them times the turn's variance.
    """
    square = found.lever.square().sum(-1)
    rotation = noise.camera_rotation + noise.robot_rotation
    share = noise.robot_rotation / rotation
    along = (noise.translation / rotation)[..., None].expand_as(square)
    across = along + (share * noise.camera_rotation / rotation)[..., None] * square
    eye = torch.eye(3, dtype=square.dtype, device=square.device)
    outer = found.lever[..., :, None] * found.lever[..., None, :] / square.clamp_min(1e-300)[..., None, None]
    shift_weight = (eye - outer) / across[..., None, None] + outer / along[..., None, None]
    return share, shift_weight


def _jacobian(samples: Samples, X: Tensor, Z: Tensor) -> tuple[Tensor, Tensor]:
    """Derivatives of the predicted turn and position of the board to (X, Z), (*batch, n, 3, 12)."""
    camera_R_mount = X[..., None, :3, :3].mT.expand_as(samples.anchor_T_mount[..., :3, :3])
    camera_R_anchor = camera_R_mount @ samples.anchor_T_mount[..., :3, :3].mT
    zero = torch.zeros_like(camera_R_mount)
    camera_t = _board_position(samples, X, Z)
    turning = torch.cat([-camera_R_mount, zero, camera_R_anchor, zero], -1)
    shifting = torch.cat([skew(camera_t) @ camera_R_mount, -camera_R_mount, zero, camera_R_anchor], -1)
    return turning, shifting


def _board_position(samples: Samples, X: Tensor, Z: Tensor) -> Float[Tensor, "*batch n 3"]:
    """Where the board's origin is predicted to be, in the camera, mm."""
    mount_p = samples.anchor_T_mount[..., :3, :3].mT @ (Z[..., None, :3, 3:] - samples.anchor_T_mount[..., :3, 3:])
    return (X[..., None, :3, :3].mT @ (mount_p - X[..., None, :3, 3:]))[..., 0]
