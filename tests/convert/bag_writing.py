"""A recording written as a ROS bag by rosbags itself: what a robot would have logged of it."""

import csv
from collections.abc import Callable
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import yaml
from rosbags.rosbag1 import Writer as Writer1
from rosbags.rosbag2 import StoragePlugin
from rosbags.rosbag2 import Writer as Writer2
from rosbags.typesys import Stores, get_typestore

START_S = 1_700_000_000
"""Unix time at which a recording's clock is 0."""
RIG = "/rig"


class BagWriter:
    """Messages into a bag of one kind; stamps in ns."""

    def __init__(self, path: Path, kind: str) -> None:
        self.is_ros1 = kind == "ros1"
        self.store = get_typestore(Stores.ROS1_NOETIC if self.is_ros1 else Stores.ROS2_JAZZY)
        if self.is_ros1:
            self._writer: Any = Writer1(path)
            self._writer.chunk_threshold = 1 << 16  # several chunks, as bags of ordinary size have
        else:
            plugin = StoragePlugin.MCAP if kind == "mcap" else StoragePlugin.SQLITE3
            self._writer = Writer2(path, version=9, storage_plugin=plugin)
        self._is_mcap, self._written = kind == "mcap", 0
        self._connections: dict[str, Any] = {}

    def __enter__(self) -> "BagWriter":
        self._writer.open()
        return self

    def __exit__(self, *_: object) -> None:
        self._writer.close()

    def type(self, name: str) -> Any:
        return self.store.types[name]

    def header(self, ns: int, frame: str = "") -> Any:
        stamp = self.type("builtin_interfaces/msg/Time")(sec=ns // 10**9, nanosec=ns % 10**9)
        sequence = {"seq": 0} if self.is_ros1 else {}
        return self.type("std_msgs/msg/Header")(stamp=stamp, frame_id=frame, **sequence)

    def write(self, topic: str, ns: int, message: Any) -> None:
        kind = message.__msgtype__
        if topic not in self._connections:
            self._connections[topic] = self._writer.add_connection(topic, kind, typestore=self.store)
        raw = self.store.serialize_ros1(message, kind) if self.is_ros1 else self.store.serialize_cdr(message, kind)
        self._writer.write(self._connections[topic], ns + 1_000_000, raw)  # received a millisecond later
        self._written += 1
        if self._is_mcap and self._written % 50 == 0:
            self._writer.storage.close_chunk()

    def joints(self, topic: str, ns: int, names: list[str], values: np.ndarray) -> None:
        message = self.type("sensor_msgs/msg/JointState")(
            header=self.header(ns), name=names, position=values, velocity=np.zeros(0), effort=np.zeros(0)
        )
        self.write(topic, ns, message)

    def pose(
        self, topic: str, ns: int, p_m: np.ndarray, quat_xyzw: np.ndarray, frame: str, stamped: str = "Pose"
    ) -> None:
        quaternion = self.type("geometry_msgs/msg/Quaternion")(**dict(zip("xyzw", map(float, quat_xyzw), strict=True)))
        xyz = dict(zip("xyz", map(float, p_m), strict=True))
        if stamped == "Pose":
            point = self.type("geometry_msgs/msg/Point")(**xyz)
            pose = self.type("geometry_msgs/msg/Pose")(position=point, orientation=quaternion)
            message = self.type("geometry_msgs/msg/PoseStamped")(header=self.header(ns, frame), pose=pose)
        else:
            vector = self.type("geometry_msgs/msg/Vector3")(**xyz)
            transform = self.type("geometry_msgs/msg/Transform")(translation=vector, rotation=quaternion)
            message = self.type("geometry_msgs/msg/TransformStamped")(
                header=self.header(ns, frame), child_frame_id="tip", transform=transform
            )
        self.write(topic, ns, message)

    def image(self, topic: str, ns: int, rgb: np.ndarray, encoding: str = "rgb8", padding: int = 0) -> None:
        data = rgb if encoding == "rgb8" else rgb[..., ::-1] if encoding == "bgr8" else rgb
        rows = data.reshape(data.shape[0], -1)
        rows = np.pad(rows.view(np.uint8), ((0, 0), (0, padding)))
        message = self.type("sensor_msgs/msg/Image")(
            header=self.header(ns, "camera"), height=data.shape[0], width=data.shape[1], encoding=encoding,
            is_bigendian=0, step=rows.shape[1], data=np.ascontiguousarray(rows).ravel(),
        )  # fmt: skip
        self.write(topic, ns, message)

    def compressed(self, topic: str, ns: int, data: bytes, kind: str) -> None:
        message = self.type("sensor_msgs/msg/CompressedImage")(
            header=self.header(ns, "camera"), format=kind, data=np.frombuffer(data, np.uint8)
        )
        self.write(topic, ns, message)

    def camera_info(
        self, topic: str, ns: int, size: tuple[int, int], K: np.ndarray, D: list, R: np.ndarray, P: np.ndarray
    ) -> None:
        cased: Callable[[str], str] = str.upper if self.is_ros1 else str.lower
        matrices = {"K": K.ravel(), "D": np.array(D), "R": R.ravel(), "P": P.ravel()}
        roi = self.type("sensor_msgs/msg/RegionOfInterest")(x_offset=0, y_offset=0, height=0, width=0, do_rectify=False)
        message = self.type("sensor_msgs/msg/CameraInfo")(
            header=self.header(ns), height=size[0], width=size[1], distortion_model="plumb_bob",
            binning_x=0, binning_y=0, roi=roi, **{cased(name): v.astype(np.float64) for name, v in matrices.items()},
        )  # fmt: skip
        self.write(topic, ns, message)


def read_recording(folder: Path) -> tuple[np.ndarray, list[str], np.ndarray, dict]:
    """Frame times, columns and rows of the joint log, and stereo.yaml of a recording, read by the csv module."""
    with (folder / "frame_times.csv").open() as file:
        times = np.array([float(row["timestamp_s"]) for row in csv.DictReader(file)])
    with (folder / "joints.csv").open() as file:
        rows = list(csv.reader(file))
    return times, rows[0], np.array(rows[1:], dtype=np.float64), yaml.safe_load((folder / "stereo.yaml").read_text())


def to_ns(seconds: float) -> int:
    return START_S * 10**9 + round(seconds * 1e9)


def write_bag(
    recording: Path, bag: Path, kind: str, *, every_picture: int = 1, more: Callable[[BagWriter], None] | None = None
) -> Path:
    """A recording of two arms and two eyes as a bag: joints, raw pictures, and camera_info as ROS calibrates a pair;
    and whatever `more` writes."""
    times, columns, rows, stereo = read_recording(recording)
    infos = camera_infos(stereo)
    events: list[tuple[int, int, Callable[[BagWriter], None]]] = []
    for arm, name in (("laparoscope", "ECM"), ("instrument", "PSM1")):
        index = [i for i, column in enumerate(columns) if column.startswith(f"{arm}.")]
        joints = [columns[i].split(".")[1].rsplit("_", 1)[0] for i in index]
        scale = np.array([1.0 if columns[i].endswith("_rad") else 1e-3 for i in index])
        for row in rows:
            ns, values = to_ns(row[0]), row[index] * scale
            events.append(
                (
                    ns,
                    0,
                    lambda w, ns=ns, values=values, name=name, joints=joints: w.joints(
                        f"/{name}/measured_js", ns, joints, values
                    ),
                )
            )
    for i, time_s in enumerate(times[::every_picture]):
        ns = to_ns(time_s)
        for side, late in (("right", 0), ("left", 400_000)):
            rgb = cv2.imread(str(recording / side / f"{i * every_picture:06d}.png"))[..., ::-1]
            events.append(
                (
                    ns + late,
                    1,
                    lambda w, ns=ns + late, side=side, rgb=rgb: w.image(
                        f"{RIG}/{side}/image_raw", ns, rgb, "bgr8" if side == "left" else "rgb8"
                    ),
                )
            )
            events.append(
                (
                    ns + late,
                    2,
                    lambda w, ns=ns + late, side=side: w.camera_info(f"{RIG}/{side}/camera_info", ns, *infos[side]),
                )
            )
    with BagWriter(bag, kind) as writer:
        for _, _, write in sorted(events, key=lambda event: event[:2]):
            write(writer)
        if more is not None:
            more(writer)
    return bag


def camera_infos(stereo: dict) -> dict[str, tuple]:
    """(size, K, D, R, P) a side, as OpenCV's stereoRectify makes them for ROS."""
    width, height = stereo["image_size"]
    left_T_right = np.array(stereo["camera_left_T_camera_right"])
    right_T_left = np.linalg.inv(left_T_right)
    K = {
        s: np.array([[c["fx"], 0, c["cx"]], [0, c["fy"], c["cy"]], [0, 0, 1]])
        for s in ("left", "right")
        for c in (stereo[s],)
    }
    D = {side: np.array(stereo[side]["distortion"]) for side in K}
    R1, R2, P1, P2, *_ = cv2.stereoRectify(
        K["left"], D["left"], K["right"], D["right"], (width, height),
        right_T_left[:3, :3], right_T_left[:3, 3:] / 1000.0, flags=cv2.CALIB_ZERO_DISPARITY,
    )  # fmt: skip
    return {
        "left": ((height, width), K["left"], D["left"].tolist(), R1, P1),
        "right": ((height, width), K["right"], D["right"].tolist(), R2, P2),
    }
