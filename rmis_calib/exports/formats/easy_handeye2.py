"""easy-handeye2: a .calib file as its publisher loads it, from ~/.ros2/easy_handeye2/calibrations/NAME.calib.

Source: easy_handeye2, msg/HandeyeCalibration.msg and handeye_publisher.py: the transform's parent is
robot_effector_frame (eye_in_hand) or robot_base_frame (eye_on_base), its child tracking_base_frame.
"""

from rmis_calib.exports.answer import Answer
from rmis_calib.exports.formats.markup import yaml_text
from rmis_calib.exports.hand_eye import about_frames, quat_xyzw


def content(answer: Answer) -> str:
    """One camera; the file has no place for covariance, so sigma is in a comment."""
    item, settings = answer.hand_eyes()[0], answer.settings
    pose, fixed = item.arm_T_camera, answer.eye_on_base
    parameters = {
        "name": f"{item.arm}_{item.camera}".strip("/").replace("/", "_"),
        "calibration_type": "eye_on_base" if fixed else "eye_in_hand",
        "robot_base_frame": item.arm if fixed else settings.base_frame,
        "robot_effector_frame": "" if fixed else item.arm,
        "tracking_base_frame": item.camera,
        "tracking_marker_frame": "",
        "freehand_robot_movement": True,
        "move_group_namespace": "/",
        "move_group": "manipulator",
    }
    translation = dict(zip("xyz", pose[:3, 3].tolist(), strict=True))
    rotation = dict(zip("xyzw", quat_xyzw(pose[:3, :3]), strict=True))
    value = {"parameters": parameters, "transform": {"translation": translation, "rotation": rotation}}
    return yaml_text([*answer.about(), *about_frames(item)], value)
