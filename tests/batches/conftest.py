"""Results of one set-up from simulated lines, without pictures."""

from collections.abc import Callable
from dataclasses import replace

import numpy as np
import pytest
import torch

import rmis_calib as rc
from data_synth.lines import simulate_lines
from data_synth.settings import LineStudyConfig
from rmis_calib.config import parse_config
from rmis_calib.geometry.rotations import rotvec_to_matrix

_COMMON = ("shaft_radius_mm", "sigma_image", "sigma_kinematics_mm", "sigma_kinematics_rad", "sigma_stereo_mm",
           "sigma_stereo_rad", "camera_left_T_camera_right")  # fmt: skip
_BY_MOTION = ("arm_T_rcm", "rcm_v_axis", "rcm_s_end_mm", "axis_right", "contour_right", "end_right", "valid_right",
              "axis_left", "contour_left", "end_left", "valid_left")  # fmt: skip
SOLVER = {
    "solver": {
        "noise": {"estimate": "never"},
        "unknowns": {"edge_bias": False, "doubt": 0.0},  # the covariance is the inverse of the information
        "groups": 0,
    }
}


@pytest.fixture(scope="session")
def observed() -> Callable[..., tuple[rc.ShaftObservations, np.ndarray]]:
    """`observed(motions, seed) -> (observations, true camera_right_T_arm)`: random motions at realistic noise."""

    def build(motions: int, seed: int) -> tuple[rc.ShaftObservations, np.ndarray]:
        noise = {"pixel_noise_px": 0.3, "kinematics_noise_mm": 0.3, "kinematics_noise_deg": 0.1}
        stereo = {"stereo_noise_mm": 0.05, "stereo_noise_deg": 0.05}
        arrays = simulate_lines(
            LineStudyConfig(trials=1, motion="random", random_motions=motions, seed=seed, **noise, **stereo)
        )
        common = {key: np.squeeze(arrays[key]) for key in _COMMON}
        common = {key: value if value.ndim else float(value) for key, value in common.items()}
        seen = rc.ShaftObservations(**{key: arrays[key][0] for key in _BY_MOTION}, **common)
        return seen, arrays["truth"]["camera_right_T_arm"][0]

    return build


@pytest.fixture(scope="session")
def part_of() -> Callable[[rc.ShaftObservations, slice], rc.ShaftObservations]:
    """Some motions of observations."""

    def take(seen: rc.ShaftObservations, motions: slice) -> rc.ShaftObservations:
        return replace(seen, **{key: getattr(seen, key)[motions] for key in _BY_MOTION})

    return take


@pytest.fixture(scope="session")
def solved() -> Callable[[rc.ShaftObservations], rc.CalibrationResult]:
    """The joint estimate with the noise levels as given."""
    return lambda seen: rc.solve(seen, parse_config(SOLVER), throw=False)


@pytest.fixture(scope="session")
def moved() -> Callable[..., rc.CalibrationResult]:
    """A result whose transform is turned and shifted."""

    def move(result: rc.CalibrationResult, rotvec_deg: tuple[float, ...], shift_mm: tuple[float, ...]):
        transform = result.camera_right_T_arm
        assert transform is not None
        matrix = transform.matrix.clone()
        matrix[:3, :3] = rotvec_to_matrix(torch.deg2rad(torch.tensor(rotvec_deg, dtype=torch.float64))) @ matrix[:3, :3]
        matrix[:3, 3] += torch.tensor(shift_mm, dtype=torch.float64)
        return replace(result, camera_right_T_arm=rc.RigidTransform("camera_right", "arm", matrix))

    return move


@pytest.fixture(scope="session")
def series(observed, solved) -> tuple[list[rc.CalibrationResult], np.ndarray]:
    """Twelve recordings of one set-up, 40 motions each, and the truth."""
    results, truth = [], np.eye(4)
    for seed in range(12):
        seen, truth = observed(40, seed)
        results.append(solved(seen))
    return results, truth
