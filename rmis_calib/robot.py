"""A robot: the arms of a set-up as Denavit-Hartenberg tables on one base. Files are read into it, kinematics uses it.

Frames: `base` is shared by all arms; `arm_base` is the base of one arm. A table of J joints has the frames 0
(`arm_base`) to J (the end); joint i, counted from 1, moves frame i and all frames after it. Units: mm and rad.
"""

from collections.abc import Mapping
from dataclasses import dataclass, replace
from typing import Literal, get_args

import numpy as np
from jaxtyping import Float

from rmis_calib.errors import RobotError

JointType = Literal["revolute", "prismatic"]
DhConvention = Literal["modified", "standard"]
"""modified (Craig): Rx(alpha) Tx(a) Rz(theta) Tz(d); standard: Rz(theta) Tz(d) Tx(a) Rx(alpha)."""
JointUnit = Literal["rad", "mm"]


@dataclass(frozen=True)
class Joint:
    """One row of a DH table; the reading plus `offset` is added to theta (revolute) or to d (prismatic)."""

    name: str
    type: JointType
    alpha_rad: float
    """Twist, about x."""
    a_mm: float
    """Length along x."""
    theta_rad: float
    """Angle about z."""
    d_mm: float
    """Length along z."""
    offset: float
    """Added to the reading; rad or mm."""
    min: float | None = None
    """Least reading, rad or mm; None where the limits are not known."""
    max: float | None = None
    """Greatest reading, rad or mm."""
    offset_sigma: float | None = None
    """How well the offset is known, 1 sigma, rad or mm. Zero: exactly. None: nobody states it."""

    @property
    def unit(self) -> JointUnit:
        """Unit of the reading, the offset and the limits."""
        return "rad" if self.type == "revolute" else "mm"


@dataclass(frozen=True)
class HeadPoint:
    """The instrument's head point: a visible point that is fixed in one frame of the table."""

    frame: int
    """Number of the frame."""
    xyz_mm: tuple[float, float, float]
    """Coordinates in that frame."""


@dataclass(frozen=True, eq=False)
class Arm:
    """One arm: where its base stands, its joints and, for an instrument, where its RCM, shaft and head are."""

    base_T_arm_base: Float[np.ndarray, "4 4"] | None
    """Pose of the arm's base, mm; None where nobody knows it: the calibration then finds the arms' bases too."""
    joints: tuple[Joint, ...]
    """From the base to the end."""
    end_T_tool: Float[np.ndarray, "4 4"]
    """Pose of the tool in frame J, mm; the tool of the laparoscope's arm is `arm`. Identity where nobody gave one."""
    rcm_frame: int | None = None
    """Number of the frame whose origin is the RCM; instruments only."""
    shaft_frame: int | None = None
    """Number of the frame whose z axis is the shaft, towards the tip unless `shaft_reversed`; instruments only."""
    head_point: HeadPoint | None = None
    """Instruments only."""
    shaft_reversed: bool = False
    """The z axis of the shaft's frame points from the tip to the RCM, as in the Raven II's table."""

    @property
    def is_instrument(self) -> bool:
        """Whether the RCM, the shaft and the head point are described."""
        return self.rcm_frame is not None


@dataclass(frozen=True, eq=False)
class Robot:
    """Arms on one base."""

    name: str
    dh_convention: DhConvention
    arms: Mapping[str, Arm]
    setup_sigma_mm: float | None = None
    """How well the bases are known: 1 sigma per axis of the pose of one arm's base in another's. Zero: exactly. More
    than zero: a calibration estimates that pose too, near to what `base_T_arm_base` says. None: nobody states it."""
    setup_sigma_rad: float | None = None
    """The same of its orientation; both or neither."""
    rcm_sigma_mm: float | None = None
    """How far the shaft's axis may pass from the RCM, 1 sigma per axis across it. Zero: through it. None: nobody states
    it."""

    def without_bases(self) -> "Robot":
        """The same arms, with nothing said of where their bases are."""
        arms = {name: replace(arm, base_T_arm_base=None) for name, arm in self.arms.items()}
        return replace(self, arms=arms, setup_sigma_mm=None, setup_sigma_rad=None)

    def joints(self, *arms: str) -> dict[str, Joint]:
        """Joints of these arms by their column in joints.csv, in the order of the tables.

        Raises:
            RobotError: no such arm.
        """
        for arm in arms:
            if arm not in self.arms:
                expected = f"an arm of {', '.join(self.arms)}"
                raise RobotError(where=f"robot {self.name}", expected=expected, found=repr(arm))
        return {joint_column(arm, joint): joint for arm in arms for joint in self.arms[arm].joints}

    def columns(self, arm: str) -> tuple[str, ...]:
        """Columns of an arm in joints.csv, in the order of its joints.

        Raises:
            RobotError: no such arm.
        """
        return tuple(self.joints(arm))


def joint_column(arm: str, joint: Joint) -> str:
    """Column of a joint in joints.csv and name of its offset: `<arm>.<joint>_rad` or `_mm`."""
    return f"{arm}.{joint.name}_{joint.unit}"


def split_joint_column(column: str) -> tuple[str, JointUnit]:
    """`<arm>.<joint>` and the unit that such a column says.

    Raises:
        ValueError: the column ends in no unit of a joint.
    """
    name, _, unit = column.rpartition("_")
    for known in get_args(JointUnit):
        if unit == known:
            return name, known
    raise ValueError(f"expected a column that ends in _rad or _mm, found {column}")
