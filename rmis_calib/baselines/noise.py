"""Residuals of A X C = Z, and the noise of board and robot poses that explains them.

Residuals compare measured and predicted camera_T_board in the camera frame: a rotation vector and a shift of the
board's origin. An orientation error of the robot turns the board about the mount's origin, so it shifts the board too,
by the lever from there. That tells it apart from an orientation error of the board. Position errors of both look the
same and share one level.
"""

from dataclasses import dataclass

import torch
from jaxtyping import Float
from torch import Tensor

from rmis_calib.baselines.motions import Samples
from rmis_calib.geometry import matrix_to_rotvec, rigid_inverse

_LIKELIHOOD_STEPS = 40
_LEAST_SIGMA = 1e-10
"""Smallest noise level, in rad and in lengths of the lever: exact data must leave finite weights."""


@dataclass(frozen=True, eq=False)
class Residuals:
    """Measured against predicted camera_T_board, in the camera.

    Attributes:
        turn: rotation vector, rad.
        shift: of the board's origin, mm.
        lever: from the mount's origin to the board's, mm.
    """

    turn: Float[Tensor, "*batch n 3"]
    shift: Float[Tensor, "*batch n 3"]
    lever: Float[Tensor, "*batch n 3"]


@dataclass(frozen=True, eq=False)
class NoiseLevels:
    """Variances an axis, of every trial.

    Attributes:
        camera_rotation: of the board's orientation, rad^2.
        robot_rotation: of the robot's orientation, rad^2.
        translation: of both positions together, mm^2.
    """

    camera_rotation: Float[Tensor, "*batch"]
    robot_rotation: Float[Tensor, "*batch"]
    translation: Float[Tensor, "*batch"]


def residuals(
    samples: Samples, mount_T_camera: Float[Tensor, "*batch 4 4"], anchor_T_board: Float[Tensor, "*batch 4 4"]
) -> Residuals:
    """Residuals of every sample."""
    anchor_T_camera = samples.anchor_T_mount @ mount_T_camera[..., None, :, :]
    camera_T_board = rigid_inverse(anchor_T_camera) @ anchor_T_board[..., None, :, :]
    measured = samples.camera_T_board
    turn = matrix_to_rotvec(measured[..., :3, :3] @ camera_T_board[..., :3, :3].mT)
    camera_p_mount = rigid_inverse(mount_T_camera)[..., None, :3, 3]
    lever = camera_T_board[..., :3, 3] - camera_p_mount
    return Residuals(turn, measured[..., :3, 3] - camera_T_board[..., :3, 3], lever)


def noise_levels(residuals: Residuals) -> NoiseLevels:
    """Maximum-likelihood levels, by expectation maximisation over the robot's rotation error of every sample.

    The result is corrected for the twelve degrees of freedom of the unknowns. Levels never reach zero, so no source is
    ever taken for exact.

    Source: Dempster, Laird, Rubin (1977), J. Royal Statistical Society B 39(1).
    """
    turn, shift, lever = residuals.turn, residuals.shift, residuals.lever
    square = lever.square().sum(-1, keepdim=True)
    direction = lever / square.clamp_min(1e-300).sqrt()
    n, least = turn.shape[-2], _LEAST_SIGMA**2
    camera = robot = 0.5 * _variance(turn) + least
    translation = 0.5 * _variance(shift) + least * square[..., 0].mean(-1)
    for _ in range(_LIKELIHOOD_STEPS):
        a, b, t = (level[..., None, None] for level in (camera, robot, translation))
        # Posterior of the robot's rotation error: its precision along the lever and across it, and its mean.
        along, across = 1 / (1 / a + 1 / b), 1 / (1 / a + 1 / b + square / t)
        pull = turn / a + torch.linalg.cross(lever, shift) / t
        pull_along = (pull * direction).sum(-1, keepdim=True) * direction
        error = along * pull_along + across * (pull - pull_along)
        spread = (along + 2 * across).mean((-2, -1)) / 3
        robot = _variance(error) + spread
        camera = _variance(turn - error) + spread
        translation = _variance(shift - torch.linalg.cross(error, lever)) + 2 / 3 * (square * across).mean((-2, -1))
    correction = n / max(n - 2, 1)
    return NoiseLevels(correction * camera, correction * robot, correction * translation)


def _variance(values: Float[Tensor, "*batch n 3"]) -> Float[Tensor, "*batch"]:
    """Mean square an axis."""
    return values.square().sum(-1).mean(-1) / 3


def propagate(
    slopes: Float[Tensor, "*batch k n 6"], noise: NoiseLevels, lever: Float[Tensor, "*batch n 3"], cameras: int
) -> Float[Tensor, "*batch k k"]:
    """Covariance of what depends on camera_T_board of every sample, to first order.

    Args:
        slopes: derivatives to (turn, shift) of each sample, as in `Residuals`.
        noise: levels.
        lever: of every sample.
        cameras: samples i and i + n / cameras share the robot's error.
    """
    turning, shifting = slopes[..., :3], slopes[..., 3:]
    # omega x lever for the robot's share: derivative to omega, summed over the cameras that see one robot pose.
    of_robot = turning + torch.linalg.cross(lever[..., None, :, :].expand_as(shifting), shifting)
    of_robot = of_robot.unflatten(-2, (cameras, -1)).sum(-3)
    total = torch.zeros_like(turning[..., 0, :1] * turning[..., None, :, 0, 0])
    for rows, variance in (
        (turning, noise.camera_rotation),
        (shifting, noise.translation),
        (of_robot, noise.robot_rotation),
    ):
        rows = rows.flatten(-2)
        total = total + variance[..., None, None] * (rows @ rows.mT)
    return total
