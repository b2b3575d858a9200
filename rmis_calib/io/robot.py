"""Robots from robot.yaml or a shipped preset (docs/recording.md)."""

import math
from pathlib import Path

import numpy as np

from rmis_calib.errors import RobotError
from rmis_calib.io._checks import Note, no_note, rigid_from_text
from rmis_calib.io._schemas import ArmSchema, HeadPointSchema, RobotSchema
from rmis_calib.io.configs import config_path, load_yaml
from rmis_calib.io.validation import validate
from rmis_calib.robot import Arm, HeadPoint, Joint, Robot


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
    sigma_rad = None if schema.setup_sigma_deg is None else math.radians(schema.setup_sigma_deg)
    return Robot(schema.name, schema.dh_convention, arms, schema.setup_sigma_mm, sigma_rad, schema.rcm_sigma_mm)


def robot_to_dict(robot: Robot) -> dict:
    """As robot.yaml writes it: `load_robot` of it gives the same numbers."""
    prior = {}
    if robot.setup_sigma_mm is not None and robot.setup_sigma_rad is not None:
        # Digits beyond a micro-degree are the rounding of the conversion.
        degrees = round(math.degrees(robot.setup_sigma_rad), 6)
        prior = {"setup_sigma_mm": robot.setup_sigma_mm, "setup_sigma_deg": degrees}
    if robot.rcm_sigma_mm is not None:
        prior["rcm_sigma_mm"] = robot.rcm_sigma_mm
    return {
        "name": robot.name,
        "dh_convention": robot.dh_convention,
        **prior,
        "arms": {name: _arm_to_dict(arm) for name, arm in robot.arms.items()},
    }


def _arm_to_dict(arm: Arm) -> dict:
    stated = arm.base_T_arm_base is not None
    content: dict = {"base_T_arm_base": np.asarray(arm.base_T_arm_base).tolist()} if stated else {}
    content["joints"] = []
    for joint in arm.joints:
        row = {key: getattr(joint, key) for key in ("name", "type", "alpha_rad", "a_mm", "theta_rad", "d_mm", "offset")}
        limits = {} if joint.min is None else {"min": joint.min, "max": joint.max}
        known = {} if joint.offset_sigma is None else {"offset_sigma": joint.offset_sigma}
        content["joints"].append(row | limits | known)
    if not np.array_equal(arm.end_T_tool, np.eye(4)):
        content["end_T_tool"] = np.asarray(arm.end_T_tool).tolist()
    if arm.head_point is not None:
        content |= {"rcm_frame": arm.rcm_frame, "shaft_frame": arm.shaft_frame}
        content |= {"shaft_reversed": True} if arm.shaft_reversed else {}
        content["head_point"] = {"frame": arm.head_point.frame, "xyz_mm": list(arm.head_point.xyz_mm)}
    return content


def _arm(schema: ArmSchema, where: str, note: Note) -> Arm:
    base_T_arm_base = None
    if schema.base_T_arm_base is not None:
        base_T_arm_base = rigid_from_text(schema.base_T_arm_base, f"{where}.base_T_arm_base", RobotError, note)
    end_T_tool = np.eye(4)
    if schema.end_T_tool is not None:
        end_T_tool = rigid_from_text(schema.end_T_tool, f"{where}.end_T_tool", RobotError, note)
    return Arm(
        base_T_arm_base,
        tuple(Joint(**joint.model_dump()) for joint in schema.joints),
        end_T_tool,
        schema.rcm_frame,
        schema.shaft_frame,
        _head_point(schema.head_point),
        schema.shaft_reversed,
    )


def _head_point(schema: HeadPointSchema | None) -> HeadPoint | None:
    if schema is None:
        return None
    x, y, z = schema.xyz_mm
    return HeadPoint(schema.frame, (x, y, z))
