"""Forward kinematics of the synthetic robot: Denavit-Hartenberg tables in float64 NumPy.

Written apart from the calibration's own kinematics on purpose: truth that is made with the code under test proves
nothing.
Convention: `a_T_b` maps coordinates in b to coordinates in a; millimetres and radians.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Any, Literal

import numpy as np
from numpy.typing import ArrayLike, NDArray

Array = NDArray[Any]
"""float64 unless the docstring says otherwise."""
Convention = Literal["modified", "standard"]


def rotation_from_rotvec(rotvec: ArrayLike) -> Array:
    """Rotation matrices (..., 3, 3) of rotation vectors (..., 3), rad (Rodrigues' formula)."""
    vector = np.asarray(rotvec, dtype=np.float64)
    angle = np.linalg.norm(vector, axis=-1)[..., None, None]
    x, y, z = np.moveaxis(vector, -1, 0)
    zero = np.zeros_like(x)
    skew = np.stack([zero, -z, y, z, zero, -x, -y, x, zero], axis=-1).reshape(*vector.shape[:-1], 3, 3)
    # sinc keeps both factors exact as the angle goes to zero: sin(t)/t, and (1 - cos t)/t^2 = sinc(t/2)^2 / 2
    first = np.sinc(angle / np.pi)
    second = 0.5 * np.sinc(angle / (2.0 * np.pi)) ** 2
    return np.eye(3) + first * skew + second * (skew @ skew)


def rotation_about(axis: int, angle_rad: ArrayLike) -> Array:
    """Rotation matrices (..., 3, 3) about a coordinate axis (0, 1, 2 for x, y, z) by angles (...)."""
    angle = np.asarray(angle_rad, dtype=np.float64)
    cosine, sine = np.cos(angle), np.sin(angle)
    i, j = (axis + 1) % 3, (axis + 2) % 3
    out = np.zeros((*angle.shape, 3, 3))
    out[..., axis, axis] = 1.0
    out[..., i, i] = out[..., j, j] = cosine
    out[..., i, j], out[..., j, i] = -sine, sine
    return out


def rigid(rotation: ArrayLike, translation: ArrayLike) -> Array:
    """Homogeneous transforms (..., 4, 4) from rotations (..., 3, 3) and translations (..., 3), mm."""
    R = np.asarray(rotation, dtype=np.float64)
    t = np.asarray(translation, dtype=np.float64)
    batch = np.broadcast_shapes(R.shape[:-2], t.shape[:-1])
    out = np.zeros((*batch, 4, 4))
    out[..., :3, :3] = R
    out[..., :3, 3] = t
    out[..., 3, 3] = 1.0
    return out


def rigid_inverse(a_T_b: Array) -> Array:
    """Inverse of rigid transforms (..., 4, 4)."""
    b_R_a = np.swapaxes(a_T_b[..., :3, :3], -1, -2)
    return rigid(b_R_a, -np.einsum("...ij,...j->...i", b_R_a, a_T_b[..., :3, 3]))


def transform_points(a_T_b: Array, b_p: Array) -> Array:
    """Coordinates in a (..., 3) of points b_p (..., 3)."""
    return np.einsum("...ij,...j->...i", a_T_b[..., :3, :3], b_p) + a_T_b[..., :3, 3]


def pose_noise(generator: np.random.Generator, shape: tuple[int, ...], sigma_rad: float, sigma_mm: float) -> Array:
    """Random small transforms (*shape, 4, 4): rotation exp(sigma_rad * eps), translation sigma_mm * eps, eps standard
    normal per axis."""
    eps = generator.standard_normal((*shape, 6))
    return rigid(rotation_from_rotvec(sigma_rad * eps[..., :3]), sigma_mm * eps[..., 3:])


def random_rotations(generator: np.random.Generator, shape: tuple[int, ...]) -> Array:
    """Rotations (*shape, 3, 3), uniform on SO(3)."""
    quat = generator.standard_normal((*shape, 4))
    w, x, y, z = np.moveaxis(quat / np.linalg.norm(quat, axis=-1, keepdims=True), -1, 0)
    rows = [
        [1 - 2 * (y * y + z * z), 2 * (x * y - w * z), 2 * (x * z + w * y)],
        [2 * (x * y + w * z), 1 - 2 * (x * x + z * z), 2 * (y * z - w * x)],
        [2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y)],
    ]
    return np.stack([np.stack(row, axis=-1) for row in rows], axis=-2)


@dataclass(frozen=True)
class Joint:
    """One row of a Denavit-Hartenberg table; the reading plus `offset` is added to theta (revolute) or d
    (prismatic)."""

    name: str
    kind: Literal["revolute", "prismatic"]
    alpha_rad: float
    a_mm: float
    theta_rad: float
    d_mm: float
    offset: float

    @property
    def column(self) -> str:
        """Name with its unit, as in a column of joints.csv."""
        return f"{self.name}_{'rad' if self.kind == 'revolute' else 'mm'}"


def dh_matrix(joint: Joint, reading: ArrayLike, convention: Convention) -> Array:
    """Transform of one joint (..., 4, 4) at readings (...), rad or mm.

    Modified (Craig): Rx(alpha) Tx(a) Rz(theta) Tz(d). Standard: Rz(theta) Tz(d) Tx(a) Rx(alpha).
    """
    value = np.asarray(reading, dtype=np.float64) + joint.offset
    zero = np.zeros_like(value)
    theta = joint.theta_rad + (value if joint.kind == "revolute" else zero)
    d = joint.d_mm + (value if joint.kind == "prismatic" else zero)
    about_z = rigid(rotation_about(2, theta), np.stack([zero, zero, d], -1))
    about_x = rigid(rotation_about(0, joint.alpha_rad), [joint.a_mm, 0.0, 0.0])
    return about_x @ about_z if convention == "modified" else about_z @ about_x


