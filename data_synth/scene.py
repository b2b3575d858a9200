"""The operating scene: two arms that pivot about their remote centres of motion, and the transform that a calibration
must find.

Every number of the geometry is in `SceneSettings` (settings.py); here they become DH tables and exact float64 poses.
Frames: `base`, `arm` (end of the laparoscope's arm), `rcm` (the instrument's remote centre of motion), `camera_right`,
`camera_left`.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np

from data_synth.kinematics import (
    Arm,
    Array,
    Convention,
    Joint,
    arm_to_dict,
    rigid,
    rigid_inverse,
    rotation_from_rotvec,
    transform_points,
)
from data_synth.settings import SceneSettings

HALF_PI = np.pi / 2.0
CAMERA_T_END = rigid(rotation_from_rotvec([0.0, 0.0, 0.6]), [0.0, 0.0, -20.0])
"""Last DH frame of the laparoscope's arm in the right camera: on the optical axis, 20 mm behind it, so that
`end_T_tool` is not the identity."""
MOVING_JOINTS = 3
"""The first joints of an arm pivot about the RCM and insert; any after them (roll, wrist) stay at home."""


@dataclass(frozen=True)
class Scene:
    """Arms and fixed transforms; `*_home` are the joint readings in the middle of the motion (rad, rad, mm)."""

    laparoscope: Arm
    instrument: Arm
    laparoscope_home: Array
    instrument_home: Array
    camera_right_T_arm: Array
    camera_left_T_camera_right: Array
    base_T_camera_home: Array
    shaft_radius_mm: float
    shaft_end_offset_mm: float

    def robot_dict(
        self, name: str, *, laparoscope: bool = True, offset_sigma: Mapping[str, float] | None = None
    ) -> dict:
        """The content of robot.yaml; `offset_sigma` as in `arm_to_dict`."""
        told = {"offset_sigma": offset_sigma}
        arms = {"laparoscope": arm_to_dict(self.laparoscope, instrument=False, **told)} if laparoscope else {}
        exact = {"rcm_sigma_mm": 0.0}
        exact |= {"setup_sigma_mm": 0.0, "setup_sigma_deg": 0.0} if laparoscope else {}
        return {
            "name": name,
            "dh_convention": self.instrument.convention,
            **exact,
            "arms": arms | {"instrument": arm_to_dict(self.instrument, instrument=True, **told)},
        }


def _rcm_joints(insertion_offset_mm: float) -> tuple[Joint, ...]:
    """Yaw, pitch and insertion through one point: the z axis of the last frame is the shaft and passes through the
    origin of frame 0."""
    return (
        Joint("yaw", "revolute", HALF_PI, 0.0, 0.0, 0.0, HALF_PI),
        Joint("pitch", "revolute", -HALF_PI, 0.0, 0.0, 0.0, -HALF_PI),
        Joint("insertion", "prismatic", HALF_PI, 0.0, 0.0, 0.0, insertion_offset_mm),
    )


def frame_along(direction: Array, roll_rad: float) -> Array:
    """Rotation whose z axis is `direction`, turned by `roll_rad` about it."""
    z = direction / np.linalg.norm(direction)
    helper = np.eye(3)[int(np.argmin(np.abs(z)))]
    x = np.cross(helper, z)
    x /= np.linalg.norm(x)
    frame = np.stack([x, np.cross(z, x), z], axis=-1)
    return frame @ rotation_from_rotvec([0.0, 0.0, roll_rad])


def place_arm(joints: tuple[Joint, ...], home: Array, base_T_end: Array, convention: Convention = "modified") -> Array:
    """base_T_arm_base that puts the last frame at `base_T_end` when the readings are `home`."""
    arm_base_T_end = Arm(np.eye(4), joints, convention).frames(home)[-1]
    return base_T_end @ rigid_inverse(arm_base_T_end)


def build_scene(settings: SceneSettings) -> Scene:
    """Scene whose geometry, seen from the right camera with all joints at home, is that of `settings`.

    Convention: positions in `settings` are in camera_right at home; the laparoscope's shaft is its optical axis.
    """
    camera_right_T_arm = rigid(
        rotation_from_rotvec(np.deg2rad(settings.hand_eye_rotvec_deg)), settings.hand_eye_translation_mm
    )
    base_T_camera_home = rigid(
        rotation_from_rotvec(np.deg2rad(settings.camera_home_rotvec_deg)), settings.camera_home_translation_mm
    )
    laparoscope, laparoscope_home = _laparoscope(settings, base_T_camera_home, camera_right_T_arm)
    instrument, instrument_home = _instrument(settings, base_T_camera_home)
    return Scene(
        laparoscope=laparoscope,
        instrument=instrument,
        laparoscope_home=laparoscope_home,
        instrument_home=instrument_home,
        camera_right_T_arm=camera_right_T_arm,
        camera_left_T_camera_right=rigid(
            rotation_from_rotvec(np.deg2rad(settings.stereo_rotvec_deg)), settings.stereo_translation_mm
        ),
        base_T_camera_home=base_T_camera_home,
        shaft_radius_mm=settings.shaft_diameter_mm / 2.0,
        shaft_end_offset_mm=-settings.wrist_length_mm,
    )


def _laparoscope(settings: SceneSettings, base_T_camera_home: Array, camera_T_arm: Array) -> tuple[Arm, Array]:
    """The laparoscope's arm and its home readings."""
    joints = _rcm_joints(insertion_offset_mm=15.0)
    home = np.array([0.10, -0.15, settings.laparoscope_rcm_behind_mm - 20.0 - 15.0])
    base_T_arm_base = place_arm(joints, home, base_T_camera_home @ CAMERA_T_END)
    return Arm(base_T_arm_base, joints, end_T_tool=rigid_inverse(CAMERA_T_END) @ camera_T_arm), home


