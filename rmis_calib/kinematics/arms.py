"""Joint readings of both arms to the transforms that the calibration needs."""

import math
from dataclasses import dataclass

import torch
from jaxtyping import Float
from torch import Tensor

from rmis_calib.errors import RobotError, ShapeError
from rmis_calib.geometry.rigid import rigid_inverse, transform_points
from rmis_calib.kinematics.arm_chain import ArmChain
from rmis_calib.kinematics.joint_twists import velocity_of
from rmis_calib.robot import Arm, Robot

# A shaft that misses its remote centre by more than this has the wrong frame number or the wrong table: real tables
# miss it by micrometres, and a wrong frame by centimetres.
_MAX_RCM_MISS_MM = 1.0
_LEAST_SPREAD = 0.01
"""Mean squared sine of the axes' directions from which lines meet in a point, not in a bundle of parallels."""
_PIVOT_SAMPLES, _PIVOT_MISS_MM = 32, 5.0
"""Poses of the laparoscope's arm from which its remote centre is told, and how far its axis may pass from it."""


@dataclass(frozen=True, eq=False)
class InstrumentPose:
    """Where the instrument is, one for every set of readings."""

    base_T_rcm: Float[Tensor, "*batch 4 4"]
    """Frame at the remote centre of motion; its origin lies on the shaft axis."""
    rcm_v_axis: Float[Tensor, "*batch 3"]
    """Unit direction of the shaft, RCM towards tip."""
    rcm_p_head: Float[Tensor, "*batch 3"]
    """Head point, mm."""
    rcm_s_end_mm: Float[Tensor, "*batch"]
    """Nominal place of the shaft's end, as its coordinate along the axis from the RCM, known up to one constant."""


