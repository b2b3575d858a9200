"""Small videos and recordings made on the fly; nothing here comes from the package under test."""

from collections.abc import Callable
from pathlib import Path

import av
import cv2
import numpy as np
import yaml

WIDTH, HEIGHT, FRAMES, FPS = 96, 64, 12, 25


def frame_image(number: int, width: int = WIDTH, height: int = HEIGHT) -> np.ndarray:
    """A flat grey that tells the frame's number after lossy coding, with texture; RGB."""
    image = np.full((height, width, 3), 8 * number + 20, np.uint8)
    image[: height // 4, :, 0] = 200
    image[-height // 4 :, :, 2] = np.arange(width, dtype=np.uint8) * 2
    return image


def frame_number(image: np.ndarray) -> int:
    """Inverse of `frame_image` for a (3, H, W) or (H, W, 3) picture."""
    plane = image[1] if image.shape[0] == 3 else image[..., 1]
    height = plane.shape[0]
    return round((float(plane[height // 3 : height // 2].mean()) - 20) / 8)


def write_video(
    path: Path,
    frames: int = FRAMES,
    codec: str = "libx264",
    size: tuple[int, int] = (WIDTH, HEIGHT),
    container_options: dict[str, str] | None = None,
    pts: list[int] | None = None,
) -> Path:
    """A video of `frame_image`s; `pts` in units of 1 / FPS."""
    with av.open(str(path), "w", options=container_options or {}) as container:
        options = {"g": "5", "bf": "2"} if codec == "libx264" else {}
        stream = container.add_stream(codec, rate=FPS, options=options)
        stream.width, stream.height = size
        stream.pix_fmt = "yuvj420p" if codec == "mjpeg" else "yuv420p"
        for number in range(frames):
            frame = av.VideoFrame.from_ndarray(frame_image(number, *size), format="rgb24")
            if pts is not None:
                frame.pts = pts[number]
            container.mux(stream.encode(frame))
        container.mux(stream.encode())
    return path


def write_images(folder: Path, frames: int = FRAMES, suffix: str = ".png") -> Path:
    folder.mkdir(parents=True)
    for number in range(frames):
        assert cv2.imwrite(str(folder / f"{number:04d}{suffix}"), frame_image(number)[..., ::-1])
    return folder


def truncate(path: Path, fraction: float) -> Path:
    data = path.read_bytes()
    path.write_bytes(data[: int(len(data) * fraction)])
    return path


def identity(x_mm: float = 0.0) -> list[list[float]]:
    return [[1.0, 0.0, 0.0, x_mm], [0.0, 1.0, 0.0, 0.0], [0.0, 0.0, 1.0, 0.0], [0.0, 0.0, 0.0, 1.0]]


def joint(name: str, kind: str, d_mm: float = 0.0, **limits: float) -> dict:
    row = {"name": name, "type": kind, "alpha_rad": 0.0, "a_mm": 0.0, "theta_rad": 0.0, "d_mm": d_mm, "offset": 0.0}
    return row | limits


def robot_dict() -> dict:
    instrument = {
        "base_T_arm_base": identity(100.0),
        "joints": [
            joint("yaw", "revolute", min=-1.5, max=1.5),
            joint("pitch", "revolute"),
            joint("insertion", "prismatic", d_mm=-400.0, min=0.0, max=240.0),
        ],
        "rcm_frame": 0,
        "shaft_frame": 3,
        "head_point": {"frame": 3, "xyz_mm": [0.0, 0.0, 416.2]},
    }
    laparoscope = {
        "base_T_arm_base": identity(),
        "joints": [joint("yaw", "revolute"), joint("insertion", "prismatic", d_mm=-380.0)],
        "end_T_tool": identity(),
    }
    return {
        "name": "test",
        "dh_convention": "modified",
        "arms": {"laparoscope": laparoscope, "instrument": instrument},
    }


def stereo_dict() -> dict:
    camera = {"fx": 90.0, "fy": 91.0, "cx": 47.5, "cy": 31.5, "distortion": [-0.1, 0.01, 0.0, 0.0, 0.0]}
    return {
        "image_size": [WIDTH, HEIGHT],
        "right": dict(camera),
        "left": dict(camera),
        "camera_left_T_camera_right": identity(5.0),
    }


COLUMNS = (
    "timestamp_s",
    "laparoscope.yaw_rad",
    "laparoscope.insertion_mm",
    "instrument.yaw_rad",
    "instrument.pitch_rad",
    "instrument.insertion_mm",
)


def joint_rows(samples: int = 60, rate: float = 100.0) -> np.ndarray:
    """Log at 100 Hz that covers the video of 12 frames at 25 fps."""
    t = np.arange(samples) / rate
    return np.stack([t, 0.2 * t, 30 + 5 * t, -0.3 + 0.1 * t, 0.1 - 0.2 * t, 150 + 10 * t], axis=1)


def write_csv(path: Path, columns: tuple[str, ...], rows: np.ndarray) -> Path:
    lines = [",".join(columns), *(",".join(f"{value:.9g}" for value in row) for row in rows)]
    path.write_text("\n".join(lines) + "\n", encoding="utf-8")
    return path


class RecordingFolder:
    """A valid stereo recording on disk, and ways to break it."""

    def __init__(self, path: Path) -> None:
        self.path = path
        self.yaml: dict[str, dict] = {
            "recording.yaml": {
                "format": "rmis-calib/1",
                "robot": "robot.yaml",
                "stereo": "stereo.yaml",
                "right": "right.mp4",
                "left": "left.mp4",
                "joints": "joints.csv",
                "frame_times": "frame_times.csv",
                "laparoscope_arm": "laparoscope",
                "instrument_arm": "instrument",
                "shaft_diameter_mm": 8.0,
                "clock_offset_s": 0.02,
            },
            "robot.yaml": robot_dict(),
            "stereo.yaml": stereo_dict(),
        }
        path.mkdir()
        self.write()
        write_video(path / "right.mp4")
        (path / "left.mp4").write_bytes((path / "right.mp4").read_bytes())
        write_csv(path / "joints.csv", COLUMNS, joint_rows())
        self.write_frame_times(np.arange(FRAMES) / FPS)

    def write(self) -> None:
        for name, value in self.yaml.items():
            (self.path / name).write_text(yaml.safe_dump(value, sort_keys=False), encoding="utf-8")

    def write_frame_times(self, times_s: np.ndarray) -> None:
        rows = np.stack([np.arange(len(times_s)), times_s], axis=1)
        write_csv(self.path / "frame_times.csv", ("frame", "timestamp_s"), rows)

    def edit(self, name: str, change: Callable[[dict], object]) -> None:
        change(self.yaml[name])
        self.write()

    def edit_line(self, name: str, line: int, change: Callable[[str], str]) -> None:
        """Change one line of a file; lines count from 1."""
        lines = (self.path / name).read_text(encoding="utf-8").split("\n")
        lines[line - 1] = change(lines[line - 1])
        (self.path / name).write_text("\n".join(lines), encoding="utf-8")
