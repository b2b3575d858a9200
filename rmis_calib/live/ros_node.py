"""A thin ROS 2 node around `rc.Session`: it collects still poses, says the next useful motion, publishes the answer.

Topics that it reads, by parameter: joint states of both arms, pictures of both cameras. What it publishes: `~/verdict`
and `~/advice` (std_msgs/String), and a static transform from the arm to the camera. While the session grows, the child
frame is `<camera>_unchecked`; the service `~/finish` (std_srvs/Trigger) solves everything with all checks, and only a
trustworthy result is published as `<camera>`.

    rmis-calib-ros2 --ros-args -p robot:=robot.yaml -p stereo:=stereo.yaml -p right_image:=/stereo/right/image_raw
"""

# ROS is no Python package that a type checker could find here.
# pyright: reportMissingImports=false

import sys
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import torch

from rmis_calib.convert.messages import bgr_of
from rmis_calib.exports.hand_eye import in_metres, quat_xyzw, rigid_inverse
from rmis_calib.geometry.cameras import StereoRig
from rmis_calib.io.recording import camera_rig
from rmis_calib.io.robot import load_robot
from rmis_calib.io.stereo import read_stereo
from rmis_calib.live.answer import LiveAnswer
from rmis_calib.live.collector import StillPose, StillPoses
from rmis_calib.live.session import Session
from rmis_calib.results import CalibrationResult

UNCHECKED = "_unchecked"
PARAMETERS: dict[str, Any] = {
    "robot": "dvrk-classic",
    "stereo": "",
    "laparoscope_arm": "laparoscope",
    "instrument_arm": "instrument",
    "shaft_diameter_mm": 8.0,
    "laparoscope_joints": "/ECM/measured_js",
    "instrument_joints": "/PSM1/measured_js",
    "right_image": "/stereo/right/image_raw",
    "left_image": "",
    "arm_frame": "ECM",
    "camera_frame": "camera_right",
    "picture_memory_mb": 1000.0,
    "out": "",
}
"""Parameters with their defaults. `laparoscope_arm` empty: the camera stands still. `left_image` empty: one camera.
`picture_memory_mb`: as of `Session`.
`out`: file for result.json."""


class LiveCalibration:
    """The node without ROS: messages in, words and transforms out.

    Args:
        session: that grows.
        poses: that collects what it grows by.
        say: called with (topic, words), topics `verdict` and `advice`.
        publish: called with (translation, m; quaternion xyzw; child frame) of the camera in the arm's frame.
        camera_frame: name of the right camera's frame.
    """

    def __init__(
        self,
        session: Session,
        poses: StillPoses,
        say: Callable[[str, str], None],
        publish: Callable[[list[float], list[float], str], None],
        camera_frame: str = "camera_right",
    ) -> None:
        self._session, self._poses, self._say, self._publish = session, poses, say, publish
        self._camera_frame = camera_frame

    def joints(self, arm: str, message: Any) -> None:
        """A sensor_msgs/JointState of an arm."""
        self._take(self._poses.add_joints(arm, stamp_s(message), list(message.name), list(message.position)))

    def picture(self, side: str, message: Any) -> None:
        """A sensor_msgs/Image of a camera."""
        self._take(self._poses.add_picture(side, stamp_s(message), rgb_of(message, side)))

    def finish(self) -> CalibrationResult:
        """Everything solved with all checks; a trustworthy result is published under the camera's own name."""
        result = self._session.result()
        self._say("verdict", f"{result.status}: {result.message}")
        if result.trustworthy and result.camera_right_T_arm is not None:
            self._publish(*arm_T_camera(result.camera_right_T_arm.matrix.numpy()), self._camera_frame)
        return result

    def _take(self, pose: StillPose | None) -> None:
        if pose is None:
            return
        pictures = {side: torch.from_numpy(picture).permute(2, 0, 1) for side, picture in pose.pictures.items()}
        answer = self._session.add(pose.joints, pictures["right"], pictures.get("left"))
        self._say("verdict", in_words(answer))
        if answer.advice:
            self._say("advice", answer.advice[0])
        if answer.camera_right_T_arm is not None:
            child = self._camera_frame + UNCHECKED
            self._publish(*arm_T_camera(answer.camera_right_T_arm.matrix.numpy()), child)


def in_words(answer: LiveAnswer) -> str:
    """The verdict of a live answer in one line."""
    left_out = "" if answer.frame_used else f" (the last pose does not count: {answer.frame_reason})"
    return f"{answer.status}, {answer.used} of {answer.frames} poses: {answer.message}{left_out}"


