"""moveit: the launch file that MoveIt's hand-eye calibration saves, a static transform with its rpy in a comment."""

from rmis_calib.exports.answer import Answer
from rmis_calib.exports.formats.markup import xml_comment
from rmis_calib.exports.formats.ros_static_tf import ros1_arguments
from rmis_calib.exports.hand_eye import about_frames, numbers, rpy_rad


def content(answer: Answer) -> str:
    """One camera on the end effector."""
    item = answer.hand_eyes()[0]
    pose = item.arm_T_camera
    xyz, rpy = numbers(pose[:3, 3]), numbers(list(rpy_rad(pose[:3, :3])))
    head = [*answer.about(), *about_frames(item), f'as in a URDF, rpy about fixed axes: xyz="{xyz}" rpy="{rpy}"']
    node = '  <node pkg="tf2_ros" type="static_transform_publisher" name="camera_link_broadcaster"'
    return "\n".join(["<launch>", xml_comment(head), node, f'        args="{ros1_arguments(item)}"/>', "</launch>", ""])
