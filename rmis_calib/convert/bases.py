"""Where one arm's base stands in the other's, from what a source logs beside the joints: a prior, not a measurement.

The dVRK's set-up joints put an arm's base to within some 50 mm ("SUJs are within 5cm cube", dVRK documentation of the
camera registration). Three places may tell it, the best first: poses of both set-up joints on the cart; those of the
instrument's in the endoscope's tip; and tips in two frames, since frame_T_base = frame_T_tip @ base_T_tip^-1.
"""

from collections.abc import Iterator
from dataclasses import replace

import numpy as np
from jaxtyping import Float

from rmis_calib.convert.material import Placing, PoseLog
from rmis_calib.io._checks import Note
from rmis_calib.robot import Robot

SIGMA_MM, SIGMA_RAD = 50.0, float(np.deg2rad(5.0))
"""Prior of a set-up that is told by set-up joints, 1 sigma per axis."""
_SAMPLES = 200
_SLACK_NS = 50_000_000
"""Tips that are further apart in time do not show one instant."""
_MOVED_MM, _MOVED_DEG = 5.0, 1.0
_APART_MM = 5.0
"""Bases that are nearer to each other were never filled in."""
_MM = 1000.0

Transforms = Float[np.ndarray, "n 4 4"]
Placings = dict[Placing, PoseLog]


def with_logged_bases(
    robot: Robot, laparoscope: tuple[str, str], instrument: tuple[str, str], placings: Placings, note: Note
) -> Robot:
    """The robot with its bases where the source says they are, if the robot itself leaves that open.

    Args:
        robot: what describes the arms.
        laparoscope, instrument: name of each arm in the robot and in the source.
        placings: poses that may tell.
        note: told what was used, or why nothing was.
    """
    laparoscope_log, instrument_log = laparoscope[1], instrument[1]
    if any(robot.arms[name].base_T_arm_base is not None for name, _ in (laparoscope, instrument)):
        if placings and robot.setup_sigma_mm is None:
            note("the arms' bases are those of the robot's description, not those that the source logs")
        return robot
    for source, laparoscope_base_T_instrument_base in _candidates(placings, laparoscope_log, instrument_log):
        found = _steady(laparoscope_base_T_instrument_base)
        if isinstance(found, str):
            note(f"{source} was not used for the arms' bases: {found}")
            continue
        note(
            f"the base of {instrument_log} in that of {laparoscope_log} is {np.linalg.norm(found[:3, 3]):.0f} mm away, "
            f"by {source}: a prior of {SIGMA_MM:g} mm and {np.rad2deg(SIGMA_RAD):g} deg (setup_sigma_mm in robot.yaml)"
        )
        bases = {laparoscope[0]: np.eye(4), instrument[0]: found}
        arms = {name: replace(robot.arms[name], base_T_arm_base=base) for name, base in bases.items()}
        return replace(robot, arms=arms, setup_sigma_mm=SIGMA_MM, setup_sigma_rad=SIGMA_RAD)
    note("where the arms' bases are is not logged: a calibration finds it where the laparoscope moves")
    return robot


def _candidates(placings: Placings, laparoscope: str, instrument: str) -> Iterator[tuple[str, Transforms]]:
    """(what tells it, `laparoscope_base_T_instrument_base` at several instants, mm)."""

    def log(arm: str, what: str, is_local: bool) -> PoseLog | None:
        return placings.get(Placing(arm, what, is_local))  # pyright: ignore[reportArgumentType]

    own_T_tip = log(laparoscope, "tip", True)
    for is_local, name in ((True, "local/measured_cp"), (False, "measured_cp")):
        of_laparoscope, of_instrument = log(laparoscope, "base", is_local), log(instrument, "base", is_local)
        same_frame = is_local or (
            of_laparoscope and of_instrument and of_laparoscope.frame == of_instrument.frame != ""
        )
        if of_laparoscope and of_instrument and same_frame:
            cart_T_laparoscope_base, cart_T_instrument_base = _together(of_laparoscope, of_instrument)
            yield f"{name} of both set-up joints", np.linalg.inv(cart_T_laparoscope_base) @ cart_T_instrument_base
    of_instrument = log(instrument, "base", False)
    if of_instrument and own_T_tip and of_instrument.frame == laparoscope:
        laparoscope_base_T_tip, tip_T_instrument_base = _together(own_T_tip, of_instrument, _SLACK_NS)
        yield f"SUJ/{instrument}/measured_cp, in {laparoscope}", laparoscope_base_T_tip @ tip_T_instrument_base
    there_T_tip, base_T_tip = log(instrument, "tip", False), log(instrument, "tip", True)
    if not there_T_tip or not base_T_tip:
        return
    world_T_tip, instrument_base_T_tip = _together(there_T_tip, base_T_tip, _SLACK_NS)
    world_T_instrument_base = world_T_tip @ np.linalg.inv(instrument_base_T_tip)
    instants = _instants(there_T_tip, base_T_tip, _SLACK_NS)
    own_there = log(laparoscope, "tip", False)
    if own_T_tip and there_T_tip.frame == laparoscope:
        laparoscope_base_T_world = _at(own_T_tip, instants)  # `world` is the laparoscope's tip here
        yield f"{instrument}/measured_cp, in {laparoscope}", laparoscope_base_T_world @ world_T_instrument_base
    elif own_T_tip and own_there and own_there.frame == there_T_tip.frame != "":
        laparoscope_base_T_world = _at(own_T_tip, instants) @ np.linalg.inv(_at(own_there, instants))
        yield f"measured_cp of both arms, in {own_there.frame}", laparoscope_base_T_world @ world_T_instrument_base


