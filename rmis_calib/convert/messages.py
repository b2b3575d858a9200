"""ROS messages, of whatever ROS, as plain numbers and pictures."""

from pathlib import Path
from typing import Any

import numpy as np

from rmis_calib.errors import RecordingError
from rmis_calib.io._camera_formats.camera_info import CameraInfo

IMAGE, COMPRESSED = "sensor_msgs/msg/Image", "sensor_msgs/msg/CompressedImage"
CAMERA_INFO, JOINT_STATE = "sensor_msgs/msg/CameraInfo", "sensor_msgs/msg/JointState"
POSES = ("geometry_msgs/msg/PoseStamped", "geometry_msgs/msg/TransformStamped")

_CHANNELS = {"rgb8": 3, "bgr8": 3, "8UC3": 3, "rgba8": 4, "bgra8": 4, "8UC4": 4, "mono8": 1, "8UC1": 1}
# OpenCV names a Bayer pattern by its second row's pixels, ROS by its first's.
_BAYER = {"bayer_rggb8": "BG", "bayer_bggr8": "RG", "bayer_gbrg8": "GR", "bayer_grbg8": "GB"}
_YUV = {"yuv422": "UYVY", "uyvy": "UYVY", "yuv422_yuy2": "YUY2", "yuyv": "YUY2"}
_MAGIC = {b"\xff\xd8\xff": ".jpg", b"\x89PNG": ".png"}
_LAST_WORDS = {b"\xff\xd8\xff": b"\xff\xd9", b"\x89PNG": b"IEND"}
_TAIL_BYTES = 1024
"""How far from its end a JPEG or PNG may say that it ends: cameras pad them."""
ENCODINGS = (*_CHANNELS, *_BAYER, *_YUV, "mono16", "16UC1")


def stamp_ns(message: Any, received_ns: int) -> int:
    """Time of the header; that of the recorder where the header has none."""
    stamp = message.header.stamp
    ns = int(stamp.sec) * 1_000_000_000 + int(stamp.nanosec)
    return ns if ns > 0 else received_ns


def pose_of(message: Any) -> np.ndarray:
    """x, y, z (m), qx, qy, qz, qw of a PoseStamped or TransformStamped."""
    if hasattr(message, "pose"):
        p, q = message.pose.position, message.pose.orientation
    else:
        p, q = message.transform.translation, message.transform.rotation
    return np.array([p.x, p.y, p.z, q.x, q.y, q.z, q.w], dtype=np.float64)


def camera_info_of(message: Any, topic: str) -> CameraInfo:
    """The numbers of a CameraInfo.

    Raises:
        RecordingError: it is empty, or of binned or cut pictures.
    """
    if max(message.binning_x, message.binning_y) > 1 or message.roi.width or message.roi.height:
        raise RecordingError(where=topic, expected="a camera_info of whole pictures", found="binning or a region")

    def entry(name: str) -> Any:
        return getattr(message, name, None) if hasattr(message, name) else getattr(message, name.lower())

    model = str(message.distortion_model) or "plumb_bob"
    size = (int(message.height), int(message.width))
    return CameraInfo.from_values(topic, size, model, list(map(float, entry("D"))), entry("K"), entry("R"), entry("P"))


def is_cut_off(message: Any) -> bool:
    """Whether a CompressedImage breaks off: it begins as a JPEG or PNG and never ends."""
    if not hasattr(message, "format"):
        return False
    head, tail = bytes(message.data[:4]), bytes(message.data[-_TAIL_BYTES:])
    return any(head.startswith(magic) and end not in tail for magic, end in _LAST_WORDS.items())


def write_picture(message: Any, stem: Path, topic: str) -> tuple[Path, tuple[int, int] | None]:
    """Write an Image losslessly as PNG, a CompressedImage as the bytes that it holds.

    Returns:
        the file, and (height, width) where that is known without decoding.
    Raises:
        RecordingError: an encoding that is not read, or damage.
    """
    if hasattr(message, "format"):
        data = bytes(message.data)
        suffix = next((suffix for magic, suffix in _MAGIC.items() if data.startswith(magic)), None)
        if suffix is None or str(message.format).startswith("bayer"):
            raise RecordingError(where=topic, expected="JPEG or PNG pictures", found=repr(str(message.format)))
        path = stem.with_suffix(suffix)
        path.write_bytes(data)
        return path, None
    import cv2

    path = stem.with_suffix(".png")
    picture = bgr_of(message, topic)
    _, encoded = cv2.imencode(".png", picture, [cv2.IMWRITE_PNG_COMPRESSION, 1])
    path.write_bytes(encoded.tobytes())
    return path, (picture.shape[0], picture.shape[1])


def bgr_of(message: Any, topic: str) -> np.ndarray:
    """(h, w) or (h, w, 3) of an Image, channels in OpenCV's order.

    Raises:
        RecordingError: an encoding that is not read, or too few bytes.
    """
    import cv2

    encoding, height, width = str(message.encoding), int(message.height), int(message.width)
    if encoding not in ENCODINGS:
        raise RecordingError(where=topic, expected=f"an encoding of {', '.join(ENCODINGS)}", found=repr(encoding))
    deep = encoding in ("mono16", "16UC1")
    channels = 2 if encoding in _YUV or deep else _CHANNELS.get(encoding, 1)
    data = np.frombuffer(bytes(message.data), dtype=np.uint8)
    step = int(message.step) or width * channels
    if data.size < step * height or step < width * channels:
        raise RecordingError(where=topic, expected=f"{step * height} bytes of a picture", found=f"{data.size}")
    rows = np.ascontiguousarray(data[: step * height].reshape(height, step)[:, : width * channels])
    if deep:
        return rows.view(np.dtype(">u2" if message.is_bigendian else "<u2")).astype(np.uint16)
    if encoding in _BAYER:
        return cv2.cvtColor(rows, getattr(cv2, f"COLOR_Bayer{_BAYER[encoding]}2BGR"))
    picture = rows.reshape(height, width, channels)
    if encoding in _YUV:
        return cv2.cvtColor(picture, getattr(cv2, f"COLOR_YUV2BGR_{_YUV[encoding]}"))
    if channels == 1:
        return picture[..., 0]
    picture = picture[..., :3]
    return np.ascontiguousarray(picture[..., ::-1] if encoding.startswith("rgb") else picture)
