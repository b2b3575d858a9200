"""Poses of a rendered board from its pictures: corners and poses by OpenCV, as a calibration with a board has them."""

from dataclasses import dataclass

import cv2
import numpy as np

from data_synth.board import Board, BoardRenderer
from data_synth.cameras import Camera
from data_synth.kinematics import Array, rigid, rigid_inverse, rotation_from_rotvec
from data_synth.world import World
from rmis_calib.errors import InputError

BOARD_ROTVEC = (0.35, -0.25, 0.1)
"""How the board is turned against the camera at home: tilted, so that its pose is well seen."""
_SQUARE_OF_PICTURE = 0.051
"""A square's side over the shorter side of the picture: nine of them are seen whole wherever the arm goes."""
_TRIES = 10
_WINDOW_PX = 5
_STOP = (cv2.TERM_CRITERIA_EPS + cv2.TERM_CRITERIA_MAX_ITER, 60, 1e-4)


@dataclass(frozen=True)
class BoardPoses:
    """What a robot and its cameras say of a board that stands still; arrays (n, 4, 4), mm.

    Attributes:
        base_T_arm: true poses of the laparoscope's arm.
        camera_T_board: measured in each camera, by side.
    """

    base_T_arm: Array
    camera_T_board: dict[str, Array]


def measure_board(world: World, count: int, generator: np.random.Generator) -> BoardPoses:
    """Render a board before the cameras of a world at random readings of the laparoscope, and measure its poses.

    Args:
        world: cameras, arms and ranges of the motion.
        count: of poses in which every camera finds all corners.
        generator: of the readings and of the sensors' noise.

    Raises:
        InputError: the board is out of sight too often.
    """
    scene = world.scene
    board = Board(square_mm=_square_mm(world))
    camera_home_T_centre = rigid(rotation_from_rotvec(BOARD_ROTVEC), world.config.scene.target_mm)
    centre_T_board = rigid(np.eye(3), -board.centre)
    base_T_board = scene.base_T_camera_home @ camera_home_T_centre @ centre_T_board
    renderers = {side: BoardRenderer(camera, board) for side, camera in world.cameras.items()}
    arms: list[Array] = []
    poses: dict[str, list[Array]] = {side: [] for side in renderers}
    for _ in range(_TRIES * count):
        unit = np.concatenate([generator.uniform(-1.0, 1.0, 3), np.zeros(3)])
        base_T_arm = scene.laparoscope.tool(world.path.readings(unit)[0])
        camera_right_T_board = scene.camera_right_T_arm @ rigid_inverse(base_T_arm) @ base_T_board
        measured = {}
        for side, renderer in renderers.items():
            camera_T_board = world.camera_T_camera_right(side) @ camera_right_T_board
            pose = _pose(renderer.draw(camera_T_board, generator), world.cameras[side], board)
            if pose is None:
                break
            measured[side] = pose
        if len(measured) == len(renderers):
            arms.append(base_T_arm)
            for side, pose in measured.items():
                poses[side].append(pose)
        if len(arms) == count:
            return BoardPoses(np.stack(arms), {side: np.stack(list_) for side, list_ in poses.items()})
    raise InputError(where="board", expected=f"{count} pictures with all corners", found=f"{len(arms)}")


def _square_mm(world: World) -> float:
    """Side of a square, to half a millimetre, of a board that takes up about a third of the right camera's picture."""
    camera, depth_mm = world.cameras["right"], world.config.scene.target_mm[2]
    extent_mm = depth_mm * min(camera.width / camera.fx, camera.height / camera.fy)
    return max(0.5, 0.5 * round(2.0 * _SQUARE_OF_PICTURE * extent_mm))


def _pose(picture: Array, camera: Camera, board: Board) -> Array | None:
    """camera_T_board (4, 4) of a picture; None where not all corners are found."""
    is_found, corners = cv2.findChessboardCorners(picture, board.inner_corners)
    if not is_found:
        return None
    corners = cv2.cornerSubPix(picture, corners, (_WINDOW_PX, _WINDOW_PX), (-1, -1), _STOP).reshape(-1, 2)
    # The finder may begin at either end; the board is never upside down here.
    if corners[-1, 1] < corners[0, 1]:
        corners = corners[::-1]
    K = np.array([[camera.fx, 0.0, camera.cx], [0.0, camera.fy, camera.cy], [0.0, 0.0, 1.0]])
    points = board.corner_points()
    is_solved, rotvec, t = cv2.solvePnP(points, np.ascontiguousarray(corners), K, np.asarray(camera.distortion))
    return rigid(rotation_from_rotvec(rotvec[:, 0]), t[:, 0]) if is_solved else None