@dataclass(frozen=True)
class Arm:
    """One arm: its place, its table, and for an instrument where its shaft is."""

    base_T_arm_base: Array
    joints: tuple[Joint, ...]
    convention: Convention = "modified"
    end_T_tool: Array = field(default_factory=lambda: np.eye(4))
    rcm_frame: int = 0
    shaft_frame: int = 0
    head_frame: int = 0
    head_xyz_mm: tuple[float, float, float] = (0.0, 0.0, 0.0)
    shaft_reversed: bool = False
    """The z axis of the shaft's frame points from the tip to the RCM."""

    def frames(self, readings: ArrayLike) -> Array:
        """Poses (..., J + 1, 4, 4) in base of the arm's base (frame 0) and of the frame after each joint, from readings
        (..., J)."""
        values = np.asarray(readings, dtype=np.float64)
        base_T_frame = np.broadcast_to(self.base_T_arm_base, (*values.shape[:-1], 4, 4))
        frames = [base_T_frame]
        for index, joint in enumerate(self.joints):
            frames.append(frames[-1] @ dh_matrix(joint, values[..., index], self.convention))
        return np.stack(frames, axis=-3)

    def tool(self, readings: ArrayLike) -> Array:
        """base_T_tool (..., 4, 4)."""
        return self.frames(readings)[..., -1, :, :] @ self.end_T_tool

    def shaft(self, readings: ArrayLike) -> Shaft:
        """The instrument's RCM, axis and head point at readings (..., J)."""
        frames = self.frames(readings)
        base_T_rcm = frames[..., self.rcm_frame, :, :]
        rcm_T_shaft = rigid_inverse(base_T_rcm) @ frames[..., self.shaft_frame, :, :]
        rcm_T_head = rigid_inverse(base_T_rcm) @ frames[..., self.head_frame, :, :]
        rcm_v_axis = -rcm_T_shaft[..., :3, 2] if self.shaft_reversed else rcm_T_shaft[..., :3, 2]
        rcm_p_head = transform_points(rcm_T_head, np.asarray(self.head_xyz_mm, dtype=np.float64))
        return Shaft(base_T_rcm, rcm_v_axis, rcm_p_head, np.einsum("...i,...i->...", rcm_v_axis, rcm_p_head))


@dataclass(frozen=True)
class Shaft:
    """Where an instrument's shaft is: RCM pose (..., 4, 4), axis and head point in rcm (..., 3), nominal end along the
    axis (...), mm."""

    base_T_rcm: Array
    rcm_v_axis: Array
    rcm_p_head: Array
    rcm_s_end_mm: Array


def arm_to_dict(arm: Arm, *, instrument: bool, offset_sigma: Mapping[str, float] | None = None) -> dict[str, Any]:
    """The arm as an entry of robot.yaml.

    Args:
        arm: to write.
        instrument: with its RCM, shaft and head point.
        offset_sigma: how well the offsets are known, by kind of joint, rad and mm; None: not stated.
    """
    entry: dict[str, Any] = {
        "base_T_arm_base": arm.base_T_arm_base.tolist(),
        "joints": [
            {
                "name": j.name,
                "type": j.kind,
                "alpha_rad": j.alpha_rad,
                "a_mm": j.a_mm,
                "theta_rad": j.theta_rad,
                "d_mm": j.d_mm,
                "offset": j.offset,
                **({} if offset_sigma is None else {"offset_sigma": offset_sigma[j.kind]}),
            }
            for j in arm.joints
        ],
    }
    if instrument:
        head_point = {"frame": arm.head_frame, "xyz_mm": list(arm.head_xyz_mm)}
        reversed_ = {"shaft_reversed": True} if arm.shaft_reversed else {}
        return (
            entry
            | {"rcm_frame": arm.rcm_frame, "shaft_frame": arm.shaft_frame}
            | reversed_
            | {"head_point": head_point}
        )
    return entry | {"end_T_tool": arm.end_T_tool.tolist()}


def arms_from_dict(robot: Mapping[str, Any]) -> dict[str, Arm]:
    """Arms of a parsed robot.yaml."""
    arms = {}
    for name, entry in robot["arms"].items():
        joints = tuple(
            Joint(j["name"], j["type"], j["alpha_rad"], j["a_mm"], j["theta_rad"], j["d_mm"], j["offset"])
            for j in entry["joints"]
        )
        head = entry.get("head_point", {"frame": len(joints), "xyz_mm": [0.0, 0.0, 0.0]})
        arms[name] = Arm(
            base_T_arm_base=np.asarray(entry.get("base_T_arm_base", np.eye(4)), dtype=np.float64),
            joints=joints,
            convention=robot["dh_convention"],
            end_T_tool=np.asarray(entry.get("end_T_tool", np.eye(4)), dtype=np.float64),
            rcm_frame=entry.get("rcm_frame", 0),
            shaft_frame=entry.get("shaft_frame", len(joints)),
            head_frame=head["frame"],
            head_xyz_mm=tuple(head["xyz_mm"]),
            shaft_reversed=entry.get("shaft_reversed", False),
        )
    return arms
