"""Joint readings of both arms to the transforms that the calibration needs."""

import math
from dataclasses import dataclass

import torch
from jaxtyping import Float
from torch import Tensor

from rmis_calib.errors import RobotError, ShapeError
from rmis_calib.geometry.rigid import rigid_inverse, transform_points
from rmis_calib.kinematics.dh import build_chain, frame_poses
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
        """1 sigma per axis (mm, rad) of the set-up that the robot states; None where it is exact, or none is stated."""
        if self.setup_is_stated and robot.setup_sigma_mm is not None and robot.setup_sigma_rad is not None:
            self.setup_sigma = (robot.setup_sigma_mm, robot.setup_sigma_rad)
        self._laparoscope = None
        if laparoscope_arm is not None:
            self._laparoscope = _Arm(robot, laparoscope_arm, dtype, device, self.setup_is_stated)
        self._instrument = _Arm(robot, instrument_arm, dtype, device, self.setup_is_stated)
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
        before_wrist = torch.arange(joints.shape[-1], device=joints.device) < self._shaft_frame
        straight = torch.where(before_wrist, joints, 0.0)
        both = self._instrument.frames_in_base(torch.stack([joints, straight]))
        base_T_rcm = both[0, ..., self._rcm_frame, :, :]
        rcm_T_base = rigid_inverse(base_T_rcm)
        rcm_T_shaft = rcm_T_base @ both[0, ..., self._shaft_frame, :, :]
        rcm_v_axis = self._towards_tip * rcm_T_shaft[..., :3, 2]
        base_T_head = both[..., self._head_frame, :, :]
        rcm_p_head, rcm_p_straight = transform_points(rcm_T_base @ base_T_head, self._head_p_point).unbind(0)
        return InstrumentPose(base_T_rcm, rcm_v_axis, rcm_p_head, (rcm_v_axis * rcm_p_straight).sum(-1))

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


class _Arm:
    """Chain of one arm with its constants as tensors."""

    def __init__(
        self, robot: Robot, name: str, dtype: torch.dtype, device: torch.device | str, base_is_stated: bool = True
    ) -> None:
        if name not in robot.arms:
            raise RobotError(where=f"robot {robot.name}", expected=f"an arm {name!r}", found=", ".join(robot.arms))
        table = robot.arms[name]

        def constant(value: object) -> Tensor:
            return torch.as_tensor(value, dtype=dtype, device=device)

        self.names = tuple(row.name for row in table.joints)
        self._rows = table.joints
        self.end_T_tool = constant(table.end_T_tool)
        self.base_T_arm_base = constant(table.base_T_arm_base) if base_is_stated else constant(torch.eye(4))
        self._offsets = constant([float(row.offset) for row in table.joints])
        self._chain = build_chain(table.joints, robot.dh_convention, dtype, device)

    def check(self, joints: Tensor) -> None:
        """Raise ShapeError unless these are readings of this arm, in its precision."""
        if joints.shape[-1:] != (len(self.names),) or joints.dtype != self._offsets.dtype:
            expected = f"(..., {len(self.names)}) of {self._offsets.dtype}: {', '.join(self.names)}"
            found = f"{tuple(joints.shape)} of {joints.dtype}"
            raise ShapeError(where="joint readings", expected=expected, found=found)

    def spread_readings(self, count: int) -> Float[Tensor, "n j"]:
        """Readings spread over the joints' limits; without limits half a radian, and 100 mm beside what `d` and the
        offset take back."""
        part = torch.linspace(0.1, 0.9, count, dtype=self._offsets.dtype, device=self._offsets.device)
        columns = []
        for i, row in enumerate(self._rows):
            low, high = row.min, row.max
            if low is None or high is None:
                low, high = (-0.5, 0.5) if row.type == "revolute" else (50.0 - row.offset, 150.0 - row.offset)
            # Each joint at its own rhythm: a straight line through joint space would leave the axes in one plane.
            at = ((i + 1) * part * 1.618) % 1.0 if count > 1 else torch.full_like(part, 0.5)
            columns.append(low + (high - low) * at)
        return torch.stack(columns, dim=-1)

    def frames_in_base(self, joints: Float[Tensor, "*batch j"]) -> Float[Tensor, "*batch frames 4 4"]:
        return self.base_T_arm_base @ frame_poses(self._chain, joints + self._offsets)


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
