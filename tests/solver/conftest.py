"""Scenes for the solver's tests, from the independent simulation."""

from dataclasses import replace

import pytest
import torch

from data_synth.lines import simulate_lines
from data_synth.settings import LineStudyConfig
from rmis_calib.solver import Problem


@pytest.fixture(scope="session")
def simulate():
    """`simulate(**LineStudyConfig fields) -> (Problem, truth dict, arrays)`; exact unless noise is asked for."""

    def build(**fields):
        defaults = {"trials": 2, "positions_laparoscope": 2, "positions_instrument": 3, "pixel_noise_px": 0.0}
        arrays = simulate_lines(LineStudyConfig(**(defaults | fields)))
        return Problem.from_arrays(arrays), arrays["truth"], arrays

    return build


@pytest.fixture(scope="session")
def unknown_noise():
    """`unknown_noise(problem)`: the problem with its levels of noise left open."""

    def build(problem):
        nan = torch.full_like(problem.noise.image, torch.nan)
        return replace(problem, noise=replace(problem.noise, image=nan, kinematics_mm=nan, kinematics_rad=nan))

    return build


@pytest.fixture(scope="session")
def realistic():
    """Noise of a good robot and camera: 0.3 px; 0.3 mm and 0.1 deg; stereo 0.05 mm and 0.05 deg."""
    return {
        "pixel_noise_px": 0.3, "kinematics_noise_mm": 0.3, "kinematics_noise_deg": 0.1, "stereo_noise_mm": 0.05,
        "stereo_noise_deg": 0.05,
    }  # fmt: skip
