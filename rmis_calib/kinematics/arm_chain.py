"""One arm of a robot as a chain, with its constants as tensors."""

import torch
from jaxtyping import Float
from torch import Tensor

from rmis_calib.errors import RobotError, ShapeError
from rmis_calib.kinematics.dh import build_chain, frame_poses
from rmis_calib.kinematics.joint_twists import joint_twists
from rmis_calib.robot import Robot


class ArmChain:
    """Frames, and what each joint moves; readings as the robot's table orders them, rad or mm."""

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
        self._convention = robot.dh_convention

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

    def twists(self, joints: Float[Tensor, "*batch j"]) -> Float[Tensor, "*batch j 6"]:
        """Of each joint, in `base`."""
        return joint_twists(self.frames_in_base(joints), self._rows, self._convention)
