"""Both arms, the cameras and the shaft at every motion, in `base`: what a picture of the set-up is drawn from."""

import math
from dataclasses import dataclass

import numpy as np
import torch
from jaxtyping import Float, Int
from torch import Tensor

from rmis_calib.errors import InputError
from rmis_calib.geometry.rigid import rigid_inverse, transform_points
from rmis_calib.io import Recording
from rmis_calib.io.recording import log_times_s
from rmis_calib.kinematics import RobotKinematics
from rmis_calib.pipeline.arms.found_offsets import with_found_bases
from rmis_calib.pipeline.arms.poses import check_apart
from rmis_calib.results import CalibrationResult, KinematicOffsets

_NO_OFFSETS = KinematicOffsets({}, 0.0, (0.0, 0.0))


@dataclass(frozen=True, eq=False)
class Scene:
    """The arms of a recording at M motions; points in `base`, mm.

    Attributes:
        frames: (M,) frame number of each motion.
        times_s: (M,) time of each frame.
        laparoscope_points: origins of the laparoscope arm's DH frames, its base first; None where the camera stands
            still on no arm.
        instrument_points: the same of the instrument's arm.
        base_T_arm: the laparoscope arm's end frame.
        rcm, end, head: the instrument's RCM, the end of its shaft, and its head point.
        radius_mm: of the shaft.
    """

    frames: np.ndarray
    times_s: np.ndarray
    laparoscope_points: Float[np.ndarray, "m f 3"] | None
    instrument_points: Float[np.ndarray, "m g 3"]
    base_T_arm: Float[np.ndarray, "m 4 4"]
    rcm: Float[np.ndarray, "m 3"]
    end: Float[np.ndarray, "m 3"]
    head: Float[np.ndarray, "m 3"]
    radius_mm: float


@dataclass(frozen=True, eq=False)
class PlacedCameras:
    """Where one result puts the cameras of a scene.

    Attributes:
        base_T_camera: (M, 4, 4) by side, mm.
        fov_rad: vertical field of view by side; aspect: width over height.
        working_point: where the uncertainty is told, in `base`, (M, 3); None where it is unknown.
        working_covariance: of that point's error, in `base`, mm^2, (M, 3, 3); None likewise.
    """

    base_T_camera: dict[str, Float[np.ndarray, "m 4 4"]]
    fov_rad: dict[str, float]
    aspect: dict[str, float]
    working_point: Float[np.ndarray, "m 3"] | None
    working_covariance: Float[np.ndarray, "m 3 3"] | None


def scene_of(
    recording: Recording, result: CalibrationResult | None = None, frames: Int[np.ndarray, " m"] | None = None
) -> Scene:
    """The arms at every motion, with the offsets that a result found applied.

    Args:
        recording: an opened recording.
        result: of this recording; None: the arms as the joint log tells.
        frames: numbers of the frames to show, increasing, whose joints are known; None: every such frame.

    Raises:
        RobotError: the robot's description cannot carry the recording's arms.
    """
    offsets = _NO_OFFSETS if result is None else result.kinematic_offsets
    columns, known, readings = readings_of(recording, offsets.clock)
    if frames is not None:
        wanted = np.isin(known, frames)
        known, readings = known[wanted], readings[torch.as_tensor(wanted)]
    return _scene(recording, known, readings, columns, result)


def advised_scene(recording: Recording, result: CalibrationResult) -> Scene | None:
    """The first motion that the result advises, as a scene of one motion; None without advice about joints."""
    advice = result.observability.next_motions
    if not advice or advice[0].joints is None:
        return None
    columns, frames, readings = readings_of(recording, result.kinematic_offsets.clock)
    readings = readings[-1:].clone()
    for index, column in enumerate(columns):
        readings[:, index] = advice[0].joints.get(column, float(readings[0, index]))
    return _scene(recording, frames[-1:], readings, columns, result)


