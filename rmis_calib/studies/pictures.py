"""Measurements from rendered pictures through the whole vision pipeline, with the truth: one set-up, many motions.

Pictures are rendered without noise in the kinematics; trials then draw noise of their own, so that all trials of a
set-up share its pictures.
"""

import tempfile
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np

from data_synth import SynthConfig, load_synth_config, write_recording
from data_synth.kinematics import Array, random_rotations
from data_synth.world import World, build_world
from rmis_calib.errors import InputError
from rmis_calib.geometry.rotations import matrix_to_rotvec
from rmis_calib.io.atomic import atomic_write
from rmis_calib.studies.settings import PictureSettings

_HAND_EYE_MM = 40.0
"""Length of the translation of a hand-eye transform that is drawn."""


@dataclass(frozen=True)
class Measured:
    """Everything that the pictures of a set-up say, and the truth.

    Attributes:
        lines: arrays in the keys of an observations file, the motions of the calibration and then those of the
            validation; `arm_T_rcm` is true.
        board: `base_T_arm` (n, 4, 4), true, and `camera_right_T_board`, `camera_left_T_board`, measured; empty where
            there is no board.
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


def world_config(pictures: PictureSettings, motions: int, seed: int, experiment: int) -> SynthConfig:
    """What is rendered: the scene's own hand-eye transform in experiment 0, a random one in the others.

    Raises:
        InputError: no such preset.
    """
    try:
        config = load_synth_config(pictures.preset)
    except (FileNotFoundError, ValueError) as error:
        raise InputError(" ".join(str(error).split()), where="--preset") from error
    scene = config.scene
    if experiment > 0:
        import torch

        generator = np.random.default_rng([seed, experiment])
        rotvec = matrix_to_rotvec(torch.as_tensor(random_rotations(generator, ())))
        direction = generator.standard_normal(3)
        scene = replace(
            scene,
            hand_eye_rotvec_deg=tuple(np.degrees(rotvec.numpy()).tolist()),
            hand_eye_translation_mm=tuple((_HAND_EYE_MM * direction / np.linalg.norm(direction)).tolist()),
        )
    motion = replace(
        config.motion,
        rotation_range_deg=pictures.rotation_range_deg,
        translation_range_mm=pictures.translation_range_mm,
    )
    noise = replace(config.noise, kinematics_mm=0.0, kinematics_deg=0.0)
    return replace(config, scene=scene, motion=motion, noise=noise, motions=motions, seed=seed + experiment)


def measure(config: SynthConfig, board_poses: int, report: Any = lambda *_: None) -> Measured:
    """Render a set-up, find its shafts, and measure a board in it.

    Args:
        config: what is rendered.
        board_poses: pictures of the board; 0: none.
        report: progress callback.

    Raises:
        InputError: the preset lacks what the studies need.
    """
    from rmis_calib.io import load_recording
    from rmis_calib.pipeline import run_calibration

    world = build_world(config)
    if config.camera.left is None or config.motion.laparoscope != "moving":
        raise InputError(where="--preset", expected="two cameras and a moving laparoscope", found="another preset")
    with tempfile.TemporaryDirectory(prefix="rmis-calib-study-") as folder:
        path = write_recording(Path(folder) / "recording", config)
        run = run_calibration(load_recording(path), progress=report)
    if run.observations is None:
        raise InputError(where="--preset", expected="pictures in which shafts are found", found="none")
    lines = {
        key: np.asarray(value)
        for key, value in vars(run.observations).items()
        if isinstance(value, (np.ndarray, float))
    }
    board = {} if board_poses == 0 else _board(world, board_poses, config.seed)
    right = world.cameras["right"]
    return Measured(lines, board, world.scene.camera_right_T_arm, float(np.sqrt(right.fx * right.fy)))


def _board(world: World, count: int, seed: int) -> dict[str, Array]:
    from rmis_calib.studies.board import measure_board

    poses = measure_board(world, count, np.random.default_rng([seed, 2]))
    return {
        "base_T_arm": poses.base_T_arm,
        "camera_right_T_board": poses.camera_T_board["right"],
        "camera_left_T_board": poses.camera_T_board["left"],
        "camera_left_T_camera_right": world.scene.camera_left_T_camera_right,
    }
