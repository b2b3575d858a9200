"""Settings of the synthetic scenes. Unknown keys and impossible values are refused; every field says its unit in its
name."""

from __future__ import annotations

from typing import Annotated, Literal

from pydantic import ConfigDict, Field
from pydantic.dataclasses import dataclass

from data_synth.settings_picture import CameraSettings, LookSettings

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
    """`grid`: positions_laparoscope^3 * positions_instrument^3 motions; `random`: `random_motions` uniform draws, other
    ones each trial."""
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
    shaft_sag_mm: NonNegative = 0.0
    """Bend of the shaft, in a plane fixed to it: an arc over the 60 mm before its end (as much as these scenes show),
    this far from the straight line between both ends of it in the middle."""
    random_hand_eye: bool = False
    """Draw another camera_right_T_arm for every trial (rotation uniform on SO(3)); the camera's view stays the same."""


@dataclass(frozen=True, config=_STRICT)
class MotionSettings:
    """How the arms move and how that is logged."""

    kind: Literal["random", "grid", "smooth"] = "random"
    """`random`: stops at random places; `grid`: stops on a grid of joint positions; `smooth`: continuous video."""
    laparoscope: Literal["moving", "static", "unlogged"] = "moving"
    """`static`: logged but still; `unlogged`: still, and not in the recording (laparoscope_arm: null)."""
    rotation_range_deg: NonNegative = 10.0
    """Full range of the revolute joints."""
    translation_range_mm: NonNegative = 20.0
    """Full range of the prismatic joints."""
    positions_laparoscope: Count = 3
    """Grid positions a joint of the laparoscope; a seeded choice of the grid when it has more places than there are
    motions."""
    positions_instrument: Count = 3
    """Grid positions a joint of the instrument."""
    stop_period_s: Positive = 0.5
    """Time between two stops (`random` and `grid`); the frame is taken in the middle of the rest."""
    frame_rate_hz: Positive = 30.0
    """Frame rate of `smooth`."""
    speed: Positive = 1.0
    """Speed of `smooth`: 1 is a hand of a few centimetres a second."""
    joint_rate_hz: Positive = 50.0
    """Rate of joints.csv."""
    keep_end_in_view: bool = True
    """Draw `random` stops again until the shaft's end and the head point are in both pictures; of a `grid`, prefer the
    places where they are."""


@dataclass(frozen=True, config=_STRICT)
class NoiseSettings:
    """How far the log is from the truth. Defaults: a well-calibrated robot."""

    kinematics_mm: NonNegative = 0.1
    """Translation noise of the instrument's pose against the joints, per axis and motion: the seen arm_T_rcm is the
    logged one, right-multiplied."""
    kinematics_deg: NonNegative = 0.03
    """Rotational part of the same."""
    joint_reading_deg: NonNegative = 0.0
    """White noise of logged revolute joints."""
    joint_reading_mm: NonNegative = 0.0
    """White noise of logged prismatic joints."""
    stereo_mm: NonNegative = 0.0
    """Error of the given stereo extrinsics, translation per axis."""
    stereo_deg: NonNegative = 0.0
    """Error of the given stereo extrinsics, rotation per axis."""
    joint_offset_deg: NonNegative = 0.0
    """Constant error of each logged revolute joint, drawn once, 1 sigma: truth = reading + offset."""
    joint_offset_mm: NonNegative = 0.0
    """Constant error of each logged prismatic joint."""
    joint_offset_told: bool = False
    """robot.yaml states the two above as each joint's `offset_sigma`."""
    clock_offset_s: float = 0.0
    """Time of a joint sample minus the time of the frame that shows it; not told to the calibration."""
    timestamp_noise_s: NonNegative = 0.0
    """White noise of the frames' recorded times."""
    frame_jitter_s: NonNegative = 0.0
    """Spread of the instants at which frames are taken; recorded correctly."""
    dropped_fraction: Annotated[float, Field(ge=0, le=0.9)] = 0.0
    """Share of frames that never arrive (`smooth`)."""
    shaft_diameter_error_mm: float = 0.0
    """Given minus true diameter of the shaft."""
    head_point_px: NonNegative = 0.3
    """Noise of head_points.csv."""


@dataclass(frozen=True, config=_STRICT)
class OutputSettings:
    """How the pictures are stored."""

    pictures: Literal["video", "images"] = "video"
    """H.264 (yuv444p) or folders of PNG."""
    crf: Annotated[int, Field(ge=0, le=51)] = 10
    """H.264 quality: 0 is lossless."""


@dataclass(frozen=True, config=_STRICT)
class SynthConfig:
    """A synthetic recording."""

    seed: int = 0
    """Seed of everything that is random."""
    motions: Count = 60
    """Number of frames."""
    scene: SceneSettings = SceneSettings()
    """Geometry."""
    camera: CameraSettings = CameraSettings()
    """Cameras."""
    motion: MotionSettings = MotionSettings()
    """Motion of the arms."""
    noise: NoiseSettings = NoiseSettings()
    """Errors of the log."""
    look: LookSettings = LookSettings()
    """Appearance."""
    output: OutputSettings = OutputSettings()
    """Storage."""
