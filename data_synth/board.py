"""Pictures of a calibration board, for comparison with calibration from an instrument. float64 NumPy."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from scipy.ndimage import gaussian_filter

from data_synth.cameras import Camera
from data_synth.kinematics import Array

DARK, BRIGHT, BEYOND = 30.0, 210.0, 95.0
"""Levels of the squares and of what lies beyond the board."""
_SAMPLES, _STRIDE = 16, 7
"""Rays a pixel, on a lattice with as many levels along each axis: edges along rows or columns are no coarser."""


@dataclass(frozen=True)
class Board:
    """A chessboard with a bright margin one square wide.

    Frame `board`: origin in the outer corner of the first square, x along the columns, y along the rows, z into the
    board as a camera in front of it sees it.
    """

    columns: int = 9
    rows: int = 6
    square_mm: float = 3.5

    @property
    def inner_corners(self) -> tuple[int, int]:
        """Columns and rows of inner corners."""
        return self.columns - 1, self.rows - 1

    def corner_points(self) -> Array:
        """Inner corners (n, 3) in `board`, row by row, mm."""
        x, y = np.meshgrid(np.arange(1, self.columns), np.arange(1, self.rows))
        return self.square_mm * np.stack([x.ravel(), y.ravel(), np.zeros(x.size)], axis=-1)

    @property
    def centre(self) -> Array:
        """Middle of the board (3,) in `board`, mm."""
        return 0.5 * self.square_mm * np.array([self.columns, self.rows, 0.0])


class BoardRenderer:
    """Draws a board as one camera sees it, distortion included."""

    def __init__(self, camera: Camera, board: Board, blur_px: float = 0.55, noise_levels: float = 1.5) -> None:
        """
        Args:
            camera: that looks.
            board: that it looks at.
            blur_px: 1 sigma of the point spread.
            noise_levels: 1 sigma of the sensor, in levels of 0 to 255.
        """
        self._board, self._blur_px, self._noise_levels = board, blur_px, noise_levels
        v, u = np.mgrid[: camera.height, : camera.width].astype(np.float64)
        xy, jacobian = camera.rays(np.stack([u, v], axis=-1))
        k = np.arange(_SAMPLES)
        offsets = (np.stack([k, _STRIDE * k % _SAMPLES], axis=-1) + 0.5) / _SAMPLES - 0.5
        within = xy[..., None, :] + np.einsum("hwij,kj->hwki", jacobian, offsets)
        self._rays = np.concatenate([within, np.ones((*within.shape[:-1], 1))], axis=-1)

    def draw(self, camera_T_board: Array, generator: np.random.Generator) -> Array:
        """Picture (H, W), uint8, of a board in front of the camera.

        Args:
            camera_T_board: pose (4, 4), mm.
            generator: of the sensor's noise.
        """
        R, t, board = camera_T_board[:3, :3], camera_T_board[:3, 3], self._board
        distance = (R[:, 2] @ t) / (self._rays @ R[:, 2])
        x, y = np.moveaxis((distance[..., None] * self._rays - t) @ R[:, :2] / board.square_mm, -1, 0)
        dark = (np.floor(x) + np.floor(y)) % 2 == 0
        dark &= (x >= 0) & (x < board.columns) & (y >= 0) & (y < board.rows)
        on_board = (x >= -1) & (x < board.columns + 1) & (y >= -1) & (y < board.rows + 1) & (distance > 0)
        levels = np.where(on_board, np.where(dark, DARK, BRIGHT), BEYOND).mean(-1)
        picture = gaussian_filter(levels, self._blur_px)
        picture += self._noise_levels * generator.standard_normal(picture.shape)
        return np.clip(np.round(picture), 0, 255).astype(np.uint8)
