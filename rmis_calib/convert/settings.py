"""What a conversion can be told; everything else is found by type and structure."""

from dataclasses import field

from pydantic import ConfigDict
from pydantic.dataclasses import dataclass

STILL = ("none", "None", "null")
"""Names of the laparoscope's arm that say there is none."""


@dataclass(frozen=True, kw_only=True, config=ConfigDict(extra="forbid", allow_inf_nan=False))
class ConvertSettings:
    """Overrides of what a conversion guesses."""

    robot: str | None = None
    """Shipped robot or robot.yaml. Default: the dVRK robot whose kinematics fit the poses that the source logs."""
    stereo: str | None = None
    """Camera calibration of any known format. Default: the source's own (camera_info, files of a data set)."""
    instrument: str | None = None
    """Name of the instrument's arm in the source (PSM1). Default: the instrument that moves most."""
    laparoscope: str | None = None
    """Name of the laparoscope's arm in the source (ECM); none: the camera stands still. Default: the ECM, if logged."""
    right_topic: str | None = None
    """Topic of the right pictures. Default: told by name and type."""
    left_topic: str | None = None
    """Topic of the left pictures."""
    rectified: bool | None = None
    """Whether pictures are rectified: their camera is then P of camera_info. Default: told by the topic's name."""
    shaft_diameter_mm: float = 8.0
    """Diameter of the instrument's shaft."""
    map: dict[str, str] = field(default_factory=dict)
    """Tables, LeRobot: our columns and the source's, with a unit where it is another: instrument.yaw_rad q1:deg."""
    episode: int | None = None
    """Episode of a LeRobot data set (Open-H). Default: the only one."""
    rate_hz: float | None = None
    """Pictures a second, for pictures and tables without time stamps."""
    crop_right: tuple[int, int, int, int] | None = None
    """[u, v, width, height] of the calibrated picture that the right pictures show, px."""
    crop_left: tuple[int, int, int, int] | None = None
    """The same of the left pictures."""
    salvage: bool = False
    """Convert what is whole of a truncated or damaged bag."""
