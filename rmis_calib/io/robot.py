"""Robot descriptions: arms as DH tables, from robot.yaml or a shipped preset (DESIGN.md 6.1)."""

from dataclasses import dataclass
from pathlib import Path
from typing import Literal

import numpy as np

from rmis_calib.errors import RobotError
from rmis_calib.io._checks import Note, no_note, rigid_from_text
from rmis_calib.io._schemas import ArmSchema, JointSchema, RobotSchema
from rmis_calib.io.configs import config_path, load_yaml
from rmis_calib.io.validation import validate


@dataclass(frozen=True)
class Joint:
    """One row of a DH table; the reading plus `offset` is added to theta (revolute) or d (prismatic)."""

    name: str
    type: Literal["revolute", "prismatic"]
    alpha_rad: float
    a_mm: float
    theta_rad: float
    d_mm: float
    offset: float
    """Added to the reading; rad or mm."""
    min: float | None = None
    """Least reading; rad or mm; None where the limits are not known."""
    max: float | None = None
    """Greatest reading; rad or mm."""

    @property
    def unit(self) -> Literal["rad", "mm"]:
        """Unit of the reading, the offset and the limits."""
        return "rad" if self.type == "revolute" else "mm"


@dataclass(frozen=True)
class HeadPoint:
    """The instrument's head point: a point fixed in one DH frame."""

    frame: int
    """Number of DH frames from the arm's base."""
    xyz_mm: tuple[float, float, float]


@dataclass(frozen=True, eq=False)
class Arm:
    """One arm: where its base stands, its joints and, for an instrument, where its RCM, shaft and head are."""

    base_T_arm_base: np.ndarray
    """(4, 4), mm."""
    joints: tuple[Joint, ...]
    end_T_tool: np.ndarray
    """(4, 4), mm; identity where the file gives none."""
    rcm_frame: int | None = None
    """Number of DH frames from the arm's base (0: the base) whose origin is the RCM; instruments only."""
    shaft_frame: int | None = None
    """Number of DH frames from the arm's base whose z axis is the shaft, towards the tip; instruments only."""
    head_point: HeadPoint | None = None
    """Instruments only."""

    @property
    def is_instrument(self) -> bool:
        """Whether the RCM, the shaft and the head point are described."""
        return self.rcm_frame is not None


@dataclass(frozen=True, eq=False)
class Robot:
    """Two arms on one base."""

    name: str
    dh_convention: Literal["modified", "standard"]
    arms: dict[str, Arm]

    def columns(self, arm: str) -> tuple[str, ...]:
        """Column names of an arm in joints.csv, in the order of its joints: `<arm>.<joint>_rad` or `_mm`.

        Raises:
            RobotError: no such arm.
        """
        if arm not in self.arms:
            raise RobotError(where=f"robot {self.name}", expected=f"an arm of {', '.join(self.arms)}", found=repr(arm))
        return tuple(f"{arm}.{joint.name}_{joint.unit}" for joint in self.arms[arm].joints)


def load_robot(name_or_path: str | Path, note: Note = no_note) -> Robot:
    """A robot from a YAML file, or a shipped preset (`configs/robots`) by name.

    Args:
        name_or_path: a preset's name, or a path that ends in .yaml or .yml.
        note: told what was mended.

    Raises:
        FileError: the file is absent or unreadable.
        RobotError: no such preset (lists the shipped ones), or an entry that is missing, unknown or impossible.
    """
    path = Path(name_or_path)
    if path.suffix.lower() not in (".yaml", ".yml"):
        path = config_path("robots", str(name_or_path), RobotError)
    schema = validate(RobotSchema, load_yaml(path, RobotError), str(path), RobotError)
    arms = {name: _arm(arm, f"{path}: arms.{name}", note) for name, arm in schema.arms.items()}
    return Robot(schema.name, schema.dh_convention, arms)


def _arm(schema: ArmSchema, where: str, note: Note) -> Arm:
    base_T_arm_base = rigid_from_text(schema.base_T_arm_base, f"{where}.base_T_arm_base", RobotError, note)
    end_T_tool = np.eye(4)
    if schema.end_T_tool is not None:
        end_T_tool = rigid_from_text(schema.end_T_tool, f"{where}.end_T_tool", RobotError, note)
    head = schema.head_point
    return Arm(
        base_T_arm_base,
        tuple(_joint(joint) for joint in schema.joints),
        end_T_tool,
        schema.rcm_frame,
        schema.shaft_frame,
        None if head is None else HeadPoint(head.frame, (head.xyz_mm[0], head.xyz_mm[1], head.xyz_mm[2])),
    )


def _joint(schema: JointSchema) -> Joint:
    return Joint(**schema.model_dump())
