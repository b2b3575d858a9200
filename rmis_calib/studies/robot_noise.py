"""Noise of the robot and of the stereo extrinsics, drawn by trials on rendered pictures, which have noise of their
own."""

from collections.abc import Mapping
from dataclasses import dataclass, fields
from typing import Any

import numpy as np

from data_synth.kinematics import Array, pose_noise
from rmis_calib.errors import InputError
from rmis_calib.studies.registry import NoiseSource, find_noise_source
from rmis_calib.studies.settings import PictureSettings


@dataclass(frozen=True)
class Levels:
    """1 sigma per axis: of each arm's end pose, once a motion; of the extrinsics, once a trial."""

    kinematics_noise_mm: float
    kinematics_noise_deg: float
    stereo_noise_mm: float = 0.0
    stereo_noise_deg: float = 0.0


@dataclass(frozen=True)
class RobotNoise:
    """What becomes of exact poses.

    Attributes:
        levels: of white noise.
        source: what else it does to the arrays.
        coefficient: of the source.
    """

    levels: Levels
    source: NoiseSource | None
    coefficient: float

    @classmethod
    def of(cls, pictures: PictureSettings) -> "RobotNoise":
        """Noise as the settings have it.

        Raises:
            InputError: no such noise source, or it has levels that rendered pictures cannot have.
        """
        named = {"kinematics_noise_mm": pictures.kinematics_noise_mm}
        named |= {"kinematics_noise_deg": pictures.kinematics_noise_deg}
        source = None if pictures.source is None else find_noise_source(pictures.source)
        if source is not None:
            named |= _possible(source, source.levels(pictures.coefficient))
        return cls(Levels(**named), source, pictures.coefficient)

    def arm(self, shape: tuple[int, ...], generator: np.random.Generator) -> Array:
        """What right-multiplies true end poses of an arm, (*shape, 4, 4)."""
        sigma_rad = float(np.deg2rad(self.levels.kinematics_noise_deg))
        return pose_noise(generator, shape, sigma_rad, self.levels.kinematics_noise_mm)

    def logged(self, arm_T_rcm: Array, generator: np.random.Generator) -> Array:
        """What a robot whose two arms are both noisy says of true poses (..., 4, 4)."""
        shape = arm_T_rcm.shape[:-2]
        noisy_arm = np.linalg.inv(self.arm(shape, generator))
        return noisy_arm @ arm_T_rcm @ self.arm(shape, generator)

    def extrinsics(self, camera_left_T_camera_right: Array, trials: int, generator: np.random.Generator) -> Array:
        """Stereo extrinsics (trials, 4, 4) as each trial is told them."""
        told = np.broadcast_to(camera_left_T_camera_right, (trials, 4, 4)).copy()
        if self.levels.stereo_noise_mm == self.levels.stereo_noise_deg == 0.0:
            return told
        sigma_rad = float(np.deg2rad(self.levels.stereo_noise_deg))
        return told @ pose_noise(generator, (trials,), sigma_rad, self.levels.stereo_noise_mm)

    def disturb(self, arrays: dict[str, Any], generator: np.random.Generator) -> None:
        """What else the source does to the arrays of an observations file."""
        if self.source is not None and self.source.disturb is not None:
            self.source.disturb(arrays, self.coefficient, generator)

    def disturb_board(self, arrays: dict[str, Any], generator: np.random.Generator) -> None:
        """What else the source does to poses of a board."""
        if self.source is not None and self.source.disturb_board is not None:
            self.source.disturb_board(arrays, self.coefficient, generator)


def _possible(source: NoiseSource, levels: Mapping[str, float]) -> dict[str, float]:
    known = [field.name for field in fields(Levels)]
    for name, value in levels.items():
        if name not in known and value:
            raise InputError(
                where=f"noise source {source.name}",
                expected=f"levels of {', '.join(known)} (rendered pictures have noise of their own)",
                found=name,
            )
    return {name: value for name, value in levels.items() if name in known}
