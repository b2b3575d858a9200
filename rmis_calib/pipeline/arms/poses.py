"""Joint readings at frame times, as the poses that the solver needs."""

from dataclasses import dataclass, replace

import numpy as np
import torch
from jaxtyping import Bool, Float
from torch import Tensor

from rmis_calib.errors import RobotError
from rmis_calib.geometry.cameras import Camera
from rmis_calib.geometry.lines import contour_planes
from rmis_calib.geometry.rigid import rigid_inverse, rotate_vectors, transform_points
from rmis_calib.io import Recording
from rmis_calib.kinematics import RobotKinematics
from rmis_calib.results import INSTRUMENT_BASE

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
        laparoscope_base_T_arm: (M, 4, 4) forward kinematics of the laparoscope's arm in its own base; None where there
            is no such arm.
        laparoscope_base_T_instrument_base: the set-up that `arm_T_rcm` was evaluated at.
        setup_is_stated: whether the robot tells it; else it was evaluated at the identity.
        setup_sigma: how well it tells it, 1 sigma per axis in mm and rad; zero: exactly; None: nobody states it.
    """

    frames: np.ndarray
    arm_T_rcm: Float[Tensor, "m 4 4"]
    rcm_v_axis: Float[Tensor, "m 3"]
    rcm_s_end_mm: Float[Tensor, " m"]
    rcm_p_head: Float[Tensor, "m 3"]
    laparoscope_base_T_arm: Float[Tensor, "m 4 4"] | None = None
    laparoscope_base_T_instrument_base: Float[Tensor, "4 4"] | None = None
    setup_is_stated: bool = True
    setup_sigma: tuple[float, float] | None = None

    def select(self, which: Bool[Tensor, " m"]) -> "MotionPoses":
        """The poses of some motions."""
        chosen = {name: value[which] for name, value in self.by_motion().items()}
        return replace(self, frames=self.frames[which.cpu().numpy()], **chosen)

    def by_motion(self) -> dict[str, Tensor]:
        """All tensors with an entry for each motion, by name."""
        tensors = {name: value for name, value in vars(self).items() if isinstance(value, Tensor)}
        tensors.pop("laparoscope_base_T_instrument_base", None)
        return tensors

    def at_setup(self, setup: Float[Tensor, "4 4"]) -> "MotionPoses":
        """The poses with the instrument's base where this `laparoscope_base_T_instrument_base` puts it."""
        if self.laparoscope_base_T_arm is None or self.laparoscope_base_T_instrument_base is None:
            return self
        arm_T_laparoscope_base = rigid_inverse(self.laparoscope_base_T_arm)
        moved = setup @ rigid_inverse(self.laparoscope_base_T_instrument_base)
        arm_T_rcm = arm_T_laparoscope_base @ moved @ self.laparoscope_base_T_arm @ self.arm_T_rcm
        return replace(self, arm_T_rcm=arm_T_rcm, laparoscope_base_T_instrument_base=setup)

    def in_instrument_base(self) -> "MotionPoses":
        """The poses with the instrument's base in the place of `arm`."""
        if self.laparoscope_base_T_arm is None or self.laparoscope_base_T_instrument_base is None:
            return self
        instrument_base_T_arm = rigid_inverse(self.laparoscope_base_T_instrument_base) @ self.laparoscope_base_T_arm
        return replace(
            self,
            arm_T_rcm=instrument_base_T_arm @ self.arm_T_rcm,  # frames: instrument_base = arm
            laparoscope_base_T_arm=None,
            laparoscope_base_T_instrument_base=None,
        )


def motion_poses(recording: Recording, device: str = "cpu") -> MotionPoses:
    """Forward kinematics of both arms, at the time of every frame that the joint log covers, in one batched call.

    Raises:
        RobotError: the robot's description cannot carry the recording's arms.
    """
    kinematics = RobotKinematics(recording.robot, recording.laparoscope_arm, recording.instrument_arm, device=device)
    check_apart(recording, kinematics.rcm_distance_mm())
    instrument, known = recording.joints_at_frames(recording.instrument_arm)
    laparoscope, laparoscope_known = recording.joints_at_frames(recording.laparoscope_arm)
    frames = np.flatnonzero(known & laparoscope_known)
    readings = (torch.as_tensor(each[frames], device=device) for each in (laparoscope, instrument))
    return poses_of(kinematics, frames, *readings)


def frame_of(recording: Recording) -> str:
    """What `arm` is in the poses of a recording: where there is no laparoscope's arm it is the robot's base, or, where
    nobody states that, the instrument's."""
    stated = recording.robot.arms[recording.instrument_arm].base_T_arm_base is not None
    return "arm" if recording.laparoscope_arm is not None or stated else INSTRUMENT_BASE


def poses_of(
    kinematics: RobotKinematics,
    frames: np.ndarray,
    laparoscope: Float[Tensor, "m l"],
    instrument: Float[Tensor, "m i"],
) -> MotionPoses:
    """Forward kinematics of both arms at the readings of each motion."""
    pose = kinematics.instrument(instrument)
    return MotionPoses(
        frames,
        rigid_inverse(kinematics.base_T_arm(laparoscope)) @ pose.base_T_rcm,
        pose.rcm_v_axis,
        pose.rcm_s_end_mm,
        pose.rcm_p_head,
        kinematics.laparoscope_base_T_arm(laparoscope),
        kinematics.laparoscope_base_T_instrument_base,
        kinematics.setup_is_stated,
        kinematics.setup_sigma,
    )


def check_apart(recording: Recording, distance_mm: float | None) -> None:
    """Refuse two arms at one place: bases that nobody filled in, as in the shipped presets."""
    if distance_mm is None or distance_mm >= LEAST_RCM_DISTANCE_MM:
        return
    raise RobotError(
        where=f"robot {recording.robot.name}",
        expected=(
            "two arms with remote centres apart: fill base_T_arm_base of "
            f"arms.{recording.laparoscope_arm} and arms.{recording.instrument_arm} (where each arm's base stands on "
            "that day; copy a preset to robot.yaml beside recording.yaml first, and write robot: robot.yaml), or leave "
            "base_T_arm_base out of both: it is then estimated, if the laparoscope moves"
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


def row_delay_s(camera: Camera, v_px: Float[Tensor, "*b"], rolling_shutter_s: float) -> Float[Tensor, "*b"]:
    """How long after the middle row of the picture the row of each pixel is read, s; 0 where it is NaN."""
    last = max(camera.image_size[0] - 1, 1)
    return rolling_shutter_s * torch.nan_to_num(v_px / last - 0.5).clamp(-0.5, 0.5)
