"""Trials of a study: simulated by `data_synth`, which shares no code with the solver that they are for."""

from dataclasses import dataclass, replace
from typing import Any, Literal

import numpy as np
import torch
from torch import Tensor

from data_synth import LineStudyConfig, SceneSettings, simulate_lines
from data_synth.kinematics import Arm, Joint
from data_synth.own_robot import MOVING_JOINTS, scene_with_arms
from data_synth.scene import Scene, build_scene
from rmis_calib.errors import InputError, RobotError
from rmis_calib.geometry.rotations import matrix_to_rotvec
from rmis_calib.io.robot import load_robot
from rmis_calib.io.stereo import read_stereo
from rmis_calib.robot import Arm as RobotArm
from rmis_calib.solver import Problem
from rmis_calib.studies.builtin import SETTINGS
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
        InputError: a robot that cannot take up the scene.
    """
    names = ("laparoscope_rcm_behind_mm", "instrument_rcm_mm", "target_mm", "shaft_diameter_mm")
    changes: dict[str, Any] = {name: getattr(settings, name) for name in names if getattr(settings, name) is not None}
    config = LineStudyConfig(
        rotation_range_deg=settings.rotation_range_deg,
        translation_range_mm=settings.translation_range_mm,
        pixel_noise_px=settings.pixel_noise_px,
    )
    cameras = 2
    if settings.stereo is not None:
        config, extrinsics = _with_cameras(config, settings)
        changes |= extrinsics
        cameras = 2 if extrinsics else 1
    config = replace(config, scene=replace(SceneSettings(), **changes))
    scene = build_scene(config.scene) if settings.robot is None else _with_robot(settings, config.scene)
    return Setup(scene, config, cameras)


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


def _with_cameras(config: LineStudyConfig, settings: SetupSettings) -> tuple[LineStudyConfig, dict[str, Any]]:
    """Focal length and picture of the right camera; extrinsics as scene settings, none for a single camera."""
    assert settings.stereo is not None
    stereo = read_stereo(settings.stereo)
    right, (height, width) = stereo.right, stereo.right.image_size
    config = replace(
        config,
        focal_px=float(np.sqrt(right.fx * right.fy)),
        half_width_px=min(right.cx + 0.5, width - 0.5 - right.cx),
        half_height_px=min(right.cy + 0.5, height - 0.5 - right.cy),
    )
    matrix = stereo.camera_left_T_camera_right
    if matrix is None:
        return config, {}
    rotvec_deg = torch.rad2deg(matrix_to_rotvec(torch.as_tensor(matrix[:3, :3])))
    return config, {
        "stereo_rotvec_deg": tuple(rotvec_deg.tolist()),
        "stereo_translation_mm": tuple(matrix[:3, 3].tolist()),
    }


def _with_robot(settings: SetupSettings, scene: SceneSettings) -> Scene:
    assert settings.robot is not None
    robot = load_robot(settings.robot)
    for name, value in (("laparoscope-arm", settings.laparoscope_arm), ("instrument-arm", settings.instrument_arm)):
        if value not in robot.arms:
            raise RobotError(where=f"--{name}", expected=f"one of {', '.join(robot.arms)}", found=value)
    laparoscope, instrument = robot.arms[settings.laparoscope_arm], robot.arms[settings.instrument_arm]
    if not instrument.is_instrument:
        expected = "an arm with rcm_frame, shaft_frame and head_point"
        raise RobotError(where="--instrument-arm", expected=expected, found=settings.instrument_arm)
    arms = (_synthetic(laparoscope, robot.dh_convention), _synthetic(instrument, robot.dh_convention))
    try:
        placed = scene_with_arms(scene, *arms)
    except ValueError as error:
        raise RobotError(f"{error}", where=f"robot {robot.name}") from error
    _check_limits(laparoscope, placed.laparoscope_home, settings, settings.laparoscope_arm)
    _check_limits(instrument, placed.instrument_home, settings, settings.instrument_arm)
    return placed


def _synthetic(arm: RobotArm, convention: Any) -> Arm:
    """The arm in the generator's own kinematics; where its base stands is left to the scene."""
    joints = tuple(
        Joint(j.name, j.type, j.alpha_rad, j.a_mm, j.theta_rad, j.d_mm, j.offset) for j in arm.joints
    )  # fmt: skip
    head = arm.head_point
    return Arm(
        base_T_arm_base=np.eye(4),
        joints=joints,
        convention=convention,
        end_T_tool=arm.end_T_tool,
        rcm_frame=arm.rcm_frame or 0,
        shaft_frame=len(joints) if arm.shaft_frame is None else arm.shaft_frame,
        head_frame=len(joints) if head is None else head.frame,
        head_xyz_mm=(0.0, 0.0, 0.0) if head is None else head.xyz_mm,
    )


def _check_limits(arm: RobotArm, home: np.ndarray, settings: SetupSettings, name: str) -> None:
    """Refuse motions beyond the joints' limits."""
    for joint, at in zip(arm.joints[:MOVING_JOINTS], home, strict=False):
        revolute = joint.type == "revolute"
        half = 0.5 * (np.deg2rad(settings.rotation_range_deg) if revolute else settings.translation_range_mm)
        least = -np.inf if joint.min is None else joint.min
        most = np.inf if joint.max is None else joint.max
        if at - half < least or at + half > most:
            unit, scale = ("deg", 180.0 / np.pi) if revolute else ("mm", 1.0)
            raise InputError(
                where=f"{name}.{joint.name}",
                expected=f"readings within its limits, {scale * least:.1f} to {scale * most:.1f} {unit}",
                found=f"{scale * (at - half):.1f} to {scale * (at + half):.1f} {unit}; change the ranges, or where the "
                "scene is (--laparoscope-rcm-behind-mm, --instrument-rcm-mm, --target-mm)",
            )
