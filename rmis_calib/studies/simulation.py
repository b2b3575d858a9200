"""Trials of a study: simulated by `data_synth`, which shares no code with the solver that they are for."""

from dataclasses import dataclass, replace
from typing import Literal

import numpy as np
import torch
from torch import Tensor

from data_synth import LineStudyConfig, SceneSettings, simulate_lines
from data_synth.scene import Scene
from rmis_calib.errors import InputError
from rmis_calib.io.intrinsics import Intrinsics
from rmis_calib.solver import Problem
from rmis_calib.studies.builtin import SETTINGS
from rmis_calib.studies.equipment import make_scene, read_cameras
from rmis_calib.studies.measures import Bound, bound_in_measures, cramer_rao_bound
from rmis_calib.studies.registry import NoiseSource
from rmis_calib.studies.settings import SetupSettings

_BOUND_TRIALS = 16
"""Trials whose bounds are averaged: they differ by which motions the picture shows, and by random motions."""


@dataclass(frozen=True)
class Condition:
    """What all trials of a cell have in common.

    Attributes:
        noise: name of a noise source, or "" for the levels alone.
        coefficient: of the noise.
        levels: noise levels beside those of the source, by their names in `LineStudyConfig`.
        motion: on a grid, or other random motions in every trial.
        laparoscope, instrument: positions a joint on the grid. With random motions: 1 for a laparoscope that stands
            still, and 0 for the instrument.
        motions: how many.
    """

    noise: str
    coefficient: float
    laparoscope: int
    instrument: int
    motions: int
    motion: Literal["grid", "random"] = "grid"
    levels: tuple[tuple[str, float], ...] = ()

    @classmethod
    def on_grid(cls, noise: str, coefficient: float, laparoscope: int, instrument: int) -> "Condition":
        """All combinations of joint positions."""
        return cls(noise, coefficient, laparoscope, instrument, (laparoscope * instrument) ** 3)


@dataclass(frozen=True)
class Setup:
    """What is simulated, ready for it.

    Attributes:
        scene: arms and transforms.
        config: noise-free settings of the simulation; its own scene is not used.
        cameras: 1 or 2.
    """

    scene: Scene
    config: LineStudyConfig
    cameras: int

    @property
    def camera_p_working_point(self) -> Tensor:
        """The head point in the middle of the motion, in the right camera, mm."""
        return torch.tensor(self.config.scene.target_mm, dtype=torch.float64)


@dataclass(frozen=True)
class Trials:
    """A batch of simulated trials.

    Attributes:
        problem: what a method sees.
        exact: the same with the true poses and stereo extrinsics.
        truth: camera_right_T_arm (trials, 4, 4).
        setup: that they were simulated in.
    """

    problem: Problem
    exact: Problem
    truth: Tensor
    setup: Setup

    def bound(self, measurements: tuple[str, ...], cameras: int) -> Bound:
        """The Cramer-Rao bound for the simulated noise, from these measurements."""
        few = slice(0, _BOUND_TRIALS)
        part = self.exact.only(*measurements).cameras(cameras).take_trials(few)
        each = cramer_rao_bound(part, self.truth[few], self.setup.scene.shaft_end_offset_mm, SETTINGS)
        return bound_in_measures(each.mean(0), self.truth[0], self.setup.camera_p_working_point)


def make_setup(settings: SetupSettings) -> Setup:
    """The scene with the user's own robot and cameras, where there are any.

    Raises:
        FileError, RobotError, RecordingError: robot or stereo file that cannot be read.
        InputError: a robot that cannot take up the scene, or a working point out of the picture.
    """
    config = LineStudyConfig(
        rotation_range_deg=settings.rotation_range_deg,
        translation_range_mm=settings.translation_range_mm,
        pixel_noise_px=settings.pixel_noise_px,
    )
    cameras = read_cameras(settings)
    if cameras is not None:
        config = _with_picture(config, cameras.right)
    scene_settings, scene = make_scene(settings, config.scene, cameras)
    _check_in_view(config, scene_settings)
    is_pair = cameras is None or cameras.camera_left_T_camera_right is not None
    return Setup(scene, replace(config, scene=scene_settings), 2 if is_pair else 1)


def simulate(setup: Setup, condition: Condition, source: NoiseSource | None, trials: int, seed: int) -> Trials:
    """Simulated trials of a condition.

    Raises:
        InputError: the noise source names a level that there is not.
    """
    levels = dict(condition.levels)
    if source is not None:
        levels |= source.levels(condition.coefficient)
    known = {name for name in vars(setup.config) if name.endswith(("_noise_mm", "_noise_deg", "_noise_px"))}
    for name in levels:
        if name not in known:
            where = f"noise source {condition.noise}"
            raise InputError(where=where, expected=f"levels of {', '.join(sorted(known))}", found=name)
    config = replace(
        setup.config, trials=trials, seed=seed, motion=condition.motion, random_motions=condition.motions,
        positions_laparoscope=condition.laparoscope, positions_instrument=max(1, condition.instrument), **levels,
    )  # fmt: skip
    data = simulate_lines(config, scene=setup.scene)
    truth = data["truth"]
    exact = dict(data)
    exact |= {name: truth[name] for name in ("arm_T_rcm", "camera_left_T_camera_right")}
    if source is not None and source.disturb is not None:
        source.disturb(data, condition.coefficient, np.random.default_rng([seed, 1]))
    return Trials(
        Problem.from_arrays(data), Problem.from_arrays(exact), torch.as_tensor(truth["camera_right_T_arm"]), setup
    )


def _check_in_view(config: LineStudyConfig, scene: SceneSettings) -> None:
    """Refuse a working point that the picture does not show."""
    x, y, z = scene.target_mm
    half = config.half_width_px / config.focal_px, config.half_height_px / config.focal_px
    if z <= 0.0 or abs(x) > half[0] * z or abs(y) > half[1] * z:
        raise InputError(where="--target-mm", expected="a point in the right camera's picture", found=scene.target_mm)


def _with_picture(config: LineStudyConfig, right: Intrinsics) -> LineStudyConfig:
    """Focal length and picture of the right camera, without its distortion."""
    height, width = right.image_size
    return replace(
        config,
        focal_px=float(np.sqrt(right.fx * right.fy)),
        half_width_px=min(right.cx + 0.5, width - 0.5 - right.cx),
        half_height_px=min(right.cy + 0.5, height - 0.5 - right.cy),
    )
