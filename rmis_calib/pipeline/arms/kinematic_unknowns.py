"""The effect of joint offsets and the clock, as the joint log and both arms' kinematics tell it."""

from copy import copy
from dataclasses import replace
from typing import NamedTuple

import numpy as np
import torch
from jaxtyping import Bool, Float
from torch import Tensor

from rmis_calib.geometry.rigid import rigid_inverse
from rmis_calib.io import Recording
from rmis_calib.io.recording import log_times_s
from rmis_calib.kinematics import RobotKinematics
from rmis_calib.pipeline.arms.offset_unknowns import NO_CLOCK, OffsetUnknowns
from rmis_calib.pipeline.arms.poses import MotionPoses, poses_of
from rmis_calib.solver import Problem
from rmis_calib.solver.settings import SolverSettings

_AT_ONCE = 16384
"""Poses computed in one call: memory must not grow with a recording times its joints."""
_CONTINUOUS_LOG_S = 0.2
"""A log sampled more slowly is a list of poses, in which there is no velocity and so no clock to estimate."""


class _Poses(NamedTuple):
    """Both arms at any batch of readings; `MotionPoses` has the same for one set of them."""

    arm_T_rcm: Float[Tensor, "*batch 4 4"]
    rcm_v_axis: Float[Tensor, "*batch 3"]
    rcm_s_end_mm: Float[Tensor, "*batch"]
    rcm_p_head: Float[Tensor, "*batch 3"]
    laparoscope_base_T_arm: Float[Tensor, "*batch 4 4"]


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
        joints = recording.robot.joints(*arms)
        self.columns = tuple(joints)
        sigmas = [np.nan if joint.offset_sigma is None else joint.offset_sigma for joint in joints.values()]
        self.stated_sigma = torch.tensor(sigmas, dtype=torch.float64, device=device)
        self._log = recording.joints.select(self.columns)
        self._times, self._middle_s = recording.joint_times_s[frames], recording.middle_s
        self.motions, self.half_s = len(frames), float(np.abs(self._times - self._middle_s).max(initial=0.0))
        intervals_s = np.diff(self._log.timestamps_s)
        # In a log of poses there is no velocity.
        self.has_clock = len(intervals_s) > 0 and float(np.median(intervals_s)) <= _CONTINUOUS_LOG_S
        self.clock_at = None
        self._device = device
        self.laparoscope_joints = len(self._kinematics.laparoscope_joints)

    def every(self, step: int) -> "KinematicUnknowns":
        few = copy(self)
        few._times = self._times[::step]
        few.motions = len(few._times)
        return few

    def readings_of_motions(self, clock: tuple[float, float] = NO_CLOCK) -> Float[Tensor, "m j"]:
        """Logged readings of every motion, rad or mm."""
        return self._readings(torch.tensor([clock], dtype=torch.float64))[0][0]

    def at(self, base: Problem, joint_offset: Float[Tensor, "b j"], clock: Float[Tensor, "b 2"]) -> Problem:
        readings, known = self._readings(clock)
        at = self._poses(readings + joint_offset[:, None])
        repeated = base.take_trials(torch.zeros(len(clock), dtype=torch.int64, device=joint_offset.device))
        return replace(
            repeated,
            arm_T_rcm=at.arm_T_rcm,
            rcm_v_axis=at.rcm_v_axis,
            rcm_s_end_mm=at.rcm_s_end_mm,
            rcm_p_head=at.rcm_p_head,
            laparoscope_base_T_arm=None if repeated.laparoscope_base_T_arm is None else at.laparoscope_base_T_arm,
            valid=repeated.valid & known[:, None],
            joint_offset_at=joint_offset,
            clock_at=clock,
            joints=readings,
        )

    def joint_derivative(
        self, joint_offset: Float[Tensor, "b j"], clock: Float[Tensor, "b 2"]
    ) -> Float[Tensor, "b m 6 j"]:
        return self._jacobian(self._readings(clock)[0] + joint_offset.to(self._device)[:, None])

    def clock_derivative(
        self, joint_derivative: Float[Tensor, "b m 6 j"], clock: Float[Tensor, "b 2"]
    ) -> Float[Tensor, "b m 6 2"]:
        velocity = torch.as_tensor(self._log.interpolate(self._times_at(clock))[1], device=self._device)
        by_offset = joint_derivative @ velocity[..., None]  # velocity: (b, m, j), unit per second
        from_middle = torch.as_tensor(self._times - self._middle_s, device=self._device)
        return torch.cat((by_offset, by_offset * from_middle[:, None, None]), dim=-1)

    def resting_at(self, base: Problem, readings: Float[Tensor, "m j"], joint_offset: Float[Tensor, " j"]) -> Problem:
        """The motions of `base` (one trial) with the arms at rest at these readings; rad or mm, offsets to be added."""
        at = self._poses(readings + joint_offset)
        derivative = self._jacobian((readings + joint_offset)[None])
        stated, told = self._kinematics.laparoscope_base_T_instrument_base, base.laparoscope_base_T_arm is not None
        resting = replace(
            base,
            arm_T_rcm=at.arm_T_rcm[None],
            rcm_v_axis=at.rcm_v_axis[None],
            rcm_s_end_mm=at.rcm_s_end_mm[None],
            rcm_p_head=at.rcm_p_head[None],
            laparoscope_base_T_arm=at.laparoscope_base_T_arm[None] if told else None,
            laparoscope_base_T_instrument_base=stated[None] if told and stated is not None else None,
            joint_derivative=derivative,
            laparoscope_joints=self.laparoscope_joints,
            clock_derivative=torch.zeros_like(derivative[..., :1]).repeat(1, 1, 1, 2),
        )
        setup = base.laparoscope_base_T_instrument_base
        return resting if setup is None else resting.at_setup(setup)

    def motion_poses(
        self, frames: np.ndarray, joint_offset: Float[Tensor, " j"], clock: tuple[float, float] = NO_CLOCK
    ) -> tuple[MotionPoses, Bool[Tensor, " m"]]:
        """Poses of the motions at one set of offsets, and in which motions the log covers that time."""
        readings, known = self._readings(torch.tensor([clock], dtype=torch.float64))
        laparoscope, instrument = (readings[0] + joint_offset).tensor_split((self.laparoscope_joints,), dim=-1)
        return poses_of(self._kinematics, frames, laparoscope, instrument), known[0]

    def _poses(self, readings: Float[Tensor, "*batch j"]) -> "_Poses":
        parts = [self._poses_at_once(part) for part in readings.flatten(0, -2).split(_AT_ONCE)]
        return _Poses(*(torch.cat(part).unflatten(0, readings.shape[:-1]) for part in zip(*parts, strict=True)))

    def _poses_at_once(self, readings: Float[Tensor, "n j"]) -> "_Poses":
        laparoscope, instrument = readings.tensor_split((self.laparoscope_joints,), dim=-1)
        pose, own = self._kinematics.instrument(instrument), self._kinematics.laparoscope_base_T_arm(laparoscope)
        arm_T_rcm = rigid_inverse(self._kinematics.base_T_arm(laparoscope)) @ pose.base_T_rcm
        own = torch.eye(4).to(arm_T_rcm).expand_as(arm_T_rcm) if own is None else own
        return _Poses(arm_T_rcm, pose.rcm_v_axis, pose.rcm_s_end_mm, pose.rcm_p_head, own)

    def _readings(self, clock: Float[Tensor, "b 2"]) -> tuple[Float[Tensor, "b m j"], Tensor]:
        """Readings at the frames' times, and where the log knows them; the nearest known time elsewhere."""
        times = self._times_at(clock)
        _, known = self._log.at(times.ravel())
        readings, _ = self._log.interpolate(times)
        known = known.reshape(times.shape)
        return torch.as_tensor(readings, device=self._device), torch.as_tensor(known, device=self._device)

    def _times_at(self, clock: Float[Tensor, "b 2"]) -> np.ndarray:
        offset_s, rate = clock.cpu().numpy().T[..., None]
        return log_times_s(self._times, self._middle_s, offset_s, rate)

    def _jacobian(self, readings: Float[Tensor, "b m j"]) -> Float[Tensor, "b m 6 j"]:
        """Displacement of the shaft as a rigid body, in `rcm`, per unit of each joint."""
        laparoscope, instrument = readings.flatten(0, 1).tensor_split((self.laparoscope_joints,), dim=-1)
        parts = zip(laparoscope.split(_AT_ONCE), instrument.split(_AT_ONCE), strict=True)
        return torch.cat([self._kinematics.shaft_displacements(*part) for part in parts]).unflatten(
            0, readings.shape[:2]
        )


def recording_unknowns(
    recording: Recording, poses: MotionPoses, settings: SolverSettings, device: str
) -> KinematicUnknowns | None:
    """The kinematics as a function of joint and clock offsets; None where these are not asked for."""
    asked = settings.unknowns
    if settings.method != "joint" or (asked.joint_offsets == "never" and not asked.clock):
        return None
    return KinematicUnknowns(recording, poses.frames, device)
