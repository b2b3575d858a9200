"""A URDF as a DH table: the axes of its joints at zero, found by moving one joint at a time, and their common normals.

Works on whatever the URDF's own forward kinematics does, mimic joints included, and is checked against it.
"""

import math
import xml.etree.ElementTree as ElementTree
from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
import torch
from jaxtyping import Float
from pytorch_kinematics.urdf import build_chain_from_urdf

from rmis_calib.errors import RobotError
from rmis_calib.kinematics.dh import build_chain, frame_poses
from rmis_calib.robot import Arm, HeadPoint, Joint, JointType, Robot

_MM = 1000.0
_SNAP_RAD = 1.2e-4
"""Angles in a URDF this near to a multiple of a right angle are one, printed with four decimals (1.5708, 1.5707)."""
_PROBE_RAD, _PROBE_MM = 0.3, 20.0
_PARALLEL, _SAME_MM = 1e-9, 1e-6
_TOLERANCE_MM, _CHECKS = 1e-3, 200


@dataclass(frozen=True, eq=False)
class _Axis:
    """A joint at zero: the line that it turns about or slides along, in the URDF's root frame, mm."""

    name: str
    type: JointType
    w: Float[np.ndarray, "3"]
    p: Float[np.ndarray, "3"]
    limits: tuple[float, float] | None


def robot_from_urdf(
    xml: bytes,
    name: str,
    shaft_link: str,
    head_link: str,
    rcm_link: str | None = None,
    note: Callable[[str], None] = lambda _: None,
) -> Robot:
    """A robot of one instrument arm.

    Args:
        xml: content of the .urdf.
        name: of the robot.
        shaft_link: the link that the shaft is: the axis of the joint that moves it is the shaft's.
        head_link: the link whose origin is the head point.
        rcm_link: a link whose origin is the RCM; None: where the axes of the first two joints meet.
        note: told what was guessed.

    Raises:
        RobotError: no URDF, an unknown link, or a chain that no table of revolute and prismatic joints describes.
    """
    tree = _Tree(xml, note)
    axes = tree.axes(head_link)
    shaft_frame = len(tree.drivers(shaft_link))
    if not 0 < shaft_frame <= len(axes):
        raise RobotError(
            where=f"link {shaft_link}", expected="a link that joints move, before the head's", found="another"
        )
    rest = np.zeros(len(axes))
    rcm = tree.pose(rcm_link, rest)[:3, 3] if rcm_link is not None else _meeting_point(axes[0], axes[1])
    is_fixed = rcm is not None and _distance(axes[0], rcm) < _TOLERANCE_MM
    frames = _dh_frames(axes, rcm if is_fixed and rcm is not None else axes[0].p)
    rows = _dh_rows(axes, frames)
    head_p = np.linalg.inv(frames[-1]) @ tree.pose(head_link, rest)[:, 3]
    if not is_fixed:
        note("no RCM that the mechanism fixes: it is made by software, and rcm_frame is only a point on the shaft")
    middle = np.array([0.5 * sum(axis.limits) if axis.limits else 0.0 for axis in axes])
    base_T_frames = _table_frames(rows, middle[None], frames[0])[0]
    beyond = base_T_frames[-1] @ head_p - base_T_frames[0 if is_fixed else shaft_frame][:, 3]
    arm = Arm(
        frames[0], rows, np.eye(4), 0 if is_fixed else shaft_frame, shaft_frame,
        HeadPoint(len(rows), (float(head_p[0]), float(head_p[1]), float(head_p[2]))),
        bool(beyond[:3] @ base_T_frames[shaft_frame][:3, 2] < 0),
    )  # fmt: skip
    _check(tree, arm, axes, head_link)
    return Robot(name, "modified", {"instrument": arm})


