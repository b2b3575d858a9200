"""What `hand_eye` is given, checked: poses are rigid, shapes fit each other, and what a method needs is there."""

from typing import Any

import torch
from jaxtyping import Float
from torch import Tensor

from rmis_calib.baselines.motions import Samples
from rmis_calib.baselines.result import Setup
from rmis_calib.errors import InputError, InsufficientDataError, ShapeError
from rmis_calib.geometry import rigid_inverse

LEAST_POSES, MOST_POSES = 3, 1000
"""All pairs of poses count, so memory grows with their square: about 1 GB with covariance at the upper end."""
_ORTHONORMAL_TOLERANCE = 1e-4
"""Largest entry of R^T R - I that is taken for rounding in a file; more is no rotation."""


def read_samples(
    base_T_flange: Any, camera_T_board: Any, camera_left_T_board: Any, camera_left_T_camera: Any, setup: Setup
) -> tuple[Samples, tuple[int, ...]]:
    """Checked input with one axis of trials, and its leading shape."""
    robot, board = _poses("base_T_flange", base_T_flange), _poses("camera_T_board", camera_T_board)
    if robot.ndim < 3 or robot.shape != board.shape:
        expected = "base_T_flange and camera_T_board of one shape (..., N, 4, 4)"
        raise ShapeError(where="hand_eye", expected=expected, found=f"{tuple(robot.shape)}, {tuple(board.shape)}")
    batch, n = robot.shape[:-3], robot.shape[-3]
    if not LEAST_POSES <= n <= MOST_POSES:
        raise InsufficientDataError(
            where="hand_eye", expected=f"{LEAST_POSES} to {MOST_POSES} poses (thin a long stream)", found=n
        )
    if (camera_left_T_board is None) != (camera_left_T_camera is None):
        expected = "camera_left_T_board and camera_left_T_camera together"
        raise InputError(where="hand_eye", expected=expected, found="one of them")
    cameras = 1
    if camera_left_T_board is not None:
        left = _poses("camera_left_T_board", camera_left_T_board)
        if left.shape != board.shape:
            raise ShapeError(
                where="camera_left_T_board", expected=f"shape {tuple(board.shape)}", found=tuple(left.shape)
            )
        camera_T_camera_left = rigid_inverse(_poses("camera_left_T_camera", camera_left_T_camera))
        seen_left = camera_T_camera_left[..., None, :, :] @ left  # the board in the first camera, as the second saw it
        robot, board, cameras = torch.cat([robot, robot], -3), torch.cat([board, seen_left], -3), 2
    anchor_T_mount = robot if setup == "eye_in_hand" else rigid_inverse(robot)
    device = anchor_T_mount.device
    if board.device != device:
        raise InputError(where="camera_T_board", expected=f"a tensor on {device}", found=str(board.device))
    return Samples(anchor_T_mount.reshape(-1, *robot.shape[-3:]), board.reshape(-1, *board.shape[-3:]), cameras), batch


def _poses(name: str, values: Any) -> Float[Tensor, "*batch 4 4"]:
    poses = torch.as_tensor(values).to(torch.float64)
    if poses.shape[-2:] != (4, 4):
        raise ShapeError(where=name, expected="shape (..., 4, 4)", found=tuple(poses.shape))
    fixed = poses.detach()
    if not bool(torch.isfinite(fixed).all()):
        raise InputError(where=name, expected="finite entries", found="NaN or infinity")
    R = fixed[..., :3, :3]
    eye = torch.eye(3, dtype=R.dtype, device=R.device)
    error = float((R.mT @ R - eye).abs().amax()) if R.numel() else 0.0
    if error > _ORTHONORMAL_TOLERANCE or not bool((torch.linalg.det(R) > 0).all()):
        found = f"one that is off by {error:.3g}" if error > _ORTHONORMAL_TOLERANCE else "a reflection"
        raise InputError(where=name, expected="rotations (R^T R = I, determinant +1)", found=found)
    if not bool((fixed[..., 3, :] == fixed.new_tensor([0.0, 0.0, 0.0, 1.0])).all()):
        raise InputError(where=name, expected="a last row of 0, 0, 0, 1", found="another")
    return poses


def read_remote_centre(
    method: str, setup: Setup, base_p_rcm: Any, board_p_rcm: Any, anchor_T_mount: Tensor
) -> list[Tensor | None]:
    """The remote centre in base and board for every trial; None where the method does not use it."""
    if method != "rcm":
        return [None, None]
    if base_p_rcm is None or board_p_rcm is None:
        raise InputError(where="method rcm", expected="base_p_rcm and board_p_rcm", found="not both")
    if setup != "eye_in_hand":
        raise InputError(where="method rcm", expected="setup eye_in_hand: the camera's arm pivots", found=setup)
    points = [torch.as_tensor(p).to(anchor_T_mount) for p in (base_p_rcm, board_p_rcm)]
    for name, point in zip(("base_p_rcm", "board_p_rcm"), points, strict=True):
        if point.shape[-1:] != (3,) or not bool(torch.isfinite(point).all()):
            raise ShapeError(where=name, expected="three finite coordinates, mm", found=tuple(point.shape))
    return [point.reshape(-1, 3).expand(len(anchor_T_mount), 3) for point in points]
