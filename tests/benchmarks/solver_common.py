"""Shared by the solver's benchmarks: noisy trials from the independent simulation, the bound for their exact noise,
and errors."""

import time
from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
import torch
from torch import Tensor

from data_synth.lines import simulate_lines
from data_synth.settings import LineStudyConfig
from rmis_calib.solver import Problem, SolverSettings
from rmis_calib.solver.settings import UnknownSettings
from rmis_calib.studies.measures import cramer_rao_bound, rotation_deg, translation_mm
from rmis_calib.studies.measures import transform_errors as errors

__all__ = ["errors", "rotation_deg", "translation_mm"]

KNOWN_RADIUS = UnknownSettings(radius_sigma_relative=0.0)
"""The simulation's radius is exact."""

Noise = tuple[float, float, float, float, float, float, float]
"""px; kinematics mm, deg; camera mm, deg; stereo mm, deg."""

REALISTIC: Noise = (0.3, 0.3, 0.1, 0.0, 0.0, 0.05, 0.05)


def level(c: float, px: float = 0.5) -> Noise:
    """The paper's noise coefficient c on kinematics, camera and stereo."""
    return (px, c, c, c, c, c, c)


def config(
    noise: Noise, trials: int, seed: int = 0, laparoscope: int = 3, instrument: int = 4, **more: object
) -> LineStudyConfig:
    px, kin_mm, kin_deg, cam_mm, cam_deg, stereo_mm, stereo_deg = noise
    return LineStudyConfig(
        trials=trials, seed=seed, positions_laparoscope=laparoscope, positions_instrument=instrument, pixel_noise_px=px,
        kinematics_noise_mm=kin_mm, kinematics_noise_deg=kin_deg, camera_noise_mm=cam_mm, camera_noise_deg=cam_deg,
        stereo_noise_mm=stereo_mm, stereo_noise_deg=stereo_deg, **more,
    )  # fmt: skip


@dataclass(frozen=True)
class Study:
    """Trials with their truth and the Cramer-Rao bound (6x6 covariance, rotation first) of the transform."""

    problem: Problem
    truth: Tensor
    bound: Tensor

    @property
    def bound_deg(self) -> float:
        return float(torch.rad2deg(self.bound[..., :3, :3].diagonal(dim1=-2, dim2=-1).sum(-1).sqrt()).mean())

    @property
    def bound_mm(self) -> float:
        return float(self.bound[..., 3:, 3:].diagonal(dim1=-2, dim2=-1).sum(-1).sqrt().mean())


def study(
    settings: LineStudyConfig, kinds: tuple[str, ...], cameras: int = 2, unknowns: UnknownSettings = KNOWN_RADIUS
) -> Study:
    """Simulated trials restricted to some measurements, with their bound: the information at the true transform,
    poses and extrinsics."""
    data = simulate_lines(settings)
    truth = data["truth"]
    problem = Problem.from_arrays(data).only(*kinds).cameras(cameras)
    exact = dict(data) | {
        "arm_T_rcm": truth["arm_T_rcm"],
        "camera_left_T_camera_right": truth["camera_left_T_camera_right"],
    }
    clean = Problem.from_arrays(exact).only(*kinds).cameras(cameras)
    X = torch.as_tensor(truth["camera_right_T_arm"])
    bound = cramer_rao_bound(clean, X, truth["shaft_end_offset_mm"], SolverSettings(unknowns=unknowns))
    return Study(problem, X, bound)


def rms(x: Tensor) -> float:
    return float(x.square().mean().sqrt())


def median_seconds(function: Callable[[], object], repeats: int) -> float:
    """Median wall time of warm calls."""
    function()
    times = []
    for _ in range(repeats):
        start = time.perf_counter()
        function()
        times.append(time.perf_counter() - start)
    return float(np.median(times))