class _Tree:
    """Forward kinematics of a URDF over its independent joints; mm."""

    def __init__(self, xml: bytes, note: Callable[[str], None]) -> None:
        try:
            root = ElementTree.fromstring(xml)
            snapped = _snap(root)
            self._chain = build_chain_from_urdf(ElementTree.tostring(root)).to(dtype=torch.float64)
        except (ElementTree.ParseError, ValueError, KeyError, AttributeError, TypeError, AssertionError) as problem:
            raise RobotError(
                where="URDF", expected="a robot in URDF (run xacro first)", found=str(problem)
            ) from problem
        if snapped:
            note(f"{snapped} angles of the URDF were printed with few digits and taken for right angles")
        joints = {joint.get("name", ""): joint for joint in root.iter("joint")}
        self._parents: dict[str, tuple[str, str]] = {}
        for name, joint in joints.items():
            child, parent = joint.find("child"), joint.find("parent")
            if child is not None and parent is not None:
                self._parents[child.get("link", "")] = (name, parent.get("link", ""))
        self._joints = joints
        self._names = self._chain.get_joint_parameter_names()
        self._order: list[str] = []

    def drivers(self, link: str) -> list[str]:
        """Independent joints between the root and a link, in order."""
        path: list[str] = []
        if link not in self._parents and link not in {parent for _, parent in self._parents.values()}:
            raise RobotError(where="URDF", expected=f"a link {link!r}", found=", ".join(self._parents))
        while link in self._parents:
            joint, link = self._parents[link]
            path.append(joint)
        found: list[str] = []
        for joint in reversed(path):
            driver = self._mimic(joint)[0]
            if driver in self._names and driver not in found:
                found.append(driver)
        return found

    def axes(self, link: str) -> list[_Axis]:
        """The joints that move a link, at zero."""
        self._order = self.drivers(link)
        if len(self._order) < 3:
            raise RobotError(where=f"link {link}", expected="3 joints or more before it", found=len(self._order))
        rest = np.zeros(len(self._order))
        still = self.pose(link, rest)
        return [self._axis(i, joint, link, still) for i, joint in enumerate(self._order)]

    def pose(self, link: str, readings: Float[np.ndarray, " j"]) -> Float[np.ndarray, "4 4"]:
        """Of a link in the root's frame."""
        values = dict(zip(self._order, readings, strict=True))
        scale = {name: 1.0 / _MM if self._joints[name].get("type") == "prismatic" else 1.0 for name in self._names}
        vector = []
        for name in self._names:
            driver, multiplier, offset = self._mimic(name)
            vector.append(multiplier * values.get(driver, 0.0) * scale.get(driver, 1.0) + offset)
        poses = self._chain.forward_kinematics(torch.tensor([vector], dtype=torch.float64))
        if link not in poses:
            raise RobotError(where="URDF", expected=f"a link {link!r}", found=", ".join(poses))
        matrix = poses[link].get_matrix()[0].numpy().copy()
        matrix[:3, 3] *= _MM
        return matrix

    def _mimic(self, name: str) -> tuple[str, float, float]:
        mimic = self._joints[name].find("mimic")
        if mimic is None:
            return name, 1.0, 0.0
        return str(mimic.get("joint")), float(mimic.get("multiplier", 1.0)), float(mimic.get("offset", 0.0))

    def _axis(self, i: int, name: str, link: str, still: np.ndarray) -> _Axis:
        joint = self._joints[name]
        is_prismatic = joint.get("type") == "prismatic"
        probe = np.zeros(len(self._order))
        probe[i] = _PROBE_MM if is_prismatic else _PROBE_RAD
        motion = self.pose(link, probe) @ np.linalg.inv(still)  # of space, with only this joint moving
        limit = joint.find("limit")
        limits = None
        if limit is not None and limit.get("lower") is not None and joint.get("type") != "continuous":
            factor = _MM if is_prismatic else 1.0
            limits = (factor * float(limit.get("lower", 0)), factor * float(limit.get("upper", 0)))
        if is_prismatic:
            w = motion[:3, 3] / _PROBE_MM
            return _Axis(name, "prismatic", w / np.linalg.norm(w), self._place(name), limits)
        skew = motion[:3, :3] - motion[:3, :3].T
        w = np.array([skew[2, 1], skew[0, 2], skew[1, 0]]) / (2 * math.sin(_PROBE_RAD))
        # Points that stay: (I - R) p = t across the axis.
        p = np.linalg.lstsq(np.eye(3) - motion[:3, :3], motion[:3, 3], rcond=1e-9)[0]
        return _Axis(name, "revolute", w / np.linalg.norm(w), p, limits)

    def _place(self, name: str) -> np.ndarray:
        child = self._joints[name].find("child")
        return self.pose(str(child.get("link")) if child is not None else name, np.zeros(len(self._order)))[:3, 3]


def _snap(root: ElementTree.Element) -> int:
    """Round printed right angles in place; how many."""
    count = 0
    for origin in root.iter("origin"):
        angles = [float(value) for value in origin.get("rpy", "0 0 0").split()]
        exact = [round(angle / (math.pi / 2)) * (math.pi / 2) for angle in angles]
        near = [e if abs(e - angle) < _SNAP_RAD else angle for e, angle in zip(exact, angles, strict=True)]
        count += sum(a != b for a, b in zip(near, angles, strict=True))
        origin.set("rpy", " ".join(map(repr, near)))
    return count


