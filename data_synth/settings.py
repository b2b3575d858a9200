"""Settings of the synthetic scenes. Unknown keys and impossible values are refused; every field says its unit in its name."""

from __future__ import annotations

from typing import Annotated, Literal

from pydantic import ConfigDict, Field
from pydantic.dataclasses import dataclass

_STRICT = ConfigDict(extra="forbid", allow_inf_nan=False, use_attribute_docstrings=True)

Vector = tuple[float, float, float]
NonNegative = Annotated[float, Field(ge=0)]
Positive = Annotated[float, Field(gt=0)]
Count = Annotated[int, Field(ge=1)]


@dataclass(frozen=True, config=_STRICT)
class SceneSettings:
    """Geometry of the scene; positions in the right camera's frame with all joints at home."""

    laparoscope_rcm_behind_mm: Positive = 120.0
    """Distance of the laparoscope's remote centre of motion behind the camera."""
    instrument_rcm_mm: Vector = (90.0, -40.0, 20.0)
    """The instrument's remote centre of motion."""
    target_mm: Vector = (-3.0, 2.0, 100.0)
    """Head point of the instrument."""
    hand_eye_rotvec_deg: Vector = (28.0, -47.0, 113.0)
    """Rotation of the unknown, camera_right_T_arm, as a rotation vector."""
    hand_eye_translation_mm: Vector = (12.0, -21.0, -32.0)
    """Translation of the unknown."""
    camera_home_rotvec_deg: Vector = (152.0, 18.0, -31.0)
    """Orientation of the camera in base."""
    camera_home_translation_mm: Vector = (45.0, -30.0, 160.0)
    """Position of the camera in base."""
    stereo_rotvec_deg: Vector = (0.05, 0.9, -0.1)
    """Rotation of camera_left_T_camera_right: slight vergence."""
    stereo_translation_mm: Vector = (4.9, 0.05, 0.1)
    """Translation of camera_left_T_camera_right: the baseline."""
    shaft_diameter_mm: Positive = 8.0
    """True diameter of the instrument's shaft."""
    wrist_length_mm: Positive = 10.0
    """The dark shaft ends this far before the head point (unknown to a calibration)."""


@dataclass(frozen=True, config=_STRICT)
class LineStudyConfig:
    """A Monte-Carlo study on lines without pictures: the scene of `SceneSettings`, both arms on a grid."""

    scene: SceneSettings = SceneSettings()
    """Geometry."""
    trials: Count = 10
    """Independent trials, the leading axis of every array."""
    seed: int = 0
    """Seed of all noise."""
    motion: Literal["grid", "random"] = "grid"
    """`grid`: positions_laparoscope^3 * positions_instrument^3 motions; `random`: `random_motions` uniform draws, other ones each trial."""
    positions_laparoscope: Count = 3
    """Positions a joint of the laparoscope (1: it stands still)."""
    positions_instrument: Count = 4
    """Positions a joint of the instrument."""
    random_motions: Count = 60
    """Number of motions when `motion` is `random`."""
    rotation_range_deg: NonNegative = 10.0
    """Full range of every revolute joint."""
    translation_range_mm: NonNegative = 20.0
    """Full range of every prismatic joint."""
    focal_px: Positive = 800.0
    """Focal length, turning pixels into normalised units."""
    half_width_px: Positive = 640.0
    """Half the picture's width: the axis is measured inside."""
    half_height_px: Positive = 480.0
    """Half the picture's height."""
    pixel_noise_px: NonNegative = 0.5
    """Noise of every image point, 1 sigma per coordinate."""
    kinematics_noise_mm: NonNegative = 0.0
    """Noise of the given arm_T_rcm of every motion, per axis (right perturbation)."""
    kinematics_noise_deg: NonNegative = 0.0
    """Rotational part of the same."""
    camera_noise_mm: NonNegative = 0.0
    """Noise of the pose that each camera sees, per axis, motion and camera."""
    camera_noise_deg: NonNegative = 0.0
    """Rotational part of the same."""
    stereo_noise_mm: NonNegative = 0.0
    """Noise of the given camera_left_T_camera_right, once a trial."""
    stereo_noise_deg: NonNegative = 0.0
    """Rotational part of the same."""
    random_hand_eye: bool = False
    """Draw another camera_right_T_arm for every trial (rotation uniform on SO(3)); the camera's view stays the same."""
