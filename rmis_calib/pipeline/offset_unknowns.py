"""Joint offsets and the clock as unknowns: what the solver asks of them, and their effect as the kinematics or an
observations file tells it.

An observations file knows the effect to first order only: where the shaft is at one set of offsets, and how a unit of
each displaces it. Further away the displacement is taken as proportional: within half a degree and a millimetre a joint
that is wrong by micrometres.
"""

from abc import ABC, abstractmethod
from dataclasses import replace
from typing import NamedTuple

import numpy as np
import torch
from jaxtyping import Bool, Float
from torch import Tensor

from rmis_calib.errors import ObservationsError
from rmis_calib.geometry.rigid import rigid_exp, rigid_inverse
from rmis_calib.io import Recording, ShaftObservations
from rmis_calib.io.observations import CLOCK
from rmis_calib.kinematics import RobotKinematics
from rmis_calib.pipeline.poses import MotionPoses, motion_poses, poses_of
from rmis_calib.results import KinematicOffsets
from rmis_calib.robot import split_joint_column
from rmis_calib.solver import Problem, Solution
from rmis_calib.solver.model.residuals import rcm_axes
from rmis_calib.solver.settings import SolverSettings, UnknownSettings

_MOVES = {"rad": 1e-4, "mm": 1e-6}
"""Displacement (rad and mm) per unit up to which a joint does not move the shaft. Those of the wrist do not, and so
have no offset that could be seen."""
_STEP = {"rad": 1e-5, "mm": 1e-3}
"""Steps of the central differences: their error, step^2 times a third derivative of order 1, is below rounding."""
_AT_ONCE = 16384
"""Poses computed in one call: memory must not grow with a recording times its joints."""
_CONTINUOUS_LOG_S = 0.2
"""A log sampled more slowly is a list of poses, in which there is no velocity and so no clock to estimate."""


