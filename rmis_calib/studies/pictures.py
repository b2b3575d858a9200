"""Measurements from rendered pictures through the whole vision pipeline, with the truth: one set-up, many motions.

Pictures are rendered without noise in the kinematics; trials then draw noise of their own, so that all trials of a
set-up share its pictures.
"""

import tempfile
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
from pydantic import ValidationError

from data_synth import SynthConfig, load_synth_config, write_recording
from data_synth.cameras import build_camera
from data_synth.kinematics import Array, random_rotations, rigid, transform_points
from data_synth.scene import Scene
from data_synth.settings_picture import CameraSettings, IntrinsicsSettings
from data_synth.world import World, build_world, comfortably_in_view
from rmis_calib.errors import InputError
from rmis_calib.io.atomic import atomic_write
from rmis_calib.io.intrinsics import Intrinsics, StereoFile
from rmis_calib.studies.equipment import make_scene, read_cameras
from rmis_calib.studies.settings import EquipmentSettings, PictureSettings

_HAND_EYE_MM = 40.0
"""Length of the translation of a hand-eye transform that is drawn."""


@dataclass(frozen=True)
class Measured:
    """Everything that the pictures of a set-up say, and the truth.

    Attributes:
        lines: arrays in the keys of an observations file, the motions of the calibration and then those of the
            validation; `arm_T_rcm` is true.
        board: `base_T_arm` (n, 4, 4), true, and `camera_right_T_board`, measured, with two cameras also
            `camera_left_T_board` and the extrinsics; empty where there is no board.
        camera_right_T_arm: the truth.
        focal_px: of the right camera.
    """

    lines: dict[str, Array]
    board: dict[str, Array]
    camera_right_T_arm: Array
    focal_px: float

    def save(self, path: Path) -> None:
        """Write an .npz, whole or not at all."""
        arrays: dict[str, Any] = {f"lines.{key}": value for key, value in self.lines.items()}
        arrays |= {f"board.{key}": value for key, value in self.board.items()}
        with atomic_write(path) as temporary:
            np.savez_compressed(temporary, camera_right_T_arm=self.camera_right_T_arm, focal_px=self.focal_px, **arrays)

    @classmethod
    def load(cls, path: Path) -> "Measured":
        """Read what `save` wrote."""
        with np.load(path) as stored:
            arrays = dict(stored)
        parts = {
            part: {key.removeprefix(f"{part}."): value for key, value in arrays.items() if key.startswith(f"{part}.")}
            for part in ("lines", "board")
        }
        return cls(parts["lines"], parts["board"], arrays["camera_right_T_arm"], float(arrays["focal_px"]))


@dataclass(frozen=True)
class Stage:
    """What is rendered.

    Attributes:
        config: appearance, cameras and motion; no noise of the kinematics.
        scene: arms and fixed transforms.
    """

    config: SynthConfig
    scene: Scene

    @property
    def n_cameras(self) -> int:
        return 1 if self.config.camera.left is None else 2


def staged(pictures: PictureSettings, equipment: EquipmentSettings, motions: int, seed: int, experiment: int) -> Stage:
    """What is rendered: with the scene's or the robot's own hand-eye transform in experiment 0, a random one in the
    others.

    Raises:
        FileError, RobotError, RecordingError: robot or camera file that cannot be read.
        InputError: no such preset, a laparoscope that stands still in it, a lens that cannot be rendered, a robot that
            cannot take up the scene, or a working point out of the picture.
    """
    try:
        config = load_synth_config(pictures.preset)
    except (FileNotFoundError, ValueError) as error:
        raise InputError(" ".join(str(error).split()), where="--preset") from error
    if config.motion.laparoscope != "moving":
        raise InputError(
            where="--preset", expected="a moving laparoscope", found=f"one that is {config.motion.laparoscope}"
        )
    cameras = read_cameras(equipment)
    hand_eye = None if experiment == 0 else _random_hand_eye(np.random.default_rng([seed, experiment]))
    scene_settings, scene = make_scene(equipment, config.scene, cameras, hand_eye)
    config = replace(
        config,
        camera=config.camera if cameras is None else _with_lenses(config.camera, cameras),
        scene=scene_settings,
        motion=replace(
            config.motion,
            rotation_range_deg=equipment.rotation_range_deg,
            translation_range_mm=equipment.translation_range_mm,
        ),
        noise=replace(config.noise, kinematics_mm=0.0, kinematics_deg=0.0),
        motions=motions,
        seed=seed + experiment,
    )
    _check_in_view(config, scene)
    return Stage(config, scene)


