"""Logs of arms as readings of a robot: names and units matched, poses turned into joints, the robot told by poses."""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from jaxtyping import Float

from rmis_calib.convert.material import ArmLog
from rmis_calib.errors import RecordingError
from rmis_calib.io._checks import Note
from rmis_calib.io.robot import load_robot
from rmis_calib.robot import Arm, Robot

DVRK_ROBOTS = ("dvrk-classic", "dvrk-si", "dvrk-classic-si-tool")
NEEDS_ROBOT = f"--robot (one of {', '.join(DVRK_ROBOTS)}, or your robot.yaml)"
NO_POSES = "no poses beside the joints, which alone do not tell a Classic arm from an S or Si (50.8 mm along the shaft)"
_MM = 1000.0
_FIT_MM, _CLEARLY = 1.0, 5.0
"""How well a robot's kinematics must fit the logged poses, and how much worse the next one must do it."""
_SAMPLES, _SAME_MM = 200, 1e-6
_TIP_R = np.array([[0.0, -1.0, 0.0], [0.0, 0.0, 1.0], [-1.0, 0.0, 0.0]])
"""The dVRK's tip frame of wristed instruments in the frame of the last joint."""
_RIGHT_ANGLES = (np.pi / 2, -np.pi / 2, np.pi / 2)


@dataclass(frozen=True, eq=False)
class Readings:
    """Readings of one arm in rad and mm, in the order of its joints."""

    ns: np.ndarray
    """(T,) int64, increasing."""
    values: Float[np.ndarray, "t j"]


def readings_of(log: ArmLog, name: str, arm: Arm, note: Note) -> Readings:
    """The log of an arm in a robot's units, or what its poses imply.

    Raises:
        RecordingError: another number of joints, or poses that say nothing of the joints.
    """
    if not log.has_joints:
        return _readings_of_poses(log, name, arm, note)
    ns, values = np.array(log.joint_ns, dtype=np.int64), np.array(log.joints, dtype=np.float64)
    order = joint_order(log.joint_names, values.shape[1], arm, f"{log.name} as arm {name}", note)
    scale = np.array([1.0 if joint.type == "revolute" else _MM for joint in arm.joints])
    note(f"{log.name}: {len(ns)} readings of {', '.join(joint.name for joint in arm.joints)}; metres became mm")
    return _increasing(ns, values[:, order] * scale, log.name, note)


def choose_robot(logs: list[ArmLog], note: Note) -> str:
    """The dVRK robot whose instrument's kinematics reproduce the logged poses.

    Raises:
        RecordingError: no poses beside the joints, or none of the robots fits clearly best.
    """
    both = [log for log in logs if len(log.joints) > 10 and len(log.poses) > 10 and len(log.joints[0]) == 6]
    if not both:
        raise RecordingError(where="robot", expected=NEEDS_ROBOT, found=NO_POSES)
    arms = {name: load_robot(name).arms["instrument"] for name in DVRK_ROBOTS}
    misfits = {name: _misfit_mm(both[0], arm) for name, arm in arms.items()}
    best = min(misfits.values())
    # A Classic tool on a Classic arm and an Si tool on an Si arm have one and the same kinematics, and other limits.
    same = [name for name in DVRK_ROBOTS if misfits[name] < best + _SAME_MM]
    others = [misfit for name, misfit in misfits.items() if name not in same]
    if best > _FIT_MM or min(others, default=np.inf) < _CLEARLY * max(best, 0.02):
        found = ", ".join(f"{robot} off by {misfit:.3g} mm" for robot, misfit in misfits.items())
        raise RecordingError(where="robot", expected=NEEDS_ROBOT, found=f"no clear fit of the logged poses: {found}")
    name = next((name for name in same if _within_limits(both[0], arms[name])), same[0])
    also = f"; {', '.join(other for other in same if other != name)} differs in limits only" if len(same) > 1 else ""
    note(f"robot: {name}, whose kinematics reproduce the poses of {both[0].name} to {best:.2g} mm{also}")
    return name


def joint_order(joint_names: Sequence[str], count: int, arm: Arm, where: str, note: Note) -> list[int]:
    """Places of the arm's joints among those of a message or log: by name where all are known, else by place.

    Args:
        joint_names: as the robot calls them, with or without `outer_`; may be empty.
        count: number of joints that there are.
        arm: the table.
        where: what it is, for messages.
        note: told what was guessed.

    Raises:
        RecordingError: another number of joints, and not all of the arm's by name.
    """
    known = [joint.name for joint in arm.joints]
    said = [word.removeprefix("outer_") for word in joint_names]
    if set(known) <= set(said):
        return [said.index(joint) for joint in known]
    if count != len(known):
        expected = f"{len(known)} joints ({', '.join(known)})"
        found = f"{count} ({', '.join(said) or 'without names'}): another robot? give --robot"
        raise RecordingError(where=where, expected=expected, found=found)
    note(f"{where}: its joints ({', '.join(said) or 'without names'}) were taken in the robot's order")
    return list(range(len(known)))