class OffsetUnknowns(ABC):
    """Both arms as a function of constant joint offsets and a clock offset, for one list of M motions.

    A joint offset is added to the readings of its joint (rad or mm), the clock offset to the times at which the joints
    are read (s). The displacement of the shaft, [rotation vector, translation] in `rcm`, is that of
    `Problem.joint_derivative`.

    Attributes:
        columns: `<arm>.<joint>_rad` or `_mm` of each joint offset, laparoscope first.
        laparoscope_joints: how many of them are the laparoscope's.
        has_clock: whether a clock offset means anything.
        clock_at_s: the clock offset to start from; None: it must be searched for.
    """

    columns: tuple[str, ...]
    laparoscope_joints: int
    has_clock: bool
    clock_at_s: float | None

    @abstractmethod
    def at(self, base: Problem, joint_offset: Float[Tensor, "b j"], clock_s: Float[Tensor, " b"]) -> Problem:
        """The measurements of `base` with the shaft where `b` sets of offsets put it; `base` has one trial."""

    @abstractmethod
    def joint_derivative(
        self, joint_offset: Float[Tensor, "b j"], clock_s: Float[Tensor, " b"]
    ) -> Float[Tensor, "b m 6 j"]:
        """Displacement of the shaft per unit of each joint, at `b` sets of offsets."""

    @abstractmethod
    def clock_derivative(
        self, joint_derivative: Float[Tensor, "b m 6 j"], clock_s: Float[Tensor, " b"]
    ) -> Float[Tensor, "b m 6"]:
        """Displacement of the shaft per second of clock offset, where `joint_derivative` is that of the joints."""

    def linearised(
        self,
        base: Problem,
        joint_offset: Float[Tensor, "b j"],
        clock_s: Float[Tensor, " b"],
        sigma: Float[Tensor, " j"],
        setup: Float[Tensor, "b 4 4"] | None = None,
    ) -> Problem:
        """`at` with the derivatives that make the offsets unknowns; `sigma` is the prior of each joint's, `setup` the
        set-up to evaluate at (None: as stated)."""
        problem = replace(
            self.at(base, joint_offset, clock_s),
            joint_derivative=self.joint_derivative(joint_offset, clock_s),
            joint_offset_sigma=sigma.expand(len(clock_s), -1),
            laparoscope_joints=self.laparoscope_joints,
        )
        if setup is not None:
            problem = problem.at_setup(setup)
        if not self.has_clock or problem.joint_derivative is None:
            return problem
        return replace(problem, clock_derivative=self.clock_derivative(problem.joint_derivative, clock_s))

    def moves_shaft(self) -> Bool[Tensor, " j"]:
        """Which joints move the shaft as the camera sees it, at the nominal offsets."""
        nominal = torch.zeros(1, len(self.columns), dtype=torch.float64)
        derivative = self.joint_derivative(nominal, torch.zeros(1, dtype=torch.float64))
        least = derivative.new_tensor([_MOVES[split_joint_column(column)[1]] for column in self.columns])
        return derivative.abs().amax(dim=(0, 1, 2)) > least

    def prior_sigma(self, settings: UnknownSettings) -> Float[Tensor, " j"]:
        """Prior of each offset, rad or mm; zero for a joint that does not move the shaft."""
        sigma = {"rad": np.deg2rad(settings.joint_offset_sigma_deg), "mm": settings.joint_offset_sigma_mm}
        values = [sigma[split_joint_column(column)[1]] for column in self.columns]
        moves = self.moves_shaft()
        return torch.where(moves, torch.tensor(values, dtype=torch.float64, device=moves.device), 0.0)

    def displacements(self, joint_offset: Float[Tensor, " j"], clock_s: float) -> dict[str, np.ndarray]:
        """What an observations file says about the offsets, at one set of them: the `unknown_*` arrays."""
        clock = torch.tensor([clock_s], dtype=torch.float64)
        derivative = self.joint_derivative(joint_offset[None], clock)
        names, at = list(self.columns), [*joint_offset.tolist()]
        if self.has_clock:
            derivative = torch.cat((derivative, self.clock_derivative(derivative, clock)[..., None]), dim=-1)
            names, at = [*names, CLOCK], [*at, clock_s]
        displacement = derivative[0].mT.cpu().numpy()
        return {"unknown_names": np.array(names), "unknown_displacement": displacement, "unknown_at": np.array(at)}


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
        self.columns = tuple(recording.robot.joints(*arms))
        self._log = recording.joints.select(self.columns)
        self._times = recording.frame_times_s[frames] + recording.clock_offset_s
        intervals_s = np.diff(self._log.timestamps_s)
        # In a log of poses there is no velocity.
        self.has_clock = len(intervals_s) > 0 and float(np.median(intervals_s)) <= _CONTINUOUS_LOG_S
        self.clock_at_s = None
        self._device = device
        self.laparoscope_joints = len(self._kinematics.laparoscope_joints)
        steps = [_STEP[split_joint_column(column)[1]] for column in self.columns]
        self._steps = torch.tensor(steps, dtype=torch.float64, device=device)

    def readings_of_motions(self, clock_s: float) -> Float[Tensor, "m j"]:
        """Logged readings of every motion, rad or mm."""
        return self._readings(torch.tensor([clock_s], dtype=torch.float64))[0][0]

    def at(self, base: Problem, joint_offset: Float[Tensor, "b j"], clock_s: Float[Tensor, " b"]) -> Problem:
        readings, known = self._readings(clock_s)
        at = self._poses(readings + joint_offset[:, None])
        repeated = base.take_trials(torch.zeros(len(clock_s), dtype=torch.int64, device=joint_offset.device))
        return replace(
            repeated,
            arm_T_rcm=at.arm_T_rcm,
            rcm_v_axis=at.rcm_v_axis,
            rcm_s_end_mm=at.rcm_s_end_mm,
            rcm_p_head=at.rcm_p_head,
            laparoscope_base_T_arm=None if repeated.laparoscope_base_T_arm is None else at.laparoscope_base_T_arm,
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
            clock_derivative=torch.zeros_like(derivative[..., 0]),
        )
        setup = base.laparoscope_base_T_instrument_base
        return resting if setup is None else resting.at_setup(setup)

    def motion_poses(
        self, frames: np.ndarray, joint_offset: Float[Tensor, " j"], clock_s: float
    ) -> tuple[MotionPoses, Bool[Tensor, " m"]]:
        """Poses of the motions at one set of offsets, and in which motions the log covers that time."""
        readings, known = self._readings(torch.tensor([clock_s], dtype=torch.float64))
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
        """Displacement of the shaft as a rigid body, in `rcm`, per unit of each joint."""
        motions_at_once = max(1, _AT_ONCE // (2 * readings.shape[-1]))
        parts = [self._jacobian_at_once(part) for part in readings.flatten(0, 1).split(motions_at_once)]
        return torch.cat(parts).unflatten(0, readings.shape[:2])

    def _jacobian_at_once(self, readings: Float[Tensor, "n j"]) -> Float[Tensor, "n 6 j"]:
        """Central differences, all joints in one call."""
        steps = torch.diag(self._steps)[:, None]
        both = torch.stack([readings + steps, readings - steps])  # (2, j, n, j)
        moved, at = self._poses(both), self._poses(readings)
        arm_T_rcm, v, s_end = moved.arm_T_rcm, moved.rcm_v_axis, moved.rcm_s_end_mm
        arm_R_rcm, at_v = at.arm_T_rcm[..., :3, :3], at.rcm_v_axis
        change, scale = arm_T_rcm[0] - arm_T_rcm[1], 2.0 * self._steps[:, None, None]
        turn = arm_R_rcm.mT @ change[..., :3, :3]
        skew = 0.5 * (turn - turn.mT)
        omega = torch.stack([skew[..., 2, 1], skew[..., 0, 2], skew[..., 1, 0]], dim=-1)
        omega = omega + torch.linalg.cross(at_v.expand_as(v[0]), v[0] - v[1])
        shift = (arm_R_rcm.mT @ change[..., :3, 3:])[..., 0] + at_v * (s_end[0] - s_end[1])[..., None]
        return (torch.cat([omega, shift], dim=-1) / scale).permute(1, 2, 0)


class FileUnknowns(OffsetUnknowns):
    """The effect of the offsets as an observations file tells it: the same derivatives at every set of offsets."""

    def __init__(self, observations: ShaftObservations, device: str) -> None:
        """Keep the displacements.

        Raises:
            ObservationsError: the observations tell none.
        """
        if observations.unknown_names is None or observations.unknown_displacement is None:
            raise ObservationsError(where="unknown_displacement", expected="effects of offsets", found="none")
        names = observations.unknown_names.tolist()
        joints = [index for index, name in enumerate(names) if name != CLOCK]
        # Motions without kinematics are not valid (Problem.from_arrays); they must not spoil the sums either.
        effect = torch.as_tensor(observations.unknown_displacement, device=device).nan_to_num(nan=0.0).mT  # (m, 6, u)
        at = torch.as_tensor(observations.unknown_at, device=device)
        self.columns = tuple(names[index] for index in joints)
        # The laparoscope's come first; an observations file tells its kinematics only where it has such joints.
        arms = [column.partition(".")[0] for column in self.columns]
        both = observations.laparoscope_base_T_arm is not None and len(set(arms)) == 2
        self.laparoscope_joints = arms.count(arms[0]) if both else 0
        self.has_clock = CLOCK in names
        self._joint, self._joint_at = effect[..., joints], at[joints]
        self.clock_at_s = self._clock_at_s = float(at[names.index(CLOCK)]) if self.has_clock else 0.0
        self._clock = effect[..., names.index(CLOCK)] if self.has_clock else torch.zeros_like(effect[..., 0])

    def at(self, base: Problem, joint_offset: Float[Tensor, "b j"], clock_s: Float[Tensor, " b"]) -> Problem:
        change = joint_offset - self._joint_at
        displacement = torch.einsum("muj,bj->bmu", self._joint, change)
        displacement = displacement + self._clock * (clock_s - self._clock_at_s)[:, None, None]
        repeated = base.take_trials(torch.zeros(len(clock_s), dtype=torch.int64, device=joint_offset.device))
        return replace(
            repeated,
            arm_T_rcm=repeated.arm_T_rcm @ rigid_exp(displacement),
            joint_offset_at=joint_offset,
            clock_at=clock_s,
        )

    def joint_derivative(
        self, joint_offset: Float[Tensor, "b j"], clock_s: Float[Tensor, " b"]
    ) -> Float[Tensor, "b m 6 j"]:
        return self._joint.expand(len(clock_s), *self._joint.shape)

    def clock_derivative(
        self, joint_derivative: Float[Tensor, "b m 6 j"], clock_s: Float[Tensor, " b"]
    ) -> Float[Tensor, "b m 6"]:
        return self._clock.expand(len(clock_s), *self._clock.shape)


def recording_unknowns(
    recording: Recording, poses: MotionPoses, settings: SolverSettings, device: str
) -> KinematicUnknowns | None:
    """The kinematics as a function of joint and clock offsets; None where these are not asked for."""
    asked = settings.unknowns
    if settings.method != "joint" or (asked.joint_offsets == "never" and not asked.clock):
        return None
    return KinematicUnknowns(recording, poses.frames, device)


def file_unknowns(observations: ShaftObservations, settings: SolverSettings, device: str) -> FileUnknowns | None:
    """The offsets that are asked for and that the file can tell; None where there are none.

    Raises:
        ObservationsError: joint offsets are asked for, and the file does not tell their effect.
    """
    asked = settings.unknowns
    names = [] if observations.unknown_names is None else observations.unknown_names.tolist()
    joints = any(name != CLOCK for name in names)
    if asked.joint_offsets == "always" and not joints:
        expected = "unknown_names, unknown_displacement and unknown_at with joints, since joint_offsets is always"
        raise ObservationsError(where="observations", expected=expected, found=f"{np.array(names).tolist() or 'none'}")
    wanted = (joints and asked.joint_offsets != "never") or (CLOCK in names and asked.clock)
    return FileUnknowns(observations, device) if wanted and settings.method == "joint" else None


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
    return with_rcm_offset(with_setup(poses, offsets), offsets.rcm_mm)


def poses_at_motions(
    unknowns: "KinematicUnknowns", poses: MotionPoses, offsets: KinematicOffsets, later_s: float
) -> MotionPoses:
    """Poses of these motions with the offsets that were found, some time later."""
    values = [offsets.joints.get(column, 0.0) for column in unknowns.columns]
    joint_offset = torch.tensor(values, dtype=torch.float64, device=poses.arm_T_rcm.device)
    at, _ = unknowns.motion_poses(poses.frames, joint_offset, offsets.clock_s + later_s)
    return with_rcm_offset(with_setup(at, offsets), offsets.rcm_mm)


def with_setup(poses: MotionPoses, offsets: KinematicOffsets) -> MotionPoses:
    """The poses with the instrument's base where a calibration found it, or in the place of `arm`."""
    if offsets.arm_is_instrument_base:
        return poses.in_instrument_base()
    if offsets.setup is None:
        return poses
    return poses.at_setup(offsets.setup.matrix.to(poses.arm_T_rcm))


def with_found_bases(recording: Recording, offsets: KinematicOffsets) -> Recording:
    """The recording with the instrument's base where a calibration found it; without the laparoscope's arm where the
    instrument's base takes the place of `arm`."""
    if offsets.arm_is_instrument_base:
        return replace(recording, laparoscope_arm=None, robot=recording.robot.without_bases())
    if offsets.setup is None or recording.laparoscope_arm is None:
        return recording
    arms = dict(recording.robot.arms)
    laparoscope, instrument = arms[recording.laparoscope_arm], arms[recording.instrument_arm]
    both = laparoscope.base_T_arm_base is not None and instrument.base_T_arm_base is not None
    base_T_laparoscope_base = laparoscope.base_T_arm_base if both else None
    base_T_laparoscope_base = np.eye(4) if base_T_laparoscope_base is None else base_T_laparoscope_base
    base_T_instrument_base = base_T_laparoscope_base @ offsets.setup.matrix.cpu().numpy()
    arms[recording.laparoscope_arm] = replace(
        laparoscope,
        base_T_arm_base=base_T_laparoscope_base,  # frames: laparoscope_base = arm_base
    )
    arms[recording.instrument_arm] = replace(
        instrument,
        base_T_arm_base=base_T_instrument_base,  # frames: instrument_base = arm_base
    )
    return replace(recording, robot=replace(recording.robot, arms=arms))


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
