"""The node's parts without ROS, and its wiring against a stand-in for rclpy."""

import importlib.util
import sys
from types import ModuleType, SimpleNamespace

import numpy as np
import pytest

from rmis_calib.live import Session, ros_node
from rmis_calib.live.collector import StillPoses
from rmis_calib.live.ros_node import LiveCalibration, arm_T_camera, rgb_of


def header(time_s: float) -> SimpleNamespace:
    stamp = SimpleNamespace(sec=int(time_s), nanosec=round(1e9 * (time_s - int(time_s))))
    return SimpleNamespace(stamp=stamp, frame_id="")


def image(picture: np.ndarray, time_s: float = 0.0, encoding: str = "rgb8") -> SimpleNamespace:
    height, width = picture.shape[:2]
    return SimpleNamespace(
        header=header(time_s), height=height, width=width, encoding=encoding, is_bigendian=0,
        step=picture.nbytes // height, data=picture.tobytes(),
    )  # fmt: skip


def joint_states(frames, k: int, time_s: float) -> dict[str, SimpleNamespace]:
    """Both arms' JointState as a robot publishes it: rad and m."""
    states = {}
    for arm in ("laparoscope", "instrument"):
        own = {name.partition(".")[2]: value for name, value in frames.joints[k].items() if name.startswith(arm)}
        names = [name.rpartition("_")[0] for name in own]
        positions = [value / 1000 if name.endswith("_mm") else value for name, value in own.items()]
        states[arm] = SimpleNamespace(header=header(time_s), name=names, position=positions)
    return states


def play(live: LiveCalibration, frames, count: int) -> None:
    """Rest of 1 s at each pose, joints at 20 Hz, a picture of each camera at its end."""
    for k in range(count):
        for tick in range(21):
            for arm, message in joint_states(frames, k, k + 1.0 + tick / 21).items():
                live.joints(arm, message)
            if tick == 19:
                for side in ("right", "left"):
                    live.picture(side, image(getattr(frames, side)[k].permute(1, 2, 0).numpy(), k + 1.0 + tick / 21))


def test_the_camera_in_the_arms_frame_is_in_metres_and_xyzw() -> None:
    # camera_T_arm turns by +90 degrees about z and shifts by (10, 20, 30) mm; its inverse by -90 and (-20, 10, -30).
    camera_T_arm = np.array([[0.0, -1, 0, 10], [1, 0, 0, 20], [0, 0, 1, 30], [0, 0, 0, 1]])
    translation, quaternion = arm_T_camera(camera_T_arm)
    assert translation == pytest.approx([-0.02, 0.01, -0.03])
    assert quaternion == pytest.approx([0.0, 0.0, -np.sqrt(0.5), np.sqrt(0.5)])


@pytest.mark.parametrize("encoding", ["rgb8", "bgr8", "mono8"])
def test_pictures_become_rgb(encoding: str) -> None:
    rgb = np.random.default_rng(0).integers(0, 255, (4, 6, 3), dtype=np.uint8)
    sent = {"rgb8": rgb, "bgr8": np.ascontiguousarray(rgb[..., ::-1]), "mono8": np.ascontiguousarray(rgb[..., 0])}
    expected = np.repeat(rgb[..., :1], 3, axis=2) if encoding == "mono8" else rgb
    np.testing.assert_array_equal(rgb_of(image(sent[encoding], encoding=encoding), "topic"), expected)


def test_messages_become_verdict_advice_and_transform(frames) -> None:
    said: list[tuple[str, str]] = []
    published: list[tuple[list[float], list[float], str]] = []
    poses = StillPoses(frames.recording.robot, ["laparoscope", "instrument"], ["right", "left"])
    live = LiveCalibration(
        Session.like(frames.recording), poses, lambda *words: said.append(words), lambda *pose: published.append(pose)
    )
    play(live, frames, 9)
    verdicts = [words for topic, words in said if topic == "verdict"]
    assert len(verdicts) == 9 and verdicts[0].startswith("collecting, 1 of 1 poses: 1 usable motions")
    assert verdicts[-1].split(",")[0] in ("weak", "ready")
    # From the sixth pose on, under a name that nobody takes for the checked one.
    assert [child for _, _, child in published] == ["camera_right_unchecked"] * 4
    truth = np.linalg.inv(frames.truth)
    assert np.linalg.norm(np.array(published[-1][0]) - truth[:3, 3] / 1000) < 0.005
    result = live.finish()
    assert said[-1] == ("verdict", f"{result.status}: {result.message}")
    assert ("camera_right" in [child for _, _, child in published]) == result.trustworthy