def _random_hand_eye(generator: np.random.Generator) -> Array:
    """camera_right_T_arm (4, 4)."""
    rotation = random_rotations(generator, ())
    direction = generator.standard_normal(3)
    return rigid(rotation, _HAND_EYE_MM * direction / np.linalg.norm(direction))


def _with_lenses(settings: CameraSettings, cameras: StereoFile) -> CameraSettings:
    """The user's intrinsics and picture size; blur, light and sensor of the preset."""
    height, width = cameras.right.image_size
    try:
        return replace(
            settings,
            width_px=width,
            height_px=height,
            right=_lens(cameras.right),
            left=None if cameras.left is None else _lens(cameras.left),
        )
    except ValidationError as error:
        found = "; ".join(item["msg"] for item in error.errors())
        raise InputError(where="--stereo", expected="cameras that can be rendered", found=found) from error


def _lens(camera: Intrinsics) -> IntrinsicsSettings:
    if camera.model == "equidistant" or any(camera.distortion[5:]):
        raise InputError(
            where="--stereo",
            expected="lenses of k1, k2, p1, p2, k3: others cannot be rendered (undistort, or use a study of lines)",
            found=f"{camera.model} {list(camera.distortion)}",
        )
    k1, k2, p1, p2, k3 = camera.distortion[:5]
    return IntrinsicsSettings(camera.fx, camera.fy, camera.cx, camera.cy, (k1, k2, p1, p2, k3))


def _check_in_view(config: SynthConfig, scene: Scene) -> None:
    """Refuse a working point that not all cameras show in the middle of the motion."""
    camera = config.camera
    sides = {"right": (camera.right, np.eye(4)), "left": (camera.left, scene.camera_left_T_camera_right)}
    for side, (intrinsics, camera_T_camera_right) in sides.items():
        if intrinsics is None:
            continue
        p = transform_points(camera_T_camera_right, np.asarray(config.scene.target_mm, dtype=float))
        try:
            is_seen = p[2] > 0.0 and comfortably_in_view(build_camera(camera, intrinsics), p)
        except ValueError as error:
            raise InputError(f"{error}", where="--stereo") from error
        if not is_seen:
            raise InputError(
                where="--target-mm",
                expected=f"a point well inside the {side} camera's picture",
                found=config.scene.target_mm,
            )


def measure(stage: Stage, board_poses: int, report: Any = lambda *_: None) -> Measured:
    """Render a set-up, find its shafts, and measure a board in it.

    Args:
        stage: what is rendered.
        board_poses: pictures of the board; 0: none.
        report: called with what is done, and how much of how much.

    Raises:
        InputError: no shaft is found, or a board out of sight.
    """
    from rmis_calib.io import load_recording
    from rmis_calib.pipeline import run_calibration

    with tempfile.TemporaryDirectory(prefix="rmis-calib-study-") as folder:
        path = write_recording(
            Path(folder) / "recording", stage.config, scene=stage.scene,
            on_progress=lambda done, total: report("rendering", done, 2 * total),
        )  # fmt: skip
        run = run_calibration(
            load_recording(path), progress=lambda stage, done, total: report(stage, total + done, 2 * total)
        )
    if run.observations is None:
        raise InputError(where="--preset", expected="pictures in which shafts are found", found="none")
    lines = {
        key: np.asarray(value)
        for key, value in vars(run.observations).items()
        if isinstance(value, (np.ndarray, float))
    }
    world = build_world(stage.config, stage.scene)
    board = {} if board_poses == 0 else _board(world, board_poses, stage.config.seed)
    right = world.cameras["right"]
    return Measured(lines, board, world.scene.camera_right_T_arm, float(np.sqrt(right.fx * right.fy)))


def _board(world: World, count: int, seed: int) -> dict[str, Array]:
    from rmis_calib.studies.board import measure_board

    poses = measure_board(world, count, np.random.default_rng([seed, 2]))
    seen = {f"camera_{side}_T_board": pose for side, pose in poses.camera_T_board.items()}
    extrinsics = {"camera_left_T_camera_right": world.scene.camera_left_T_camera_right} if len(seen) == 2 else {}
    return {"base_T_arm": poses.base_T_arm} | seen | extrinsics