def place_cameras(scene: Scene, recording: Recording, result: CalibrationResult) -> PlacedCameras:
    """Where a result puts the cameras, and how well it knows the point at which the instrument works.

    Raises:
        InputError: the result has no transform.
    """
    if result.camera_right_T_arm is None:
        raise InputError(where="result", expected="a transform to show", found=f"status {result.status}")
    base_T_arm = torch.as_tensor(scene.base_T_arm)
    sides = {"right": (result.camera_right_T_arm, recording.stereo.right)}
    if result.camera_left_T_arm is not None and recording.stereo.left is not None:
        sides["left"] = (result.camera_left_T_arm, recording.stereo.left)
    base_T_camera = {side: (base_T_arm @ rigid_inverse(T.matrix)).numpy() for side, (T, _) in sides.items()}
    point, covariance = None, None
    if result.covariance is not None and result.observability.working_point_mm is not None:
        R = base_T_camera["right"][:, :3, :3]
        p = np.asarray(result.observability.working_point_mm)
        point = (R @ p) + base_T_camera["right"][:, :3, 3]
        covariance = R @ point_covariance(p, result.camera_right_T_arm.t.numpy(), result.covariance) @ R.swapaxes(1, 2)
    return PlacedCameras(
        base_T_camera=base_T_camera,
        fov_rad={
            side: 2.0 * math.atan(camera.image_size[0] / (2.0 * float(camera.fy)))
            for side, (_, camera) in sides.items()
        },
        aspect={side: camera.image_size[1] / camera.image_size[0] for side, (_, camera) in sides.items()},
        working_point=point,
        working_covariance=covariance,
    )


def point_covariance(
    p: Float[np.ndarray, "3"], t: Float[np.ndarray, "3"], covariance: Float[np.ndarray, "6 6"]
) -> Float[np.ndarray, "3 3"]:
    """Covariance, mm^2, of where the camera sees a point of the arm: p = R x + t moves by dphi x (p - t) + dt."""
    x, y, z = p - t
    skew = np.array([[0.0, -z, y], [z, 0.0, -x], [-y, x, 0.0]])
    J = np.concatenate((-skew, np.eye(3)), axis=1)
    return J @ covariance @ J.T


def readings_of(
    recording: Recording, clock: tuple[float, float]
) -> tuple[tuple[str, ...], np.ndarray, Float[Tensor, "m j"]]:
    """Columns of the joint log that move the arms, the frames at whose times it is known, and their readings."""
    arms = [arm for arm in (recording.laparoscope_arm, recording.instrument_arm) if arm is not None]
    columns = tuple(recording.robot.joints(*arms))
    log, times_s = recording.joints.select(columns), recording.joint_times_s
    at_s = log_times_s(times_s, recording.middle_s, *clock)
    frames = np.flatnonzero(log.at(times_s)[1] & log.at(at_s)[1])
    return columns, frames, torch.as_tensor(log.interpolate(at_s[frames])[0])


def _scene(
    recording: Recording,
    frames: np.ndarray,
    readings: Float[Tensor, "m j"],
    columns: tuple[str, ...],
    result: CalibrationResult | None,
) -> Scene:
    """The arms at these readings, to which the result's joint offsets are added."""
    found = {} if result is None else result.kinematic_offsets.joints
    readings = readings + torch.tensor([found.get(column, 0.0) for column in columns], dtype=torch.float64)
    placed = recording if result is None else with_found_bases(recording, result.kinematic_offsets)
    kinematics = RobotKinematics(placed.robot, placed.laparoscope_arm, placed.instrument_arm)
    check_apart(recording, kinematics.rcm_distance_mm())
    split = len(kinematics.laparoscope_joints)
    readings = readings[:, len(columns) - split - len(kinematics.instrument_joints) :]
    instrument, base_T_arm = kinematics.instrument(readings[:, split:]), kinematics.base_T_arm(readings[:, :split])
    offset = 0.0 if result is None or "end_offset" not in result.nuisances else result.nuisances["end_offset"].value
    radius = None if result is None or "radius" not in result.nuisances else result.nuisances["radius"].value
    s_end = instrument.rcm_s_end_mm + (offset or 0.0)
    return Scene(
        frames=frames,
        times_s=recording.frame_times_s[frames],
        laparoscope_points=None if split == 0 else kinematics.laparoscope_points(readings[:, :split]).numpy(),
        instrument_points=kinematics.instrument_points(readings[:, split:]).numpy(),
        base_T_arm=base_T_arm.numpy(),
        rcm=instrument.base_T_rcm[:, :3, 3].numpy(),
        end=transform_points(instrument.base_T_rcm, instrument.rcm_v_axis * s_end[:, None]).numpy(),
        head=transform_points(instrument.base_T_rcm, instrument.rcm_p_head).numpy(),
        radius_mm=radius or recording.shaft_diameter_mm / 2.0,
    )
