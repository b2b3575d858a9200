"""What may stand in recording.yaml, stereo.yaml and robot.yaml (docs/recording.md): every key, its type and its range.

What the keys of robot.yaml mean is said in `rmis_calib.robot`.
"""

import math
from typing import Annotated, Any, Literal

from pydantic import AfterValidator, BaseModel, ConfigDict, Field, StringConstraints, model_validator

from rmis_calib.geometry.lens_models import COEFFICIENTS, LensModel
from rmis_calib.robot import DhConvention, JointType

METRES = "looks like metres; write millimetres"
DEGREES = "looks like degrees; write radians"
# A full turn and what rounding may add to it.
FULL_TURN_RAD = 2 * math.pi * 1.001

# Names become column names of joints.csv, `<arm>.<joint>_rad`: no dot, comma or blank in them.
Name = Annotated[str, StringConstraints(pattern=r"^[A-Za-z_][A-Za-z0-9_-]*$")]
FileName = Annotated[str, StringConstraints(min_length=1)]
Row = Annotated[list[float], Field(min_length=4, max_length=4)]
Matrix = Annotated[list[Row], Field(min_length=4, max_length=4)]
Side = Annotated[int, Field(ge=16, le=100_000)]
Crop = Annotated[list[int], Field(min_length=4, max_length=4), AfterValidator(lambda crop: _inside(crop))]
"""[u, v, width, height], px, of the calibrated picture."""


def _not_degrees(value: float) -> float:
    if abs(value) > FULL_TURN_RAD:
        raise ValueError(f"{DEGREES}; expected at most one turn, found {value:g}")
    return value


def _inside(crop: list[int]) -> list[int]:
    if min(crop[:2]) < 0 or min(crop[2:]) < 16:
        raise ValueError(f"expected [u, v, width, height] with u, v >= 0 and a size of 16 px or more, found {crop}")
    return crop


def _shaft_diameter(value: float) -> float:
    if not 1.0 <= value <= 30.0:
        hint = f"{METRES}; " if 0 < value < 1.0 else ""
        raise ValueError(f"{hint}expected a diameter of 1 to 30 mm, found {value:g}")
    return value


Angle = Annotated[float, AfterValidator(_not_degrees)]
ShaftDiameter = Annotated[float, AfterValidator(_shaft_diameter)]


class Schema(BaseModel):
    """Nothing unknown, nothing converted, nothing infinite."""

    model_config = ConfigDict(extra="forbid", strict=True, allow_inf_nan=False, frozen=True)


class CameraPairSchema(Schema):
    """Two files of one camera each, as ROS writes them."""

    right: FileName
    left: FileName


class RecordingSchema(Schema):
    format: Literal["rmis-calib/1"]
    robot: FileName
    stereo: FileName | CameraPairSchema
    right: FileName
    left: FileName | None = None
    joints: FileName
    frame_times: FileName | None = None
    laparoscope_arm: Name | None
    instrument_arm: Name
    shaft_diameter_mm: ShaftDiameter
    clock_offset_s: float = 0.0
    stereo_layout: Literal["side_by_side", "top_bottom"] | None = None
    swapped: bool = False
    crop_right: Crop | None = None
    crop_left: Crop | None = None
    rolling_shutter_s: Annotated[float, Field(ge=0.0, le=1.0)] = 0.0
    notes: list[str] = Field(default_factory=list)

    @property
    def stereo_files(self) -> tuple[str, ...]:
        """The files that `stereo` names, the right camera's first."""
        return (self.stereo.right, self.stereo.left) if isinstance(self.stereo, CameraPairSchema) else (self.stereo,)

    @property
    def is_stereo(self) -> bool:
        return self.left is not None or self.stereo_layout is not None

    @model_validator(mode="after")
    def _two_of_each(self) -> "RecordingSchema":
        if self.laparoscope_arm == self.instrument_arm:
            raise ValueError(f"expected two different arms, found {self.instrument_arm!r} for both")
        if self.left == self.right:
            raise ValueError(
                f"expected two different videos, found {self.right!r} for both cameras (where one file shows both "
                "eyes, write stereo_layout: side_by_side or top_bottom, and no left)"
            )
        if self.stereo_layout is not None and self.left is not None:
            raise ValueError(f"expected no left beside stereo_layout (right holds both eyes), found {self.left!r}")
        if self.swapped and self.stereo_layout is None:
            raise ValueError("expected stereo_layout beside swapped, found none")
        if self.crop_left is not None and not self.is_stereo:
            raise ValueError("expected a left camera beside crop_left, found none")
        return self


class CameraSchema(Schema):
    fx: Annotated[float, Field(gt=0)]
    fy: Annotated[float, Field(gt=0)]
    cx: float
    cy: float
    distortion_model: LensModel = "plumb_bob"
    distortion: list[float]

    @model_validator(mode="before")
    @classmethod
    def _with_distortion(cls, given: Any) -> Any:
        if isinstance(given, dict) and "distortion" not in given and set(given) <= set(cls.model_fields):
            expected = "distortion: [k1, k2, p1, p2, k3] (five zeros for undistorted images)"
            raise ValueError(f"expected {expected}, found none")
        return given

    @model_validator(mode="after")
    def _as_many_as_the_model_has(self) -> "CameraSchema":
        expected = COEFFICIENTS[self.distortion_model]
        if len(self.distortion) != expected:
            others = [model for model, count in COEFFICIENTS.items() if count == len(self.distortion)]
            hint = f" (distortion_model: {others[0]}?)" if others else ""
            raise ValueError(
                f"expected {expected} entries of distortion for {self.distortion_model}, "
                f"found {len(self.distortion)}{hint}"
            )
        return self


