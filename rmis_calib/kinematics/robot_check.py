"""What can be said of a robot's description on its own: does the shaft keep to its RCM, where can the arms reach."""

from dataclasses import dataclass, field

import numpy as np
import torch
from jaxtyping import Float

from rmis_calib.kinematics.dh import build_chain, frame_poses
from rmis_calib.robot import Arm, Joint, Robot

RCM_TOLERANCE_MM = 1e-3
"""A mechanical RCM of a DH table is exact; a micrometre is rounding of printed tables."""
_SAMPLES = 2000
_SEED = 0
_ALONE_RAD, _ALONE_MM = 0.5, (50.0, 150.0)
"""Ranges of joints without limits: revolute either way, prismatic beside what the offset takes back."""


@dataclass(frozen=True, eq=False)
class ArmReport:
    """One arm over random readings within its limits."""

    name: str
    is_instrument: bool
    joints: tuple[str, ...]
    """Name, unit and range of each."""
    reach_mm: Float[np.ndarray, "2 3"]
    """Least and greatest coordinates of the head point (instrument) or of the tool (laparoscope), in `base`."""
    rcm_moves_mm: float | None
    """Largest distance of the RCM frame's origin from its mean; None for a laparoscope's arm."""
    shaft_misses_mm: float | None
    """Largest distance of the shaft's axis from the RCM frame's origin; None for a laparoscope's arm."""
    problems: tuple[str, ...] = ()
    remarks: tuple[str, ...] = ()
    segments_mm: Float[np.ndarray, "k n 3"] = field(default_factory=lambda: np.empty((0, 0, 3)))
    """Some poses as chains of points in `base`, for drawing: RCM and head point, or the frames' origins."""


def check_robot(robot: Robot) -> list[ArmReport]:
    """Every arm's report."""
    reports = [_check_arm(robot, name, arm) for name, arm in robot.arms.items()]
    bases = [arm.base_T_arm_base for arm in robot.arms.values() if arm.base_T_arm_base is not None]
    if len(bases) > 1 and all(np.array_equal(base, bases[0]) for base in bases):
        said = "all arms have their base at the same place: base_T_arm_base is still to be filled in"
        reports[0] = _with_problem(reports[0], said)
    return reports


def _with_problem(report: ArmReport, problem: str) -> ArmReport:
    return ArmReport(**{**vars(report), "problems": (*report.problems, problem)})


def random_readings(arm: Arm, count: int = _SAMPLES, seed: int = _SEED) -> Float[np.ndarray, "n j"]:
    """Readings spread evenly over the joints' limits; half a radian, or 50 to 150 mm out, where there are none."""
    ranges = np.array([_range(joint) for joint in arm.joints])
    return np.random.default_rng(seed).uniform(ranges[:, 0], ranges[:, 1], (count, len(arm.joints)))


def _range(joint: Joint) -> tuple[float, float]:
    if joint.min is not None and joint.max is not None:
        return joint.min, joint.max
    if joint.type == "revolute":
        return -_ALONE_RAD, _ALONE_RAD
    return _ALONE_MM[0] - joint.offset, _ALONE_MM[1] - joint.offset


def _check_arm(robot: Robot, name: str, arm: Arm) -> ArmReport:
    readings = random_readings(arm)
    offsets = np.array([joint.offset for joint in arm.joints])
    chain = build_chain(arm.joints, robot.dh_convention, torch.float64)
    frames = frame_poses(chain, torch.from_numpy(readings + offsets)).numpy()
    if arm.base_T_arm_base is not None:
        frames = np.asarray(arm.base_T_arm_base) @ frames
    joints = tuple(_described(joint) for joint in arm.joints)
    free = ", ".join(joint.name for joint in arm.joints if joint.min is None)
    remarks = (f"no limits of {free}: their readings are checked only for the right unit",) if free else ()
    if not arm.is_instrument or arm.rcm_frame is None or arm.shaft_frame is None or arm.head_point is None:
        tool = (frames[:, -1] @ np.asarray(arm.end_T_tool))[:, :3, 3]
        reach = np.stack([tool.min(0), tool.max(0)])
        return ArmReport(name, False, joints, reach, None, None, (), remarks, frames[:4, :, :3, 3])
    rcm = frames[:, arm.rcm_frame, :3, 3]
    axis, on_axis = frames[:, arm.shaft_frame, :3, 2], frames[:, arm.shaft_frame, :3, 3]
    axis = -axis if arm.shaft_reversed else axis
    head = frames[:, arm.head_point.frame]
    head = head[:, :3, 3] + (head[:, :3, :3] @ np.array(arm.head_point.xyz_mm))
    moves = float(np.linalg.norm(rcm - rcm.mean(0), axis=-1).max())
    misses = float(np.linalg.norm(np.cross(axis, rcm - on_axis), axis=-1).max())
    problems, said = _rcm_findings(moves, misses, ((head - rcm) * axis).sum(-1))
    reach = np.stack([head.min(0), head.max(0)])
    segments = np.stack([rcm[:12], head[:12]], axis=1)
    return ArmReport(name, True, joints, reach, moves, misses, problems, (*said, *remarks), segments)


def _rcm_findings(moves: float, misses: float, beyond_mm: np.ndarray) -> tuple[tuple[str, ...], tuple[str, ...]]:
    problems, remarks = [], []
    if misses > RCM_TOLERANCE_MM:
        problems.append(
            f"the shaft's axis misses the RCM by up to {misses:.3g} mm: wrong rcm_frame, shaft_frame or table"
        )
    if moves > RCM_TOLERANCE_MM:
        remarks.append(
            f"the RCM frame moves by up to {moves:.3g} mm with the joints: the RCM is made by software, and rcm_frame "
            "is only a point on the shaft"
        )
    behind = float((beyond_mm < 0).mean())
    if behind > 0.5:
        problems.append(f"the head point lies behind the RCM in {100 * behind:.0f} % of the poses: shaft_reversed?")
    elif behind > 0:
        remarks.append(f"in {100 * behind:.0f} % of the poses the head point is still in the cannula, before the RCM")
    return tuple(problems), tuple(remarks)


def _described(joint: Joint) -> str:
    if joint.min is None:
        return f"{joint.name} ({joint.type}, {joint.unit})"
    return f"{joint.name} ({joint.type}, {joint.min:g} to {joint.max:g} {joint.unit})"
