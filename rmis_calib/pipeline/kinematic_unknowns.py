"""Joint offsets and the clock as unknowns: both arms' kinematics as a function of them, for the solver to iterate."""

from dataclasses import replace

import numpy as np
import torch
from jaxtyping import Bool, Float
from torch import Tensor

from rmis_calib.geometry.rigid import rigid_inverse
from rmis_calib.io import Recording
from rmis_calib.kinematics import RobotKinematics
from rmis_calib.pipeline.offset_unknowns import OffsetUnknowns
from rmis_calib.pipeline.poses import MotionPoses, motion_poses
from rmis_calib.results import KinematicOffsets
from rmis_calib.robot import split_joint_column
from rmis_calib.solver import Problem
from rmis_calib.solver.model.residuals import rcm_axes

_STEP = {"rad": 1e-5, "mm": 1e-3}
"""Steps of the central differences: their error, step^2 times a third derivative of order 1, is below rounding."""
_CONTINUOUS_LOG_S = 0.2
"""A log sampled more slowly is a list of poses, in which there is no velocity and so no clock to estimate."""


def poses_at(recording: Recording, offsets: KinematicOffsets, device: str = "cpu") -> MotionPoses:
    """Poses of the motions with the offsets that a calibration found: what every prediction from a result starts from.

    Motions whose time the joint log does not cover at that clock are left out.
    """
    poses = motion_poses(recording, device)
    if offsets.clock_s or any(offsets.joints.values()):
        unknowns = KinematicUnknowns(recording, poses.frames, device)
        values = [offsets.joints.get(column, 0.0) for column in unknowns.columns]
        joint_offset = torch.tensor(values, dtype=torch.float64, device=device)
        poses, known = unknowns.motion_poses(poses.frames, joint_offset, offsets.clock_s)
        poses = poses.select(known)
    return with_rcm_offset(poses, offsets.rcm_mm)


def poses_at_motions(
    unknowns: "KinematicUnknowns", poses: MotionPoses, offsets: KinematicOffsets, later_s: float
) -> MotionPoses:
    """Poses of these motions with the offsets that were found, some time later."""
    values = [offsets.joints.get(column, 0.0) for column in unknowns.columns]
    joint_offset = torch.tensor(values, dtype=torch.float64, device=poses.arm_T_rcm.device)
    at, _ = unknowns.motion_poses(poses.frames, joint_offset, offsets.clock_s + later_s)
    return with_rcm_offset(at, offsets.rcm_mm)


def with_rcm_offset(poses: MotionPoses, rcm_mm: tuple[float, float]) -> MotionPoses:
    """The poses with the shaft's axis moved off the nominal RCM, along the directions of `residuals.rcm_axes`."""
    if not any(rcm_mm):
        return poses
    arm_R_rcm = poses.arm_T_rcm[:, :3, :3]
    arm_v = (arm_R_rcm @ poses.rcm_v_axis[..., None])[..., 0]
    first, second = rcm_axes(arm_R_rcm.permute(1, 2, 0), arm_v.T)
    arm_T_rcm = poses.arm_T_rcm.clone()
    arm_T_rcm[:, :3, 3] += (rcm_mm[0] * first + rcm_mm[1] * second).T
    return replace(poses, arm_T_rcm=arm_T_rcm)


