"""The user's own robot and cameras in the generator's terms, for studies with and without pictures."""

from dataclasses import replace
from typing import Any

import numpy as np
import torch

from data_synth import SceneSettings
from data_synth.kinematics import Arm, Array, Joint, rigid_inverse
from data_synth.own_robot import MOVING_JOINTS, scene_with_arms
from data_synth.scene import CAMERA_T_END, Scene, build_scene
from rmis_calib.errors import InputError, RobotError
from rmis_calib.geometry.rotations import matrix_to_rotvec
from rmis_calib.io.intrinsics import StereoFile
from rmis_calib.io.robot import load_robot
from rmis_calib.io.stereo import read_stereo
from rmis_calib.robot import Arm as RobotArm
from rmis_calib.studies.settings import EquipmentSettings

_PLACE = ("laparoscope_rcm_behind_mm", "instrument_rcm_mm", "target_mm", "shaft_diameter_mm")


def read_cameras(settings: EquipmentSettings) -> StereoFile | None:
    """The user's cameras; None for those of the built-in scene.

    Raises:
        FileError, RecordingError: a file that cannot be read.
    """
    return None if settings.stereo is None else read_stereo(settings.stereo)


def make_scene(
    settings: EquipmentSettings,
    scene: SceneSettings,
    cameras: StereoFile | None,
    camera_right_T_arm: Array | None = None,
) -> tuple[SceneSettings, Scene]:
    """The scene with the user's own arms, cameras and places.

    Args:
        settings: what the user states.
        scene: everything else.
        cameras: of `read_cameras`.
        camera_right_T_arm: hand-eye transform (4, 4), mm, in place of the one that the scene or the robot's own table
            has.

    Raises:
        FileError, RobotError: robot file that cannot be read.
        InputError: a robot that cannot take up the scene.
    """
    changes: dict[str, Any] = {name: getattr(settings, name) for name in _PLACE if getattr(settings, name) is not None}
    if cameras is not None and cameras.camera_left_T_camera_right is not None:
        rotvec, translation = _split(cameras.camera_left_T_camera_right)
        changes |= {"stereo_rotvec_deg": rotvec, "stereo_translation_mm": translation}
    if camera_right_T_arm is not None:
        rotvec, translation = _split(camera_right_T_arm)
        changes |= {"hand_eye_rotvec_deg": rotvec, "hand_eye_translation_mm": translation}
    scene = replace(scene, **changes)
    if settings.robot is None:
        return scene, build_scene(scene)
    return scene, _with_robot(settings, scene, camera_right_T_arm)


def _split(transform: Array) -> tuple[tuple[float, ...], tuple[float, ...]]:
    """Rotation vector, deg, and translation, mm."""
    rotvec_deg = torch.rad2deg(matrix_to_rotvec(torch.as_tensor(transform[:3, :3])))
    return tuple(rotvec_deg.tolist()), tuple(transform[:3, 3].tolist())


def _with_robot(settings: EquipmentSettings, scene: SceneSettings, camera_right_T_arm: Array | None) -> Scene:
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
    if camera_right_T_arm is not None:
        arms = (replace(arms[0], end_T_tool=rigid_inverse(CAMERA_T_END) @ camera_right_T_arm), arms[1])
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
        shaft_reversed=arm.shaft_reversed,
    )


def _check_limits(arm: RobotArm, home: Array, settings: EquipmentSettings, name: str) -> None:
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
