"""The kinematics with what a calibration found: joint offsets, clock, set-up, and the miss of the RCM by the shaft."""

from dataclasses import replace

import numpy as np
import torch
from jaxtyping import Float
from torch import Tensor

from rmis_calib.io import Recording
from rmis_calib.pipeline.arms.kinematic_unknowns import KinematicUnknowns
from rmis_calib.pipeline.arms.poses import MotionPoses, motion_poses
from rmis_calib.results import KinematicOffsets
from rmis_calib.solver.model.predicted_shaft import rcm_axes


def poses_at(recording: Recording, offsets: KinematicOffsets, device: str = "cpu") -> MotionPoses:
    """Poses of the motions with the offsets that a calibration found: what every prediction from a result starts from.

    Motions whose time the joint log does not cover at that clock are left out.
    """
    poses = motion_poses(recording, device)
    if any(offsets.clock) or any(offsets.joints.values()):
        unknowns = KinematicUnknowns(recording, poses.frames, device)
        poses, known = unknowns.motion_poses(poses.frames, _joint_offset(unknowns, offsets, device), offsets.clock)
        poses = poses.select(known)
    return with_rcm_offset(with_setup(poses, offsets), offsets.rcm_mm)


def poses_at_motions(
    unknowns: KinematicUnknowns, poses: MotionPoses, offsets: KinematicOffsets, later_s: float
) -> MotionPoses:
    """Poses of these motions with the offsets that were found, some time later."""
    joint_offset, (offset_s, rate) = _joint_offset(unknowns, offsets, poses.arm_T_rcm.device), offsets.clock
    at, _ = unknowns.motion_poses(poses.frames, joint_offset, (offset_s + later_s, rate))
    return with_rcm_offset(with_setup(at, offsets), offsets.rcm_mm)


def _joint_offset(
    unknowns: KinematicUnknowns, offsets: KinematicOffsets, device: str | torch.device
) -> Float[Tensor, " j"]:
    """Offsets of the joints in the order of the kinematics; 0 for those that the result names none of."""
    values = [offsets.joints.get(column, 0.0) for column in unknowns.columns]
    return torch.tensor(values, dtype=torch.float64, device=device)


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
    """The poses with the shaft's axis moved off the nominal RCM, along the directions of `predicted_shaft.rcm_axes`."""
    if not any(rcm_mm):
        return poses
    arm_R_rcm = poses.arm_T_rcm[:, :3, :3]
    arm_v = (arm_R_rcm @ poses.rcm_v_axis[..., None])[..., 0]
    first, second = rcm_axes(arm_R_rcm.permute(1, 2, 0), arm_v.T)
    arm_T_rcm = poses.arm_T_rcm.clone()
    arm_T_rcm[:, :3, 3] += (rcm_mm[0] * first + rcm_mm[1] * second).T
    return replace(poses, arm_T_rcm=arm_T_rcm)