def _steady(laparoscope_base_T_instrument_base: Transforms) -> Float[np.ndarray, "4 4"] | str:
    """Their mean, or why there is none: bases that are moved while a recording runs are no set-up."""
    from scipy.spatial.transform import Rotation

    poses = laparoscope_base_T_instrument_base
    if not len(poses):
        return "it has no valid poses at the same time"
    turns = Rotation.from_matrix(poses[:, :3, :3])
    mean, t = turns.mean(), np.median(poses[:, :3, 3], axis=0)
    moved_mm = float(np.linalg.norm(poses[:, :3, 3] - t, axis=1).max())
    moved_deg = float(np.rad2deg((mean.inv() * turns).magnitude().max()))
    if moved_mm > _MOVED_MM or moved_deg > _MOVED_DEG:
        return f"it moves by {moved_mm:.1f} mm and {moved_deg:.1f} deg: were set-up joints moved meanwhile?"
    if np.linalg.norm(t) < _APART_MM:
        return "it puts both bases at one place: nobody filled them in"
    found = np.eye(4)
    found[:3, :3], found[:3, 3] = mean.as_matrix(), t
    return found


def _together(a: PoseLog, b: PoseLog, slack_ns: int | None = None) -> tuple[Transforms, Transforms]:
    """Poses of two logs at some instants that both know."""
    instants = _instants(a, b, slack_ns)
    return _at(a, instants), _at(b, instants)


def _instants(a: PoseLog, b: PoseLog, slack_ns: int | None) -> np.ndarray:
    """(n,) some stamps of the first log for which both have a valid pose, nearer than `slack_ns` if given."""
    a_ns, _ = _valid(a)
    b_ns, _ = _valid(b)
    if not len(a_ns) or not len(b_ns):
        return np.empty(0, dtype=np.int64)
    some = a_ns[np.unique(np.linspace(0, len(a_ns) - 1, _SAMPLES).round().astype(int))]
    return some if slack_ns is None else some[np.abs(b_ns[_nearest(b_ns, some)] - some) <= slack_ns]


def _at(log: PoseLog, instants: np.ndarray) -> Transforms:
    """(n, 4, 4), mm: the logged poses nearest to some instants."""
    from scipy.spatial.transform import Rotation

    ns, poses = _valid(log)
    if not len(instants):
        return np.empty((0, 4, 4))
    chosen = poses[_nearest(ns, instants)]
    matrices = np.tile(np.eye(4), (len(chosen), 1, 1))
    matrices[:, :3, :3], matrices[:, :3, 3] = Rotation.from_quat(chosen[:, 3:]).as_matrix(), _MM * chosen[:, :3]
    return matrices


def _valid(log: PoseLog) -> tuple[np.ndarray, np.ndarray]:
    """Stamps in order, and poses that are poses."""
    ns, poses = np.array(log.ns, dtype=np.int64), np.array(log.poses, dtype=np.float64).reshape(-1, 7)
    length = np.linalg.norm(poses[:, 3:], axis=1)
    whole = np.isfinite(poses).all(axis=1) & (np.abs(length - 1.0) < 0.1)
    order = np.argsort(ns[whole], kind="stable")
    return ns[whole][order], poses[whole][order]


def _nearest(ns: np.ndarray, at: np.ndarray) -> np.ndarray:
    after = np.searchsorted(ns, at).clip(1, max(len(ns) - 1, 1))
    after = np.minimum(after, len(ns) - 1)
    before = np.maximum(after - 1, 0)
    return np.where(at - ns[before] <= ns[after] - at, before, after)
