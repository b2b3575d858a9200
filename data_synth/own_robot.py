"""A scene with somebody's own arms: their tables, placed where `SceneSettings` wants the camera and the instrument."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from data_synth.kinematics import Arm, Array, rigid
from data_synth.scene import CAMERA_T_END, MOVING_JOINTS, Scene, build_scene, frame_along, place_arm
from data_synth.settings import SceneSettings


def scene_with_arms(settings: SceneSettings, laparoscope: Arm, instrument: Arm) -> Scene:
    """The scene of `settings` with other arms. Where their bases stand follows from the scene; all joints but the
    insertion are at zero at home.

    The laparoscope's RCM is the origin of its frame 0, and its camera looks along the z axis of its last frame, 20 mm
    ahead of it, so that `camera_right_T_arm` follows from its `end_T_tool`; the one of `settings` is not used.

    Raises:
        ValueError: an arm has fewer than three joints, or none of the first three is an insertion along its shaft.
    """
    plain = build_scene(settings)
    lap_home = _home(laparoscope, settings.laparoscope_rcm_behind_mm + CAMERA_T_END[2, 3], _distance_of_end)
    rcm, target = np.asarray(settings.instrument_rcm_mm, float), np.asarray(settings.target_mm, float)
    tool_home = _home(instrument, float(np.linalg.norm(target - rcm)), lambda arm, q: arm.shaft(q).rcm_s_end_mm)
    base_T_end = plain.base_T_camera_home @ CAMERA_T_END
    place = place_arm(laparoscope.joints, lap_home, base_T_end, laparoscope.convention)
    return Scene(
        laparoscope=replace(laparoscope, base_T_arm_base=place),
        instrument=_through(instrument, tool_home, plain.base_T_camera_home, rcm, target),
        laparoscope_home=lap_home,
        instrument_home=tool_home,
        camera_right_T_arm=CAMERA_T_END @ laparoscope.end_T_tool,
        camera_left_T_camera_right=plain.camera_left_T_camera_right,
        base_T_camera_home=plain.base_T_camera_home,
        shaft_radius_mm=plain.shaft_radius_mm,
        shaft_end_offset_mm=plain.shaft_end_offset_mm,
    )


def _distance_of_end(arm: Arm, readings: Array) -> Array:
    """Distance of the last frame from the arm's RCM, along that frame's z axis."""
    frames = arm.frames(readings)
    return frames[..., -1, :3, 2] @ (frames[..., -1, :3, 3] - frames[..., 0, :3, 3])


def _home(arm: Arm, distance_mm: float, measure) -> Array:
    """Readings of zero, but for the insertion at which `measure` is the distance: it is linear in the insertion."""
    insertions = [i for i, joint in enumerate(arm.joints[:MOVING_JOINTS]) if joint.kind == "prismatic"]
    if len(arm.joints) < MOVING_JOINTS or len(insertions) != 1:
        found = ", ".join(joint.kind for joint in arm.joints[:MOVING_JOINTS])
        raise ValueError(f"expected two revolute joints and one insertion as the first three of an arm, found {found}")
    home = np.zeros(len(arm.joints))
    start = float(measure(arm, home))
    home[insertions[0]] = 1.0
    slope = float(measure(arm, home)) - start
    if abs(slope) < 0.5:
        raise ValueError(f"expected an insertion along the shaft, found one that moves it by {slope:.2g} mm per mm")
    home[insertions[0]] = (distance_mm - start) / slope
    return home


def _through(arm: Arm, home: Array, base_T_camera: Array, camera_p_rcm: Array, camera_p_target: Array) -> Arm:
    """The instrument's arm, placed so that its RCM is at one point and its shaft points to the other."""
    own = replace(arm, base_T_arm_base=np.eye(4)).shaft(home)
    arm_base_p_rcm = own.base_T_rcm[:3, 3]
    arm_base_v_axis = own.base_T_rcm[:3, :3] @ own.rcm_v_axis
    camera_R_shaft = frame_along(camera_p_target - camera_p_rcm, roll_rad=-0.9)
    camera_R_arm_base = camera_R_shaft @ frame_along(arm_base_v_axis, roll_rad=0.0).T
    camera_T_arm_base = rigid(camera_R_arm_base, camera_p_rcm - camera_R_arm_base @ arm_base_p_rcm)
    return replace(arm, base_T_arm_base=base_T_camera @ camera_T_arm_base)
