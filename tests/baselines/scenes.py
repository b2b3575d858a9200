"""Exact hand-eye scenes in NumPy and SciPy, and noise on their poses: nothing here comes from the package."""

from dataclasses import dataclass

import numpy as np
from scipy.spatial.transform import Rotation

RCM_IN_BASE = np.array([10.0, 20.0, 300.0])
METHODS = ("tsai", "park", "horaud", "andreff", "daniilidis", "ata", "rcm", "shah", "li", "refine")


@dataclass(frozen=True)
class Scene:
    """Poses with base_T_flange @ flange_T_camera @ camera_T_board = base_T_board; any leading trials; mm."""

    base_T_flange: np.ndarray
    camera_T_board: np.ndarray
    flange_T_camera: np.ndarray
    base_T_board: np.ndarray

    def inputs(self, method: str) -> dict:
        """Arguments of `hand_eye` beside the poses."""
        if method != "rcm":
            return {}
        point = np.linalg.inv(self.base_T_board) @ np.append(RCM_IN_BASE, 1.0)
        return {"base_p_rcm": RCM_IN_BASE, "board_p_rcm": point[..., :3]}

    def solve(self, method: str, **options):
        """The package's answer."""
        from rmis_calib.baselines import hand_eye

        return hand_eye(self.base_T_flange, self.camera_T_board, method, **self.inputs(method), **options)


def pose(rotation: Rotation, translation: np.ndarray) -> np.ndarray:
    matrix = np.zeros((*translation.shape[:-1], 4, 4))
    matrix[..., :3, :3] = rotation.as_matrix().reshape(*translation.shape[:-1], 3, 3)
    matrix[..., :3, 3] = translation
    matrix[..., 3, 3] = 1.0
    return matrix


def scene(
    seed: int,
    poses: int,
    *,
    trials: tuple[int, ...] = (),
    angle: float = 0.4,
    travel_mm: float = 80.0,
    turns=None,
    shifts=None,
) -> Scene:
    """Random mountings; rotation vectors of `angle` rad an axis, positions of `travel_mm`, or those given."""
    rng = np.random.default_rng(seed)
    count = int(np.prod(trials, dtype=int))
    X = pose(Rotation.random(count, rng), rng.normal(size=(count, 3)) * 50.0)
    Z = pose(Rotation.random(count, rng), rng.normal(size=(count, 3)) * 200.0)
    turns = rng.normal(size=(count, poses, 3)) * angle if turns is None else np.broadcast_to(turns, (count, poses, 3))
    shifts = (
        rng.normal(size=(count, poses, 3)) * travel_mm if shifts is None else np.broadcast_to(shifts, (count, poses, 3))
    )
    first = pose(Rotation.random(count, rng), rng.normal(size=(count, 3)) * 100.0)[:, None]
    A = first @ pose(Rotation.from_rotvec(np.array(turns).reshape(-1, 3)), shifts)
    C = np.linalg.inv(A @ X[:, None]) @ Z[:, None]
    return Scene(*(values.reshape(*trials, *values.shape[1:]) for values in (A, C, X, Z)))


def disturbed(poses: np.ndarray, rng: np.random.Generator, rotation_rad: float, translation_mm: float) -> np.ndarray:
    """Isotropic noise: R exp(rotation_rad eps), t + translation_mm eps."""
    shape = poses.shape[:-2]
    noise = Rotation.from_rotvec((rng.normal(size=(*shape, 3)) * rotation_rad).reshape(-1, 3)).as_matrix()
    moved = poses.copy()
    moved[..., :3, :3] = poses[..., :3, :3] @ noise.reshape(*shape, 3, 3)
    moved[..., :3, 3] += rng.normal(size=(*shape, 3)) * translation_mm
    return moved


def noisy(exact: Scene, seed: int, camera=(0.0, 0.0), robot=(0.0, 0.0)) -> Scene:
    """(rotation, rad; translation, mm) an axis on the board's and on the robot's poses."""
    rng = np.random.default_rng(seed)
    robot_poses = disturbed(exact.base_T_flange, rng, *robot)
    return Scene(robot_poses, disturbed(exact.camera_T_board, rng, *camera), exact.flange_T_camera, exact.base_T_board)


def errors(found: np.ndarray, truth: np.ndarray) -> np.ndarray:
    """(rotation vector, rad; translation, mm) from found to true, R = exp(dphi) R^, (..., 6)."""
    turn = Rotation.from_matrix((truth[..., :3, :3] @ np.swapaxes(found[..., :3, :3], -1, -2)).reshape(-1, 3, 3))
    turn = turn.as_rotvec().reshape(*found.shape[:-2], 3)
    return np.concatenate([turn, truth[..., :3, 3] - found[..., :3, 3]], axis=-1)
