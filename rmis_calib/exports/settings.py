"""What an export can be told: names of frames, the camera and its axes, and the place of the arms."""

import re
from typing import Literal, get_args

from pydantic import ConfigDict, field_validator
from pydantic.dataclasses import dataclass

Side = Literal["right", "left"]
Axes = Literal["opencv", "isi"]
FormatName = Literal[
    "csv",
    "dvrk",
    "easy-handeye2",
    "ethz",
    "moveit",
    "opencv-json",
    "opencv-yaml",
    "ros-static-tf",
    "surgsync",
    "tum",
    "urdf-origin",
]
SUFFIXES: dict[FormatName, str] = {
    "csv": ".csv",
    "dvrk": "",
    "easy-handeye2": ".calib",
    "ethz": ".json",
    "moveit": ".launch",
    "opencv-json": ".json",
    "opencv-yaml": ".yaml",
    "ros-static-tf": "",
    "surgsync": "",
    "tum": ".txt",
    "urdf-origin": ".urdf",
}
"""How a file of each format ends by default; folders have no ending."""
FORMAT_NAMES: tuple[FormatName, ...] = get_args(FormatName)

AXES_IN_WORDS: dict[Axes, str] = {
    "opencv": "OpenCV (x right, y down, z forward)",
    "isi": "ISI/dVRK (x left, y up, z forward)",
}
_FRAME_NAME = re.compile(r"[A-Za-z0-9_/][A-Za-z0-9_./]*")


@dataclass(frozen=True, config=ConfigDict(extra="forbid"))
class ExportSettings:
    """Names and choices that a result does not hold."""

    camera: Side | None = None
    """The camera of formats that hold one. Default: right. surgsync is always of the left one."""
    axes: Axes | None = None
    """Camera axes: opencv (x right, y down, z forward) or isi (x left, y up, z forward, as the dVRK counts). Default:
    opencv; each file of dvrk and surgsync has its own."""
    arm_frame: str = "arm"
    """Name of the frame that carries the camera: ECM, say; of the robot's base where the camera stands still."""
    base_frame: str = "base"
    """Name of the robot's base, for formats that ask for it."""
    camera_right_frame: str = "camera_right"
    """Name of the right camera's frame."""
    camera_left_frame: str = "camera_left"
    """Name of the left camera's frame."""
    eye_on_base: bool = False
    """The camera stands still and `arm` is the robot's base (known by itself from a recording)."""
    instrument: str = "PSM1"
    """Name of the instrument's arm, for dvrk and surgsync."""
    frame: int | None = None
    """Frame of the recording at whose joints the arms are placed, for dvrk and surgsync. Default: the last known."""

    @field_validator("arm_frame", "base_frame", "camera_right_frame", "camera_left_frame", "instrument")
    @classmethod
    def _is_name(cls, value: str) -> str:
        if not _FRAME_NAME.fullmatch(value):
            raise ValueError("a name of letters, digits, _, / and .")
        return value
