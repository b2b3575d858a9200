"""Joint offsets and the clock as unknowns: both arms' kinematics as a function of them, for the solver to iterate."""

from dataclasses import replace

import numpy as np
import torch
from jaxtyping import Bool, Float
from torch import Tensor

from rmis_calib.geometry.rigid import rigid_inverse
from rmis_calib.io import Recording
from rmis_calib.io.observations import CLOCK
from rmis_calib.kinematics import RobotKinematics
from rmis_calib.pipeline.poses import MotionPoses, motion_poses
from rmis_calib.results import KinematicOffsets
from rmis_calib.solver import Problem, Solution
from rmis_calib.solver.model.residuals import rcm_axes
from rmis_calib.solver.settings import UnknownSettings

_STEP = {"rad": 1e-5, "mm": 1e-3}
"""Steps of the central differences: their error, step^2 times a third derivative of order 1, is below rounding."""
_CONTINUOUS_LOG_S = 0.2
"""A log sampled more slowly is a list of poses, in which there is no velocity and so no clock to estimate."""
_MOVES_MM = 1e-6
"""A joint whose unit step moves the shaft by less than this (the wrist's joints) has no offset that could be seen."""


def joint_sigma(columns: tuple[str, ...], moves: Bool[Tensor, " j"], settings: UnknownSettings) -> Float[Tensor, " j"]:
    """Prior of each joint's offset, rad or mm; zero for a joint that does not move the shaft."""
    sigma = {"rad": np.deg2rad(settings.joint_offset_sigma_deg), "mm": settings.joint_offset_sigma_mm}
    values = [sigma[column.rpartition("_")[2]] for column in columns]
    return torch.where(moves, torch.tensor(values, dtype=torch.float64, device=moves.device), 0.0)


def estimated_offsets(solution: Solution, columns: tuple[str, ...], like: Tensor) -> tuple[Float[Tensor, " j"], float]:
    """Joint offsets (rad or mm) and clock offset (s) of a solution; zero where they were not estimated."""
    found = {name: nuisance.value.reshape(-1) for name, nuisance in solution.nuisances.items()}
    joint_offset = found.get("joint_offset", like.new_zeros(len(columns)))
    return joint_offset, float(found["clock"]) if "clock" in found else 0.0


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


class KinematicUnknowns:
    """Poses of the motions at any joint offsets and clock offset, with their derivatives."""

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
        self.columns = tuple(column for arm in arms for column in recording.robot.columns(arm))
        """`<arm>.<joint>_rad` or `_mm`: the joints whose offsets are unknowns, laparoscope first."""
        self._log = recording.joints.select(self.columns)
        self._times = recording.frame_times_s[frames] + recording.clock_offset_s
        intervals_s = np.diff(self._log.timestamps_s)
        self.has_clock = len(intervals_s) > 0 and float(np.median(intervals_s)) <= _CONTINUOUS_LOG_S
        """Whether the log is continuous enough for a clock offset to mean anything."""
        self._device = device
        self._split = len(self._kinematics.laparoscope_joints)
        steps = [_STEP[column.rpartition("_")[2]] for column in self.columns]
        self._steps = torch.tensor(steps, dtype=torch.float64, device=device)

    def prior_sigma(self, settings: UnknownSettings) -> Float[Tensor, " j"]:
        """Prior of each offset, rad or mm; zero for a joint that does not move the shaft."""
        return joint_sigma(self.columns, self.moves_shaft(), settings)

    def moves_shaft(self) -> Bool[Tensor, " j"]:
        """Which joints move the shaft as the camera sees it; those of the wrist do not."""
        derivative = self._derivative(self._readings(torch.zeros(1, dtype=torch.float64))[0])
        return derivative.abs().amax(dim=(0, 1, 2)) * self._steps / self._steps.max() > _MOVES_MM

    def readings_of_motions(self, clock_s: float) -> Float[Tensor, "m j"]:
        """Logged readings of every motion, rad or mm."""
        return self._readings(torch.tensor([clock_s], dtype=torch.float64))[0][0]

    def at(self, base: Problem, joint_offset: Float[Tensor, "b j"], clock_s: Float[Tensor, " b"]) -> Problem:
        """The measurements of `base` with the kinematics evaluated at `b` sets of offsets.

        Args:
            base: one trial axis of length 1.
            joint_offset: added to the readings, rad or mm.
            clock_s: added to the times at which the joints are read.
        """
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

    def linearised(
        self,
        base: Problem,
        joint_offset: Float[Tensor, "b j"],
        clock_s: Float[Tensor, " b"],
        sigma: Float[Tensor, " j"],
    ) -> Problem:
        """The same with the derivatives that make the offsets unknowns; `sigma` is the prior of each joint's."""
        derivative = self._derivative(self._readings(clock_s)[0] + joint_offset[:, None])
        return replace(
            self.at(base, joint_offset, clock_s),
            joint_derivative=derivative,
            joint_offset_sigma=sigma.expand(len(clock_s), -1),
            clock_derivative=(derivative @ self._velocity(clock_s)[..., None])[..., 0] if self.has_clock else None,
        )

    def resting_at(self, base: Problem, readings: Float[Tensor, "m j"], joint_offset: Float[Tensor, " j"]) -> Problem:
        """The motions of `base` (one trial) with the arms at rest at these readings; rad or mm, offsets to be added."""
        arm_T_rcm, v, s_end, p_head = self._poses(readings + joint_offset)
        derivative = self._derivative((readings + joint_offset)[None])
        return replace(
            base,
            arm_T_rcm=arm_T_rcm[None],
            rcm_v_axis=v[None],
            rcm_s_end_mm=s_end[None],
            rcm_p_head=p_head[None],
            joint_derivative=derivative,
            clock_derivative=torch.zeros_like(derivative[..., 0]),
        )

    def displacements(self, joint_offset: Float[Tensor, " j"], clock_s: float) -> dict[str, np.ndarray]:
        """What an observations file says about the offsets, at one set of them: the `unknown_*` arrays."""
        clock = torch.tensor([clock_s], dtype=torch.float64)
        derivative = self._derivative(self._readings(clock)[0] + joint_offset)  # (1, m, 6, j)
        names, at = list(self.columns), [*joint_offset.tolist()]
        if self.has_clock:
            derivative = torch.cat((derivative, derivative @ self._velocity(clock)[..., None]), dim=-1)
            names, at = [*names, CLOCK], [*at, clock_s]
        displacement = derivative[0].mT.cpu().numpy()
        return {"unknown_names": np.array(names), "unknown_displacement": displacement, "unknown_at": np.array(at)}

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

    def _velocity(self, clock_s: Float[Tensor, " b"]) -> Float[Tensor, "b m j"]:
        """Of the readings, unit per second."""
        return torch.as_tensor(self._log.interpolate(self._times_at(clock_s))[1], device=self._device)

    def _times_at(self, clock_s: Float[Tensor, " b"]) -> np.ndarray:
        return self._times + clock_s.cpu().numpy()[:, None]

    def _derivative(self, readings: Float[Tensor, "b m j"]) -> Float[Tensor, "b m 6 j"]:
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
