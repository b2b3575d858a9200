"""How the arms move: grids, random positions, smooth paths."""

from __future__ import annotations

import numpy as np

from data_synth.kinematics import Array


def joint_grid(positions: int) -> Array:
    """Every combination (positions^3, 3) of evenly spaced values in [-1, 1] of three joints; zero for a single position."""
    values = np.linspace(-1.0, 1.0, positions) if positions > 1 else np.zeros(1)
    return np.stack(np.meshgrid(values, values, values, indexing="ij"), axis=-1).reshape(-1, 3)
