"""Joint readings at frame times, as the poses that the solver needs."""

from dataclasses import dataclass

import numpy as np
import torch
from jaxtyping import Bool, Float
from torch import Tensor

from rmis_calib.errors import RobotError
from rmis_calib.geometry.lines import contour_planes
from rmis_calib.geometry.rigid import rigid_inverse, rotate_vectors, transform_points
from rmis_calib.io import Recording
from rmis_calib.kinematics import RobotKinematics

LEAST_RCM_DISTANCE_MM = 5.0
"""Two trocars are never this near to each other."""


@dataclass(frozen=True, eq=False)
class MotionPoses:
    """Kinematics of the motions whose joints are known.

    Attributes:
        frames: (M,) frame number of each motion.
        arm_T_rcm: (M, 4, 4) RCM frame in the laparoscope arm's end-effector frame, mm.
        rcm_v_axis: (M, 3) unit direction of the shaft, RCM to tip.
        rcm_s_end_mm: (M,) nominal coordinate of the shaft's end along the axis from the RCM.
        rcm_p_head: (M, 3) head point, mm.
    """

    frames: np.ndarray
    arm_T_rcm: Float[Tensor, "m 4 4"]
    rcm_v_axis: Float[Tensor, "m 3"]
    rcm_s_end_mm: Float[Tensor, " m"]
    rcm_p_head: Float[Tensor, "m 3"]

    def select(self, which: Bool[Tensor, " m"]) -> "MotionPoses":
        """The poses of some motions."""
        tensors = {name: value[which] for name, value in vars(self).items() if isinstance(value, Tensor)}
        return MotionPoses(frames=self.frames[which.cpu().numpy()], **tensors)


def motion_poses(recording: Recording, device: str = "cpu") -> MotionPoses:
    """Forward kinematics of both arms, at the time of every frame that the joint log covers, in one batched call.

    Raises:
        RobotError: the robot's description cannot carry the recording's arms.
    """
    kinematics = RobotKinematics(recording.robot, recording.laparoscope_arm, recording.instrument_arm, device=device)
    _check_apart(recording, kinematics.rcm_distance_mm())
    instrument, known = recording.joints_at_frames(recording.instrument_arm)
    laparoscope, laparoscope_known = recording.joints_at_frames(recording.laparoscope_arm)
    frames = np.flatnonzero(known & laparoscope_known)
    instrument_pose = kinematics.instrument(torch.as_tensor(instrument[frames], device=device))
    base_T_arm = kinematics.base_T_arm(torch.as_tensor(laparoscope[frames], device=device))
    arm_T_rcm = rigid_inverse(base_T_arm) @ instrument_pose.base_T_rcm
    return MotionPoses(
        frames, arm_T_rcm, instrument_pose.rcm_v_axis, instrument_pose.rcm_s_end_mm, instrument_pose.rcm_p_head
    )


def _check_apart(recording: Recording, distance_mm: float | None) -> None:
    """Refuse two arms at one place: bases that nobody filled in, as in the shipped presets."""
    if distance_mm is None or distance_mm >= LEAST_RCM_DISTANCE_MM:
        return
    raise RobotError(
        where=f"robot {recording.robot.name}",
        expected=(
            "two arms with remote centres apart: fill base_T_arm_base of "
            f"arms.{recording.laparoscope_arm} and arms.{recording.instrument_arm} (where each arm's base stands on "
            "that day; copy a preset to robot.yaml beside recording.yaml first, and write robot: robot.yaml)"
        ),
        found=f"both within {max(distance_mm, 0.1):.1f} mm of one point",
    )


def predict_contours(
    camera_T_arm: Float[Tensor, "4 4"], poses: MotionPoses, radius_mm: float
) -> Float[Tensor, "m 2 3"]:
    """Contour planes of the shaft where kinematics and calibration put it, in one camera."""
    camera_T_rcm = camera_T_arm @ poses.arm_T_rcm
    return contour_planes(camera_T_rcm[..., :3, 3], rotate_vectors(camera_T_rcm, poses.rcm_v_axis), radius_mm)


def predict_ends(camera_T_arm: Float[Tensor, "4 4"], poses: MotionPoses, offset_mm: float) -> Float[Tensor, "m 3"]:
    """The shaft's end on the axis, in one camera, mm."""
    rcm_p_end = poses.rcm_v_axis * (poses.rcm_s_end_mm + offset_mm)[:, None]
    return transform_points(camera_T_arm @ poses.arm_T_rcm, rcm_p_end)