class KinematicUnknowns(OffsetUnknowns):
    """The effect of the offsets from the joint log and both arms' kinematics, at any offsets."""

    def __init__(self, recording: Recording, frames: np.ndarray, device: str) -> None:
        """Keep what the poses depend on.

        Args:
            recording: robot, arms, joint log and frame times.
            frames: (M,) frame number of each motion.
            device: where the poses are computed.
        """
        self._kinematics = RobotKinematics(
            recording.robot, recording.laparoscope_arm, recording.instrument_arm, device=device
        )
        arms = [arm for arm in (recording.laparoscope_arm, recording.instrument_arm) if arm is not None]
        self.columns = tuple(recording.robot.joints(*arms))
        self._log = recording.joints.select(self.columns)
        self._times = recording.frame_times_s[frames] + recording.clock_offset_s
        intervals_s = np.diff(self._log.timestamps_s)
        # In a log of poses there is no velocity.
        self.has_clock = len(intervals_s) > 0 and float(np.median(intervals_s)) <= _CONTINUOUS_LOG_S
        self.clock_at_s = None
        self._device = device
        self._split = len(self._kinematics.laparoscope_joints)
        steps = [_STEP[split_joint_column(column)[1]] for column in self.columns]
        self._steps = torch.tensor(steps, dtype=torch.float64, device=device)

    def readings_of_motions(self, clock_s: float) -> Float[Tensor, "m j"]:
        """Logged readings of every motion, rad or mm."""
        return self._readings(torch.tensor([clock_s], dtype=torch.float64))[0][0]

    def at(self, base: Problem, joint_offset: Float[Tensor, "b j"], clock_s: Float[Tensor, " b"]) -> Problem:
        readings, known = self._readings(clock_s)
        arm_T_rcm, v, s_end, p_head = self._poses(readings + joint_offset[:, None])
        repeated = base.take_trials(torch.zeros(len(clock_s), dtype=torch.int64, device=joint_offset.device))
        return replace(
            repeated,
            arm_T_rcm=arm_T_rcm,
            rcm_v_axis=v,
            rcm_s_end_mm=s_end,
            rcm_p_head=p_head,
            valid=repeated.valid & known[:, None],
            joint_offset_at=joint_offset,
            clock_at=clock_s,
        )

    def joint_derivative(
        self, joint_offset: Float[Tensor, "b j"], clock_s: Float[Tensor, " b"]
    ) -> Float[Tensor, "b m 6 j"]:
        return self._jacobian(self._readings(clock_s)[0] + joint_offset.to(self._device)[:, None])

    def clock_derivative(
        self, joint_derivative: Float[Tensor, "b m 6 j"], clock_s: Float[Tensor, " b"]
    ) -> Float[Tensor, "b m 6"]:
        velocity = torch.as_tensor(self._log.interpolate(self._times_at(clock_s))[1], device=self._device)
        return (joint_derivative @ velocity[..., None])[..., 0]  # velocity: (b, m, j), unit per second

    def resting_at(self, base: Problem, readings: Float[Tensor, "m j"], joint_offset: Float[Tensor, " j"]) -> Problem:
        """The motions of `base` (one trial) with the arms at rest at these readings; rad or mm, offsets to be added."""
        arm_T_rcm, v, s_end, p_head = self._poses(readings + joint_offset)
        derivative = self._jacobian((readings + joint_offset)[None])
        return replace(
            base,
            arm_T_rcm=arm_T_rcm[None],
            rcm_v_axis=v[None],
            rcm_s_end_mm=s_end[None],
            rcm_p_head=p_head[None],
            joint_derivative=derivative,
            clock_derivative=torch.zeros_like(derivative[..., 0]),
        )

    def motion_poses(
        self, frames: np.ndarray, joint_offset: Float[Tensor, " j"], clock_s: float
    ) -> tuple[MotionPoses, Bool[Tensor, " m"]]:
        """Poses of the motions at one set of offsets, and in which motions the log covers that time."""
        readings, known = self._readings(torch.tensor([clock_s], dtype=torch.float64))
        arm_T_rcm, v, s_end, p_head = self._poses(readings[0] + joint_offset)
        return MotionPoses(frames, arm_T_rcm, v, s_end, p_head), known[0]

    def _poses(self, readings: Float[Tensor, "*batch j"]) -> tuple[Tensor, Tensor, Tensor, Tensor]:
        instrument = self._kinematics.instrument(readings[..., self._split :])
        base_T_arm = self._kinematics.base_T_arm(readings[..., : self._split])
        arm_T_rcm = rigid_inverse(base_T_arm) @ instrument.base_T_rcm
        return arm_T_rcm, instrument.rcm_v_axis, instrument.rcm_s_end_mm, instrument.rcm_p_head

    def _readings(self, clock_s: Float[Tensor, " b"]) -> tuple[Float[Tensor, "b m j"], Tensor]:
        """Readings at the frames' times, and where the log knows them; the nearest known time elsewhere."""
        times = self._times_at(clock_s)
        _, known = self._log.at(times.ravel())
        readings, _ = self._log.interpolate(times)
        known = known.reshape(times.shape)
        return torch.as_tensor(readings, device=self._device), torch.as_tensor(known, device=self._device)

    def _times_at(self, clock_s: Float[Tensor, " b"]) -> np.ndarray:
        return self._times + clock_s.cpu().numpy()[:, None]

    def _jacobian(self, readings: Float[Tensor, "b m j"]) -> Float[Tensor, "b m 6 j"]:
        """Displacement of the shaft as a rigid body, in `rcm`, per unit of each joint; all joints in one call."""
        steps = torch.diag(self._steps)[:, None, None]
        both = torch.stack([readings + steps, readings - steps])  # (2, j, b, m, j)
        arm_T_rcm, v, s_end, _ = self._poses(both)
        at_T, at_v, _, _ = self._poses(readings)
        arm_R_rcm = at_T[..., :3, :3]
        change, scale = arm_T_rcm[0] - arm_T_rcm[1], 2.0 * self._steps[:, None, None, None]
        turn = arm_R_rcm.mT @ change[..., :3, :3]
        skew = 0.5 * (turn - turn.mT)
        omega = torch.stack([skew[..., 2, 1], skew[..., 0, 2], skew[..., 1, 0]], dim=-1)
        omega = omega + torch.linalg.cross(at_v.expand_as(v[0]), v[0] - v[1])
        shift = (arm_R_rcm.mT @ change[..., :3, 3:])[..., 0] + at_v * (s_end[0] - s_end[1])[..., None]
        return (torch.cat([omega, shift], dim=-1) / scale).permute(1, 2, 3, 0)