class RobotKinematics:
    """Forward kinematics of the arm that carries the laparoscope and of the one that carries the instrument.

    Everything is differentiable in the readings, and so in joint offsets that are added to them.

    Args:
        robot: description with both arms.
        laparoscope_arm: its name in the description; None where the camera stands still, so that `arm` is `base`.
        instrument_arm: its name in the description.
        dtype: of all tensors; readings must have it too.
        device: of all tensors.

    Raises:
        RobotError: an arm, a frame number or a head point is missing or impossible, or the shaft misses the RCM.
    """

    def __init__(
        self,
        robot: Robot,
        laparoscope_arm: str | None,
        instrument_arm: str,
        dtype: torch.dtype = torch.float64,
        device: torch.device | str = "cpu",
    ) -> None:
        bases = [arm.base_T_arm_base for name, arm in robot.arms.items() if name in (laparoscope_arm, instrument_arm)]
        self.setup_is_stated = all(base is not None for base in bases)
        """Whether the robot tells where the bases of both arms are; else both are at the identity here."""
        self.setup_sigma = None
        """1 sigma per axis (mm, rad) of the set-up that the robot states; zero where it is exact, None where nobody
        states it."""
        if self.setup_is_stated and robot.setup_sigma_mm is not None and robot.setup_sigma_rad is not None:
            self.setup_sigma = (robot.setup_sigma_mm, robot.setup_sigma_rad)
        self._laparoscope = None
        if laparoscope_arm is not None:
            self._laparoscope = ArmChain(robot, laparoscope_arm, dtype, device, self.setup_is_stated)
        self._instrument = ArmChain(robot, instrument_arm, dtype, device, self.setup_is_stated)
        self.laparoscope_joints = () if self._laparoscope is None else self._laparoscope.names
        """Names of the laparoscope arm's joints, in the order of its readings."""
        self.instrument_joints = self._instrument.names
        """Names of the instrument arm's joints, in the order of its readings."""
        self._dtype, self._device = dtype, device
        table, where = robot.arms[instrument_arm], f"robot {robot.name}, arm {instrument_arm}"
        self._rcm_frame = _frame_number(table.rcm_frame, table, f"{where}, rcm_frame")
        self._shaft_frame = _frame_number(table.shaft_frame, table, f"{where}, shaft_frame")
        if table.head_point is None:
            raise RobotError(where=where, expected="a head_point", found="none")
        self._towards_tip = -1.0 if table.shaft_reversed else 1.0
        self._head_frame = _frame_number(table.head_point.frame, table, f"{where}, head_point.frame")
        self._head_p_point = torch.tensor(list(table.head_point.xyz_mm), dtype=dtype, device=device)
        self._check_shaft_meets_rcm(where)

    def base_T_arm(self, joints: Float[Tensor, "*batch j"]) -> Float[Tensor, "*batch 4 4"]:
        """End-effector frame of the laparoscope arm, its tool transform included; the identity where there is no arm.

        Args:
            joints: readings of `laparoscope_joints`, rad or mm; (..., 0) where there is no arm.

        Raises:
            ShapeError: another number of joints, or another dtype.
        """
        if self._laparoscope is not None:
            self._laparoscope.check(joints)
            base_T_end = self._laparoscope.frames_in_base(joints)[..., -1, :, :]
            return base_T_end @ self._laparoscope.end_T_tool  # frames: tool = arm
        if joints.shape[-1] != 0:
            raise ShapeError(where="laparoscope readings", expected="(..., 0): no arm", found=tuple(joints.shape))
        return torch.eye(4, dtype=self._dtype, device=self._device).expand(*joints.shape[:-1], 4, 4)

    @property
    def laparoscope_base_T_instrument_base(self) -> Float[Tensor, "4 4"] | None:
        """The set-up as the robot states it, or the identity where it states none; None where there is no laparoscope's
        arm."""
        if self._laparoscope is None:
            return None
        base_T_laparoscope_base = self._laparoscope.base_T_arm_base  # frames: arm_base = laparoscope_base
        base_T_instrument_base = self._instrument.base_T_arm_base  # frames: arm_base = instrument_base
        return rigid_inverse(base_T_laparoscope_base) @ base_T_instrument_base

    def laparoscope_base_T_arm(self, joints: Float[Tensor, "*batch j"]) -> Float[Tensor, "*batch 4 4"] | None:
        """`arm` in the base of the laparoscope's own arm; None where there is no such arm.

        Raises:
            ShapeError: another number of joints, or another dtype.
        """
        if self._laparoscope is None:
            return None
        base_T_laparoscope_base = self._laparoscope.base_T_arm_base  # frames: arm_base = laparoscope_base
        return rigid_inverse(base_T_laparoscope_base) @ self.base_T_arm(joints)

    def instrument(self, joints: Float[Tensor, "*batch j"]) -> InstrumentPose:
        """Remote centre, shaft axis, head point and shaft end of the instrument.

        Args:
            joints: readings of `instrument_joints`, rad or mm.

        Raises:
            ShapeError: another number of joints, or another dtype.
        """
        self._instrument.check(joints)
        # With the wrist straight the head point is a place on the shaft, whatever the wrist does now.
        both = self._instrument.frames_in_base(torch.stack([joints, self._straight(joints)]))
        base_T_rcm = both[0, ..., self._rcm_frame, :, :]
        rcm_T_base = rigid_inverse(base_T_rcm)
        rcm_T_shaft = rcm_T_base @ both[0, ..., self._shaft_frame, :, :]
        rcm_v_axis = self._towards_tip * rcm_T_shaft[..., :3, 2]
        base_T_head = both[..., self._head_frame, :, :]
        rcm_p_head, rcm_p_straight = transform_points(rcm_T_base @ base_T_head, self._head_p_point).unbind(0)
        return InstrumentPose(base_T_rcm, rcm_v_axis, rcm_p_head, (rcm_v_axis * rcm_p_straight).sum(-1))

    def shaft_displacements(
        self, laparoscope: Float[Tensor, "*batch l"], instrument: Float[Tensor, "*batch i"]
    ) -> Float[Tensor, "*batch 6 j"]:
        """Displacement of the shaft as a rigid body, seen from `arm`, per unit of each joint, rad or mm; the
        laparoscope's joints first.

        Returns:
            Rotation vector, rad, and translation of the RCM, mm, in `rcm`. Joints between the RCM's frame and the
            shaft's turn the shaft by v x dv and move its end, and so the shaft, by v ds; those beyond do not move it.

        Raises:
            ShapeError: another number of joints, or another dtype.
        """
        pose = self.instrument(instrument)
        omega, shift = self._moves_of_shaft(instrument, pose)
        if self._laparoscope is not None:
            self._laparoscope.check(laparoscope)
            away = -self._laparoscope.twists(laparoscope)
            omega = torch.cat((away[..., :3], omega), dim=-2)
            shift = torch.cat((velocity_of(pose.base_T_rcm[..., :3, 3], away), shift), dim=-2)
        rcm_R_base = pose.base_T_rcm[..., :3, :3].mT
        return torch.cat((rcm_R_base @ omega.mT, rcm_R_base @ shift.mT), dim=-2)

    def _moves_of_shaft(
        self, joints: Float[Tensor, "*batch i"], pose: InstrumentPose
    ) -> tuple[Float[Tensor, "*batch i 3"], Float[Tensor, "*batch i 3"]]:
        """Rotation vector of the shaft and translation of the RCM, in `base`, per unit of the instrument's joints."""
        twist = self._instrument.twists(joints)
        base_R_rcm, base_p_rcm = pose.base_T_rcm[..., :3, :3], pose.base_T_rcm[..., :3, 3]
        base_T_head = self._instrument.frames_in_base(self._straight(joints))[..., self._head_frame, :, :]
        base_p_end = transform_points(base_T_head, self._head_p_point)
        base_v_axis = (base_R_rcm @ pose.rcm_v_axis[..., None])[..., 0]

        def of(frame: int) -> Float[Tensor, "*batch i 6"]:
            """Twists of the joints that move a frame."""
            number = torch.arange(twist.shape[-2], device=twist.device)
            return torch.where((number < frame)[:, None], twist, 0.0)

        of_rcm, of_end = of(self._rcm_frame), of(min(self._shaft_frame, self._head_frame))
        omega, shift = of_rcm[..., :3], velocity_of(base_p_rcm, of_rcm)
        v = base_v_axis[..., None, :].expand_as(omega)
        turn = of(self._shaft_frame)[..., :3]
        dv = torch.linalg.cross(turn - omega, v)  # seen from `rcm`
        along = (velocity_of(base_p_end, of_end) - shift) * v
        along = along + torch.linalg.cross(turn, v) * (base_p_end - base_p_rcm)[..., None, :]
        return omega + torch.linalg.cross(v, dv), shift + v * along.sum(-1, keepdim=True)

    def _straight(self, joints: Float[Tensor, "*batch i"]) -> Float[Tensor, "*batch i"]:
        """Readings with the wrist straight."""
        return torch.where(torch.arange(joints.shape[-1], device=joints.device) < self._shaft_frame, joints, 0.0)

    def laparoscope_points(self, joints: Float[Tensor, "*batch j"]) -> Float[Tensor, "*batch frames 3"]:
        """Origins of the laparoscope arm's DH frames in `base`, its base first and its tool last, mm.

        Raises:
            ShapeError: another number of joints, another dtype, or no such arm.
        """
        if self._laparoscope is None:
            raise ShapeError(where="laparoscope readings", expected="an arm", found="a camera on no arm")
        self._laparoscope.check(joints)
        frames = self._laparoscope.frames_in_base(joints)
        return torch.cat((frames[..., :3, 3], self.base_T_arm(joints)[..., None, :3, 3]), dim=-2)

    def instrument_points(self, joints: Float[Tensor, "*batch j"]) -> Float[Tensor, "*batch frames 3"]:
        """Origins of the instrument arm's DH frames in `base`, its base first, mm.

        Raises:
            ShapeError: another number of joints, or another dtype.
        """
        self._instrument.check(joints)
        return self._instrument.frames_in_base(joints)[..., :3, 3]

    def rcm_distance_mm(self) -> float | None:
        """How far the two arms' remote centres of motion are apart; None where the laparoscope's arm has none, or
        nobody states where the arms' bases are.

        The laparoscope's is the point that the axis of one of its joints passes through, whatever the joints read.
        """
        if self._laparoscope is None or not self.setup_is_stated:
            return None
        frames = self._laparoscope.frames_in_base(self._laparoscope.spread_readings(_PIVOT_SAMPLES))
        pivots = [_common_point(frame[:, :3, 3], frame[:, :3, 2]) for frame in frames.unbind(1)]
        pivot, miss = min(pivots, key=lambda found: found[1])
        if miss > _PIVOT_MISS_MM:
            return None
        rest = self._instrument.spread_readings(1)[0]
        return float((self.instrument(rest).base_T_rcm[:3, 3] - pivot).norm())

    def _check_shaft_meets_rcm(self, where: str) -> None:
        # Two poses far apart: a wrong frame can agree at one of them.
        count = len(self.instrument_joints)
        readings = torch.stack([torch.zeros(count), torch.full((count,), 0.5)]).to(self._device, self._dtype)
        frames = self._instrument.frames_in_base(readings)
        base_T_rcm, base_T_shaft = frames[:, self._rcm_frame], frames[:, self._shaft_frame]
        shaft_T_rcm = rigid_inverse(base_T_shaft) @ base_T_rcm
        miss = float(shaft_T_rcm[:, :2, 3].norm(dim=-1).max())
        if miss > _MAX_RCM_MISS_MM:
            expected = (
                f"the z axis of shaft_frame {self._shaft_frame} through the origin of rcm_frame {self._rcm_frame}"
            )
            raise RobotError(where=where, expected=expected, found=f"a distance of {miss:.1f} mm")


def _common_point(p: Float[Tensor, "n 3"], d: Float[Tensor, "n 3"]) -> tuple[Float[Tensor, "3"], float]:
    """The point nearest to lines through p along d, and the largest distance of one from it, mm; infinite where the
    lines are parallel, so that there is none.

    Source: sum (I - d d^T) (x - p) = 0.
    """
    across = torch.eye(3, dtype=d.dtype, device=d.device) - d[:, :, None] * d[:, None]
    if float(torch.linalg.eigvalsh(across.mean(0))[0]) < _LEAST_SPREAD:
        return p[0], math.inf
    x = torch.linalg.solve(across.sum(0), (across @ p[..., None]).sum(0))[:, 0]
    return x, float((across @ (x - p)[..., None])[..., 0].norm(dim=-1).max())


def _frame_number(number: int | None, arm: Arm, where: str) -> int:
    count = len(arm.joints)
    if number is None or not 0 <= number <= count:
        raise RobotError(where=where, expected=f"a frame number, 0 (the arm's base) to {count}", found=number)
    return number