def _meeting_point(a: _Axis, b: _Axis) -> np.ndarray | None:
    """Where two axes cross; None where they do not."""
    normal = np.cross(a.w, b.w)
    if np.linalg.norm(normal) < 1e-6 or abs((b.p - a.p) @ normal) / np.linalg.norm(normal) > _TOLERANCE_MM:
        return None
    return _common_normal(a, b)[0]


def _distance(axis: _Axis, point: np.ndarray) -> float:
    return float(np.linalg.norm(np.cross(axis.w, point - axis.p)))


def _common_normal(a: _Axis, b: _Axis) -> tuple[np.ndarray, np.ndarray]:
    """Foot on `a` of the common normal with `b`, and its direction from a to b, for axes that are not parallel."""
    n = np.cross(a.w, b.w)
    foot = a.p + a.w * (np.cross(b.p - a.p, b.w) @ n) / (n @ n)
    across = (b.p - a.p) @ n
    return foot, n / np.linalg.norm(n) * (1.0 if across >= 0 else -1.0)


def _dh_frames(axes: list[_Axis], origin: np.ndarray) -> list[np.ndarray]:
    """Frames 0 to J of a modified table at zero, in the root's frame; frame 0 has its origin at a point of axis 1."""
    frames = []
    o, x = origin, _perpendicular(axes[0].w)
    for i, axis in enumerate(axes):
        o = axis.p + axis.w * ((o - axis.p) @ axis.w)  # nearest point of this axis: d is then zero
        if i + 1 < len(axes):
            following = axes[i + 1]
            if np.linalg.norm(np.cross(axis.w, following.w)) > _PARALLEL:
                o, x = _common_normal(axis, following)
            else:
                across = following.p - o
                across = across - axis.w * (across @ axis.w)
                if np.linalg.norm(across) > _SAME_MM:
                    x = across / np.linalg.norm(across)
        x = x - axis.w * (x @ axis.w)
        x = _perpendicular(axis.w) if np.linalg.norm(x) < _PARALLEL else x / np.linalg.norm(x)
        frames.append(_frame(x, axis.w, o))
    return [_frame(frames[0][:3, 0], axes[0].w, origin), *frames]


def _dh_rows(axes: list[_Axis], frames: list[np.ndarray]) -> tuple[Joint, ...]:
    rows = []
    for axis, before, after in zip(axes, frames, frames[1:], strict=False):
        step = np.linalg.inv(before) @ after  # Rx(alpha) Tx(a) Rz(theta) Tz(d)
        alpha, theta = math.atan2(-step[1, 2], step[2, 2]), math.atan2(-step[0, 1], step[0, 0])
        d = -math.sin(alpha) * step[1, 3] + math.cos(alpha) * step[2, 3]
        low, high = axis.limits or (None, None)
        rows.append(Joint(axis.name, axis.type, alpha, float(step[0, 3]), theta, d, 0.0, low, high))
    return tuple(rows)


def _table_frames(rows: tuple[Joint, ...], readings: np.ndarray, base: np.ndarray) -> np.ndarray:
    return base @ frame_poses(build_chain(rows, "modified", torch.float64), torch.from_numpy(readings)).numpy()


def _check(tree: _Tree, arm: Arm, axes: list[_Axis], head_link: str) -> None:
    """Refuse a table that is not the URDF: a joint whose axis wanders, or joints that move together."""
    generator = np.random.default_rng(0)
    bounds = np.array([axis.limits or ((-1.0, 1.0) if axis.type == "revolute" else (0.0, 100.0)) for axis in axes])
    readings = generator.uniform(bounds[:, 0], bounds[:, 1], (_CHECKS, len(axes)))
    head = arm.head_point
    assert head is not None
    ours = _table_frames(arm.joints, readings, np.asarray(arm.base_T_arm_base))[:, -1] @ np.array([*head.xyz_mm, 1.0])
    theirs = np.stack([tree.pose(head_link, row)[:, 3] for row in readings])
    worst = float(np.abs(ours - theirs).max())
    if worst > _TOLERANCE_MM:
        expected = "joints that each turn about, or slide along, one axis of their own"
        raise RobotError(where=f"link {head_link}", expected=expected, found=f"a table that is {worst:.3g} mm off")


def _frame(x: np.ndarray, z: np.ndarray, o: np.ndarray) -> np.ndarray:
    frame = np.eye(4)
    frame[:3, 0], frame[:3, 1], frame[:3, 2], frame[:3, 3] = x, np.cross(z, x), z, o
    return frame


def _perpendicular(w: np.ndarray) -> np.ndarray:
    x = np.eye(3)[np.abs(w).argmin()]
    x = x - w * (x @ w)
    return x / np.linalg.norm(x)
