"""ros-static-tf: launch files and command lines of static_transform_publisher for ROS 1 and ROS 2, and a pose with
covariance."""

from rmis_calib.exports.answer import Answer
from rmis_calib.exports.formats.markup import xml_comment, yaml_text
from rmis_calib.exports.hand_eye import HandEye, about_frames, numbers, quat_xyzw


def content(answer: Answer) -> dict[str, str]:
    """ros1.launch, ros2.launch.xml, commands.txt and pose_with_covariance.yaml."""
    items = answer.hand_eyes()
    head = [*answer.about(), *(line for item in items for line in about_frames(item))]
    ros1 = [
        f'  <node pkg="tf2_ros" type="static_transform_publisher" name="{_node(item)}"\n'
        f'        args="{ros1_arguments(item)}"/>'
        for item in items
    ]
    ros2 = [
        f'  <node pkg="tf2_ros" exec="static_transform_publisher" name="{_node(item)}"\n'
        f'        args="{ros2_arguments(item)}"/>'
        for item in items
    ]
    lines = [f"# {line}" for line in head]
    lines += ["# ROS 1", *(f"rosrun tf2_ros static_transform_publisher {ros1_arguments(item)}" for item in items)]
    lines += ["# ROS 2", *(f"ros2 run tf2_ros static_transform_publisher {ros2_arguments(item)}" for item in items)]
    return {
        "ros1.launch": "\n".join(["<launch>", xml_comment(head), *ros1, "</launch>", ""]),
        "ros2.launch.xml": "\n".join(["<launch>", xml_comment(head), *ros2, "</launch>", ""]),
        "commands.txt": "\n".join(lines) + "\n",
        "pose_with_covariance.yaml": _pose(items[0], head),
    }


def ros1_arguments(item: HandEye) -> str:
    """x y z qx qy qz qw parent child."""
    pose = item.arm_T_camera
    return f"{numbers(pose[:3, 3])} {numbers(quat_xyzw(pose[:3, :3]))} {item.arm} {item.camera}"


def ros2_arguments(item: HandEye) -> str:
    """The same by name, as ROS 2 asks for it."""
    pose = item.arm_T_camera
    values = zip(["x", "y", "z", "qx", "qy", "qz", "qw"], [*pose[:3, 3], *quat_xyzw(pose[:3, :3])], strict=True)
    flags = " ".join(f"--{name} {float(value)!r}" for name, value in values)
    return f"{flags} --frame-id {item.arm} --child-frame-id {item.camera}"


def _pose(item: HandEye, head: list[str]) -> str:
    """A geometry_msgs/PoseWithCovarianceStamped: the camera in the arm's frame; translation first, fixed axes of the
    arm, as ROS has it."""
    pose, covariance = item.arm_T_camera, item.arm_covariance
    order = [3, 4, 5, 0, 1, 2]
    # ROS has no "unknown"; a negative variance is how IMU messages say it.
    values = [-1.0, *[0.0] * 35] if covariance is None else covariance[order][:, order].ravel().tolist()
    position = dict(zip("xyz", pose[:3, 3].tolist(), strict=True))
    orientation = dict(zip("xyzw", quat_xyzw(pose[:3, :3]), strict=True))
    inner = {"pose": {"position": position, "orientation": orientation}, "covariance": values}
    comment = [*head, f"pose of {item.camera} in {item.arm}; covariance: x y z, then rotation about them"]
    return yaml_text(comment, {"header": {"frame_id": item.arm}, "pose": inner})


def _node(item: HandEye) -> str:
    return "rmis_calib_" + item.camera.strip("/").replace("/", "_").replace(".", "_")