def arm_T_camera(camera_T_arm: np.ndarray) -> tuple[list[float], list[float]]:
    """Place (m) and quaternion (xyzw) of the camera in the arm's frame, as TF has it for parent arm, child camera.

    Args:
        camera_T_arm: (4, 4), mm.
    """
    pose = rigid_inverse(in_metres(camera_T_arm))
    return pose[:3, 3].tolist(), quat_xyzw(pose[:3, :3])


def stamp_s(message: Any) -> float:
    """Time of a message's header, s."""
    return float(message.header.stamp.sec) + 1e-9 * float(message.header.stamp.nanosec)


def rgb_of(message: Any, topic: str) -> np.ndarray:
    """(h, w, 3) uint8 RGB of a sensor_msgs/Image.

    Raises:
        RecordingError: an encoding that is not read, or too few bytes.
    """
    picture = bgr_of(message, topic)
    if picture.dtype == np.uint16:
        picture = (picture >> 8).astype(np.uint8)
    picture = np.repeat(picture[..., None], 3, axis=2) if picture.ndim == 2 else picture[..., ::-1]
    return np.ascontiguousarray(picture)


def live_calibration(
    parameters: dict[str, Any],
    say: Callable[[str, str], None],
    publish: Callable[[list[float], list[float], str], None],
) -> LiveCalibration:
    """Everything that the parameters describe.

    Raises:
        FileError, InputError: a file or a name in them.
    """
    robot, cameras = load_robot(parameters["robot"]), camera_rig(read_stereo(parameters["stereo"]))
    rig = cameras if parameters["left_image"] else StereoRig(cameras.right)
    laparoscope, instrument = parameters["laparoscope_arm"] or None, parameters["instrument_arm"]
    session = Session(
        robot,
        rig,
        laparoscope_arm=laparoscope,
        instrument_arm=instrument,
        shaft_diameter_mm=parameters["shaft_diameter_mm"],
        picture_memory_mb=parameters["picture_memory_mb"],
    )
    arms = [arm for arm in (laparoscope, instrument) if arm is not None]
    poses = StillPoses(robot, arms, ["right", *(["left"] if rig.left is not None else [])])
    return LiveCalibration(session, poses, say, publish, parameters["camera_frame"])


def main(args: list[str] | None = None) -> int:
    """Run the node until it is stopped."""
    try:
        import rclpy
        from geometry_msgs.msg import TransformStamped
        from rclpy.node import Node
        from sensor_msgs.msg import Image, JointState
        from std_msgs.msg import String
        from std_srvs.srv import Trigger
        from tf2_ros import StaticTransformBroadcaster
    except ImportError as error:
        print(f"rmis-calib-ros2: error: expected a sourced ROS 2, found no {error.name}", file=sys.stderr)
        return 2
    rclpy.init(args=args)
    node = Node("rmis_calib")
    values = {name: node.declare_parameter(name, default).value for name, default in PARAMETERS.items()}
    topics = {name: node.create_publisher(String, f"~/{name}", 10) for name in ("verdict", "advice")}
    broadcaster = StaticTransformBroadcaster(node)

    def say(topic: str, words: str) -> None:
        topics[topic].publish(String(data=words))
        node.get_logger().info(words)

    def publish(translation: list[float], quaternion: list[float], child: str) -> None:
        message = TransformStamped()
        message.header.stamp = node.get_clock().now().to_msg()
        message.header.frame_id, message.child_frame_id = values["arm_frame"], child
        moved, turned = message.transform.translation, message.transform.rotation
        moved.x, moved.y, moved.z = translation
        turned.x, turned.y, turned.z, turned.w = quaternion
        broadcaster.sendTransform(message)

    live = live_calibration(values, say, publish)

    def finish(_: Any, response: Any) -> Any:
        result = live.finish()
        if values["out"]:
            result.write(Path(values["out"]))
        response.success, response.message = result.trustworthy, result.message
        return response

    for key in ("laparoscope", "instrument"):
        if values[f"{key}_arm"]:
            arm, topic = values[f"{key}_arm"], values[f"{key}_joints"]
            node.create_subscription(JointState, topic, lambda message, arm=arm: live.joints(arm, message), 50)
    for side in ("right", "left"):
        if values[f"{side}_image"]:
            topic = values[f"{side}_image"]
            node.create_subscription(Image, topic, lambda message, side=side: live.picture(side, message), 2)
    node.create_service(Trigger, "~/finish", finish)
    try:
        rclpy.spin(node)
    except KeyboardInterrupt:
        pass
    finally:
        node.destroy_node()
        rclpy.try_shutdown()
    return 0


if __name__ == "__main__":
    sys.exit(main())