def _increasing(ns: np.ndarray, values: np.ndarray, name: str, note: Note) -> Readings:
    """Without samples whose stamp does not exceed the one before, or that are not finite."""
    keep = np.ones(len(ns), dtype=bool)
    keep[1:] = ns[1:] > np.maximum.accumulate(ns)[:-1]
    finite = np.isfinite(values).all(axis=1)
    if not (keep & finite).all():
        note(f"{name}: {int((~(keep & finite)).sum())} samples with a repeated stamp or no number were left out")
    if not (keep & finite).any():
        raise RecordingError(
            where=name, expected="joints or poses that are numbers", found=f"none in {len(ns)} samples"
        )
    return Readings(ns[keep & finite], values[keep & finite])


def _readings_of_poses(log: ArmLog, name: str, arm: Arm, note: Note) -> Readings:
    if not log.is_local:
        found = f"poses in frame {log.pose_frame or 'unknown'} only"
        expected = f"measured_js, or local/measured_cp, of {log.name}: without the RCM poses do not tell the shaft"
        raise RecordingError(where=log.name, expected=expected, found=found)
    poses = np.array(log.poses, dtype=np.float64)
    p, R = poses[:, :3] * _MM, _rotations(poses[:, 3:])
    values = _wristed_joints(p, R, arm) if arm.is_instrument else _endoscope_joints(p, R, arm)
    error = np.linalg.norm(_end_positions(arm, values) - p, axis=1)
    worst = float(np.max(error, initial=0.0))
    if worst > 0.1 or not np.isfinite(worst):
        expected = f"poses that the kinematics of arm {name} can reach (a wristed dVRK instrument, or the ECM)"
        raise RecordingError(
            where=log.name, expected=expected, found=f"poses up to {worst:.3g} mm off: another --robot?"
        )
    what = (
        f" with a wrist of {arm.joints[5].a_mm:g} mm: poses alone do not identify the tool" if arm.is_instrument else ""
    )
    note(f"{log.name}: no joints are logged; they were computed from its poses{what}")
    return _increasing(np.array(log.pose_ns, dtype=np.int64), values, log.name, note)


def _wristed_joints(p: np.ndarray, R: np.ndarray, arm: Arm) -> np.ndarray:
    """Joints of a wristed dVRK instrument from its tip pose; closed form.

    Source: the wrist's pitch axis lies a_mm of the last joint from the tip, towards the RCM and across the last axis
    (ECOSYSTEM 3.3); the rest by reading the product of the DH matrices.
    """
    _require_dvrk(arm, 6)
    o = [joint.offset for joint in arm.joints]
    R6 = R @ _TIP_R.T
    z6 = R6[:, :, 2]
    w = p - z6 * np.sum(z6 * p, axis=1, keepdims=True)
    p5 = p - arm.joints[5].a_mm * w / np.linalg.norm(w, axis=1, keepdims=True)
    depth = np.linalg.norm(p5, axis=1)
    first, R3 = _yaw_pitch(p5 / depth[:, None], arm)
    M = np.swapaxes(R3, 1, 2) @ R6
    roll = np.arctan2(M[:, 1, 2], M[:, 0, 2])
    pitch = np.arctan2(-np.hypot(M[:, 0, 2], M[:, 1, 2]), -M[:, 2, 2])
    yaw = np.arctan2(-M[:, 2, 1], M[:, 2, 0])
    columns = [*first, depth - o[2] - arm.joints[3].d_mm, roll - o[3], pitch - o[4], yaw - o[5]]
    return _unwrapped(np.stack(columns, axis=1), arm)


def _endoscope_joints(p: np.ndarray, R: np.ndarray, arm: Arm) -> np.ndarray:
    """Joints of the ECM from the pose of its tip."""
    _require_dvrk(arm, 4)
    R4 = R @ np.asarray(arm.end_T_tool)[:3, :3].T
    v = R4[:, :, 2]
    first, R3 = _yaw_pitch(v, arm)
    M = np.swapaxes(R3, 1, 2) @ R4
    depth = np.sum(v * p, axis=1) - arm.joints[2].offset - arm.joints[3].d_mm
    return _unwrapped(np.stack([*first, depth, np.arctan2(M[:, 1, 0], M[:, 0, 0])], axis=1), arm)