class StereoSchema(Schema):
    image_size: Annotated[list[Side], Field(min_length=2, max_length=2)]
    right: CameraSchema
    left: CameraSchema | None = None
    camera_left_T_camera_right: Matrix | None = None

    @model_validator(mode="after")
    def _left_with_extrinsics(self) -> "StereoSchema":
        if (self.left is None) != (self.camera_left_T_camera_right is None):
            present = "left" if self.camera_left_T_camera_right is None else "camera_left_T_camera_right"
            raise ValueError(f"expected both left and camera_left_T_camera_right or neither, found only {present}")
        return self


LARGEST_OFFSET_SIGMA_RAD = 0.2
"""12 deg: an encoder of which so little is known has its offset measured, not estimated."""


class JointSchema(Schema):
    name: Name
    type: JointType
    alpha_rad: Angle
    a_mm: float
    theta_rad: Angle
    d_mm: float
    offset: float
    min: float | None = None
    max: float | None = None
    offset_sigma: Annotated[float, Field(ge=0)] | None = None

    @model_validator(mode="after")
    def _sane(self) -> "JointSchema":
        if (self.min is None) != (self.max is None):
            raise ValueError("expected both min and max or neither, found one")
        if self.min is not None and self.max is not None and self.min >= self.max:
            raise ValueError(f"expected min < max, found {self.min:g} and {self.max:g}")
        readings = [self.offset, *(limit for limit in (self.min, self.max) if limit is not None)]
        if self.type == "revolute" and max(map(abs, readings)) > FULL_TURN_RAD:
            raise ValueError(f"{DEGREES}; expected offset, min and max within one turn, found {readings}")
        if self.type == "revolute" and (self.offset_sigma or 0.0) > LARGEST_OFFSET_SIGMA_RAD:
            expected = f"expected offset_sigma at most {LARGEST_OFFSET_SIGMA_RAD:g} rad"
            raise ValueError(f"{DEGREES}; {expected}, found {self.offset_sigma:g}")
        if self.type == "prismatic" and 0 < max(map(abs, readings[1:]), default=0.0) < 1.0:
            raise ValueError(f"{METRES}; expected limits in mm, found {readings[1:]}")
        return self


class HeadPointSchema(Schema):
    frame: Annotated[int, Field(ge=0)]
    xyz_mm: Annotated[list[float], Field(min_length=3, max_length=3)]


class ArmSchema(Schema):
    base_T_arm_base: Matrix | None = None
    joints: Annotated[list[JointSchema], Field(min_length=1)]
    end_T_tool: Matrix | None = None
    rcm_frame: Annotated[int, Field(ge=0)] | None = None
    shaft_frame: Annotated[int, Field(ge=0)] | None = None
    head_point: HeadPointSchema | None = None
    shaft_reversed: bool = False

    @model_validator(mode="after")
    def _sane(self) -> "ArmSchema":
        names = [joint.name for joint in self.joints]
        if len(set(names)) < len(names):
            raise ValueError(f"expected joint names that differ, found {', '.join(names)}")
        lengths = [abs(length) for joint in self.joints for length in (joint.a_mm, joint.d_mm)]
        lengths += [abs(joint.offset) for joint in self.joints if joint.type == "prismatic"]
        if 0 < max(lengths) < 1.0:
            raise ValueError(f"{METRES}; expected DH lengths in mm, found none above {max(lengths):g}")
        self._check_shaft_keys()
        return self

    def _check_shaft_keys(self) -> None:
        frames = {"rcm_frame": self.rcm_frame, "shaft_frame": self.shaft_frame, "head_point": self.head_point}
        given = [key for key, value in frames.items() if value is not None]
        if given and len(given) < 3:
            missing = ", ".join(key for key in frames if key not in given)
            raise ValueError(f"expected rcm_frame, shaft_frame and head_point together, found no {missing}")
        if self.rcm_frame is None or self.shaft_frame is None or self.head_point is None:
            return
        for key, frame in (("rcm_frame", self.rcm_frame), ("head_point.frame", self.head_point.frame)):
            if frame > len(self.joints):
                raise ValueError(f"expected {key} from 0 to {len(self.joints)} (the joints), found {frame}")
        if not self.shaft_frame <= self.head_point.frame:
            expected = f"expected shaft_frame at most head_point.frame ({self.head_point.frame})"
            raise ValueError(f"{expected}, found {self.shaft_frame}")


class RobotSchema(Schema):
    name: Annotated[str, StringConstraints(min_length=1)]
    dh_convention: DhConvention
    arms: Annotated[dict[Name, ArmSchema], Field(min_length=1)]
    setup_sigma_mm: Annotated[float, Field(ge=0)] | None = None
    setup_sigma_deg: Annotated[float, Field(ge=0, le=180)] | None = None
    rcm_sigma_mm: Annotated[float, Field(ge=0, le=50)] | None = None

    @model_validator(mode="after")
    def _prior_of_stated_bases(self) -> "RobotSchema":
        if (self.setup_sigma_mm is None) != (self.setup_sigma_deg is None):
            present = "setup_sigma_mm" if self.setup_sigma_deg is None else "setup_sigma_deg"
            raise ValueError(f"expected both setup_sigma_mm and setup_sigma_deg or neither, found only {present}")
        if ((self.setup_sigma_mm or 0.0) > 0) != ((self.setup_sigma_deg or 0.0) > 0):
            raise ValueError("expected setup_sigma_mm and setup_sigma_deg both zero (exact) or both positive")
        unplaced = [name for name, arm in self.arms.items() if arm.base_T_arm_base is None]
        if self.setup_sigma_mm is not None and unplaced:
            raise ValueError(f"expected base_T_arm_base of {', '.join(unplaced)} beside setup_sigma_mm, found none")
        return self