def test_without_ros_there_is_one_clear_line(capsys) -> None:
    if importlib.util.find_spec("rclpy") is not None:
        pytest.skip("rclpy is installed")
    assert ros_node.main([]) == 2
    assert capsys.readouterr().err == "rmis-calib-ros2: error: expected a sourced ROS 2, found no rclpy\n"


class FakeNode:
    """What the node asks of rclpy, recorded."""

    settings: dict[str, object] = {}
    last: "FakeNode"

    def __init__(self, name: str) -> None:
        self.name, self.subscriptions, self.services, self.sent = name, {}, {}, []
        FakeNode.last = self

    def declare_parameter(self, name: str, default: object) -> SimpleNamespace:
        return SimpleNamespace(value=self.settings.get(name, default))

    def create_publisher(self, kind: type, topic: str, depth: int) -> SimpleNamespace:
        return SimpleNamespace(publish=lambda message: self.sent.append((topic, message.data)))

    def create_subscription(self, kind: type, topic: str, callback, depth: int) -> None:
        self.subscriptions[topic] = callback

    def create_service(self, kind: type, name: str, callback) -> None:
        self.services[name] = callback

    def get_logger(self) -> SimpleNamespace:
        return SimpleNamespace(info=lambda words: None)

    def get_clock(self) -> SimpleNamespace:
        return SimpleNamespace(now=lambda: SimpleNamespace(to_msg=lambda: SimpleNamespace(sec=1, nanosec=0)))

    def destroy_node(self) -> None:
        self.sent.append(("destroyed", ""))


def fake_ros(monkeypatch, spin, transforms: list) -> None:
    """Modules that the node imports, with these parts."""

    def stamped() -> SimpleNamespace:
        transform = SimpleNamespace(translation=SimpleNamespace(), rotation=SimpleNamespace())
        return SimpleNamespace(header=header(0.0), child_frame_id="", transform=transform)

    message = lambda **fields: SimpleNamespace(**fields)  # noqa: E731
    parts = {
        "rclpy": {"init": lambda args: None, "spin": spin, "try_shutdown": lambda: None},
        "rclpy.node": {"Node": FakeNode},
        "geometry_msgs.msg": {"TransformStamped": stamped},
        "sensor_msgs.msg": {"Image": object, "JointState": object},
        "std_msgs.msg": {"String": message},
        "std_srvs.srv": {"Trigger": object},
        "tf2_ros": {"StaticTransformBroadcaster": lambda node: SimpleNamespace(sendTransform=transforms.append)},
    }
    for name, content in parts.items():
        module = ModuleType(name)
        vars(module).update(content)
        monkeypatch.setitem(sys.modules, name, module)
        if "." in name and name.partition(".")[0] not in parts:
            monkeypatch.setitem(sys.modules, name.partition(".")[0], ModuleType(name.partition(".")[0]))


def test_the_node_is_wired(frames, monkeypatch, tmp_path) -> None:
    folder, out = frames.recording.path, tmp_path / "result.json"
    FakeNode.settings = {
        "robot": str(folder / "robot.yaml"), "stereo": str(folder / "stereo.yaml"), "left_image": "/left",
        "right_image": "/right", "instrument_joints": "/PSM2/measured_js", "out": str(out), "arm_frame": "scope_arm",
    }  # fmt: skip
    transforms: list[SimpleNamespace] = []

    def spin(node: FakeNode) -> None:
        topics = {"laparoscope": "/ECM/measured_js", "instrument": "/PSM2/measured_js"}
        assert set(node.subscriptions) == {*topics.values(), "/right", "/left"}
        live = SimpleNamespace(
            joints=lambda arm, message: node.subscriptions[topics[arm]](message),
            picture=lambda side, message: node.subscriptions[f"/{side}"](message),
        )
        play(live, frames, 7)  # type: ignore[arg-type]
        response = node.services["~/finish"](None, SimpleNamespace())
        assert response.success in (True, False) and response.message
        raise KeyboardInterrupt

    fake_ros(monkeypatch, spin, transforms)
    assert ros_node.main([]) == 0
    assert out.exists()
    assert transforms[0].header.frame_id == "scope_arm" and transforms[0].child_frame_id == "camera_right_unchecked"
    assert np.linalg.norm([getattr(transforms[0].transform.rotation, axis) for axis in "xyzw"]) == pytest.approx(1.0)
    topics = [topic for topic, _ in FakeNode.last.sent]
    assert "~/verdict" in topics and topics[-1] == "destroyed"