def _yaw_pitch(v: np.ndarray, arm: Arm) -> tuple[list[np.ndarray], np.ndarray]:
    """The first two joints that point the shaft along v, and the rotation of frame 3.

    Source: v = (cos t1 sin t2, -cos t2, sin t1 sin t2) with t2 in (-pi, 0), from Rx(90) Rz(t1) Rx(-90) Rz(t2) Rx(90) z.
    """
    t2 = -np.arccos(np.clip(-v[:, 1], -1.0, 1.0))
    t1 = np.arctan2(-v[:, 2], -v[:, 0])
    c1, s1, c2, s2 = np.cos(t1), np.sin(t1), np.cos(t2), np.sin(t2)
    x = np.stack([c1 * c2, s2, s1 * c2], axis=1)
    z = np.stack([c1 * s2, -c2, s1 * s2], axis=1)
    return [t1 - arm.joints[0].offset, t2 - arm.joints[1].offset], np.stack([x, np.cross(z, x), z], axis=2)


def _require_dvrk(arm: Arm, count: int) -> None:
    alphas = tuple(joint.alpha_rad for joint in arm.joints[:3])
    if len(arm.joints) != count or not np.allclose(alphas, _RIGHT_ANGLES, atol=1e-3):
        found = f"a table of {len(arm.joints)} joints"
        raise RecordingError(
            where="poses without joints", expected="a dVRK PSM with a wristed tool, or an ECM", found=found
        )


def _unwrapped(values: np.ndarray, arm: Arm) -> np.ndarray:
    """Angles near the middle of their range, and without jumps of a turn from sample to sample."""
    for i, joint in enumerate(arm.joints):
        if joint.type == "revolute":
            middle = 0.5 * (joint.min + joint.max) if joint.min is not None and joint.max is not None else 0.0
            wrapped = middle + (values[:, i] - middle + np.pi) % (2 * np.pi) - np.pi
            values[:, i] = np.unwrap(wrapped)
    return values


def _misfit_mm(log: ArmLog, arm: Arm) -> float:
    """Median distance between logged tips and those of the kinematics, once the frames are fitted to each other."""
    pose_ns = np.array(log.pose_ns, dtype=np.int64)
    pick = np.unique(np.linspace(0, len(pose_ns) - 1, _SAMPLES).round().astype(int))
    joints, joint_ns = np.array(log.joints), np.array(log.joint_ns, dtype=np.int64)
    start = pose_ns[0]
    at = (pose_ns[pick] - start).astype(np.float64)
    inside = (at >= joint_ns[0] - start) & (at <= joint_ns[-1] - start)
    if inside.sum() < 5:
        return np.inf
    columns = [
        np.interp(at[inside], (joint_ns - start).astype(np.float64), joints[:, i]) for i in range(joints.shape[1])
    ]
    scale = np.array([1.0 if joint.type == "revolute" else _MM for joint in arm.joints])
    ours = _end_positions(arm, np.stack(columns, axis=1) * scale)
    theirs = np.array(log.poses)[pick][inside, :3] * _MM
    if log.is_local:
        return float(np.median(np.linalg.norm(ours - theirs, axis=1)))
    a, b = ours - ours.mean(0), theirs - theirs.mean(0)
    U, _, Vt = np.linalg.svd(a.T @ b)
    turn = np.diag([1.0, 1.0, np.sign(np.linalg.det(U @ Vt))])
    return float(np.median(np.linalg.norm(a @ (U @ turn @ Vt) - b, axis=1)))


def _within_limits(log: ArmLog, arm: Arm) -> bool:
    values = np.array(log.joints) * [1.0 if joint.type == "revolute" else _MM for joint in arm.joints]
    low = np.array([-np.inf if joint.min is None else joint.min for joint in arm.joints])
    high = np.array([np.inf if joint.max is None else joint.max for joint in arm.joints])
    return bool(((values >= low) & (values <= high)).all())


def _end_positions(arm: Arm, readings: np.ndarray) -> np.ndarray:
    """(N, 3) mm: origin of the last frame in the arm's base, modified DH."""
    import torch

    from rmis_calib.kinematics import build_chain, frame_poses

    offsets = np.array([joint.offset for joint in arm.joints])
    chain = build_chain(arm.joints, "modified", torch.float64)
    return frame_poses(chain, torch.from_numpy(readings + offsets))[:, -1, :3, 3].numpy()


def _rotations(quat_xyzw: np.ndarray) -> np.ndarray:
    from scipy.spatial.transform import Rotation

    return Rotation.from_quat(quat_xyzw).as_matrix()


def motion_of(log: ArmLog) -> float:
    """How much an arm moves, for choosing among several: rms of its readings' spread."""
    values = np.array(log.joints if log.has_joints else [pose[:3] for pose in log.poses])
    return float(np.sqrt((values.std(axis=0) ** 2).sum())) if len(values) else 0.0


def robot_arms(robot: Robot) -> tuple[str, str | None]:
    """Names of the instrument's arm and of the laparoscope's."""
    instrument = next((name for name, arm in robot.arms.items() if arm.is_instrument), None)
    if instrument is None:
        raise RecordingError(where=f"robot {robot.name}", expected="an instrument arm", found=", ".join(robot.arms))
    return instrument, next((name for name, arm in robot.arms.items() if not arm.is_instrument), None)