def _instrument(settings: SceneSettings, base_T_camera_home: Array) -> tuple[Arm, Array]:
    """The instrument's arm and its home readings. The head point (the axis of the claspers) is on the shaft's axis, a
    little beyond the last DH frame."""
    camera_p_rcm = np.asarray(settings.instrument_rcm_mm, dtype=np.float64)
    camera_v_axis = np.asarray(settings.target_mm, dtype=np.float64) - camera_p_rcm
    head_beyond_end_mm = 4.0
    camera_T_head = rigid(frame_along(camera_v_axis, roll_rad=-0.9), settings.target_mm)
    end_T_head = rigid(np.eye(3), [0.0, 0.0, head_beyond_end_mm])
    joints = _rcm_joints(insertion_offset_mm=-30.0)
    home = np.array([-0.20, 0.12, float(np.linalg.norm(camera_v_axis)) - head_beyond_end_mm + 30.0])
    base_T_arm_base = place_arm(joints, home, base_T_camera_home @ camera_T_head @ rigid_inverse(end_T_head))
    head = (0.0, 0.0, head_beyond_end_mm)
    return Arm(base_T_arm_base, joints, rcm_frame=0, shaft_frame=3, head_frame=3, head_xyz_mm=head), home


def half_range(arm: Arm, rotation_range_deg: float, translation_range_mm: float) -> Array:
    """How far (3,) the moving joints of an arm go to either side of home, rad or mm."""
    full = {"revolute": np.deg2rad(rotation_range_deg), "prismatic": translation_range_mm}
    return 0.5 * np.array([full[joint.kind] for joint in arm.joints[:MOVING_JOINTS]])


def moved_from(home: Array, change: Array) -> Array:
    """Readings (..., J) of an arm whose moving joints are off home (J,) by `change` (..., 3)."""
    out = np.broadcast_to(home, (*change.shape[:-1], len(home))).copy()
    out[..., :MOVING_JOINTS] += change
    return out


@dataclass(frozen=True)
class Poses:
    """What the joint readings say (...: any batch): poses (..., 4, 4), axis and head point (..., 3), nominal shaft end
    (...), mm."""

    base_T_arm: Array
    arm_T_rcm: Array
    rcm_v_axis: Array
    rcm_p_head: Array
    rcm_s_end_mm: Array


def poses_at(scene: Scene, laparoscope_readings: Array, instrument_readings: Array) -> Poses:
    """Forward kinematics of both arms at readings (..., J) of each."""
    base_T_arm = scene.laparoscope.tool(laparoscope_readings)
    shaft = scene.instrument.shaft(instrument_readings)
    return Poses(
        base_T_arm, rigid_inverse(base_T_arm) @ shaft.base_T_rcm, shaft.rcm_v_axis, shaft.rcm_p_head, shaft.rcm_s_end_mm
    )


@dataclass(frozen=True)
class ShaftInCamera:
    """One shaft seen from one camera: points on the axis at coordinate s are camera_p_rcm + s camera_v_axis; (..., 3)
    and (...), mm."""

    camera_p_rcm: Array
    camera_v_axis: Array
    s_end_mm: Array
    camera_p_head: Array
    radius_mm: float

    def axis_point(self, s_mm: Array | float) -> Array:
        """Points (..., 3) on the axis at coordinates s (...)."""
        return self.camera_p_rcm + np.asarray(s_mm)[..., None] * self.camera_v_axis


def shaft_in_camera(scene: Scene, camera_T_rcm: Array, poses: Poses) -> ShaftInCamera:
    """The instrument's shaft in a camera, from the true pose of the RCM frame (..., 4, 4) in it."""
    return ShaftInCamera(
        camera_p_rcm=camera_T_rcm[..., :3, 3],
        camera_v_axis=np.einsum("...ij,...j->...i", camera_T_rcm[..., :3, :3], poses.rcm_v_axis),
        s_end_mm=np.broadcast_to(poses.rcm_s_end_mm + scene.shaft_end_offset_mm, camera_T_rcm.shape[:-2]),
        camera_p_head=transform_points(camera_T_rcm, poses.rcm_p_head),
        radius_mm=scene.shaft_radius_mm,
    )
