"""The geometric Jacobian against autograd of the kinematics themselves."""

from dataclasses import replace

import pytest
import torch
from torch import Tensor

from rmis_calib.geometry import rigid_inverse
from rmis_calib.io.robot import load_robot
from rmis_calib.kinematics import RobotKinematics
from rmis_calib.kinematics.joint_twists import joint_twists, velocity_of
from rmis_calib.robot import Joint, Robot


def displacement_by_autograd(kinematics: RobotKinematics, readings: Tensor) -> Tensor:
    """(n, 6, j) from the derivatives of arm_T_rcm, v and s_end."""
    split = len(kinematics.laparoscope_joints)

    def seen(q: Tensor) -> tuple[Tensor, Tensor, Tensor]:
        pose = kinematics.instrument(q[..., split:])
        arm_T_rcm = rigid_inverse(kinematics.base_T_arm(q[..., :split])) @ pose.base_T_rcm
        return arm_T_rcm, pose.rcm_v_axis, pose.rcm_s_end_mm

    columns = []
    for q in readings:
        arm_T_rcm, v, _ = seen(q)
        dT, dv, ds = torch.func.jacrev(seen)(q)
        relative = torch.einsum("ki,kjq->ijq", arm_T_rcm[:3, :3], dT[:3])  # R^T dT, in `rcm`
        omega = torch.stack((relative[2, 1], relative[0, 2], relative[1, 0]))
        omega = omega + torch.linalg.cross(v[:, None].expand_as(dv), dv, dim=0)
        columns.append(torch.cat((omega, relative[:, 3] + v[:, None] * ds)))
    return torch.stack(columns)


def robots() -> list[Robot]:
    presets = [load_robot(name) for name in ("dvrk-classic", "dvrk-classic-si-tool", "dvrk-si", "rcm-3x3", "raven-ii")]
    arm = presets[0].arms["instrument"]
    joints = len(arm.joints)
    early_head = replace(arm, head_point=replace(arm.head_point, frame=min(4, joints)))
    return [*presets, replace(presets[0], arms=presets[0].arms | {"instrument": early_head})]


@pytest.mark.parametrize("camera_moves", [True, False])
@pytest.mark.parametrize("number", range(6))
def test_displacements_are_those_of_the_kinematics(number: int, camera_moves: bool) -> None:
    robot = robots()[number]
    camera_arm, arm = ("laparoscope", "instrument") if "instrument" in robot.arms else ("gold", "green")
    kinematics = RobotKinematics(robot, camera_arm if camera_moves else None, arm)
    split = len(kinematics.laparoscope_joints)
    generator = torch.Generator().manual_seed(number)
    size = (5, split + len(kinematics.instrument_joints))
    readings = 0.6 * torch.randn(size, generator=generator, dtype=torch.float64)
    found = kinematics.shaft_displacements(readings[:, :split], readings[:, split:])
    expected = displacement_by_autograd(kinematics, readings)
    torch.testing.assert_close(found, expected, rtol=0, atol=1e-11 * float(expected.abs().max()))


@pytest.mark.parametrize("convention", ["modified", "standard"])
def test_a_joint_moves_what_lies_beyond_it(convention: str) -> None:
    # A single joint whose own frame is the base (alpha, a, theta and d are zero): both conventions agree.
    base_T_frame = torch.eye(4, dtype=torch.float64).repeat(2, 1, 1)
    p = torch.tensor([3.0, 4.0, 5.0], dtype=torch.float64)
    for kind, expected in (("revolute", [-4.0, 3.0, 0.0]), ("prismatic", [0.0, 0.0, 1.0])):
        twist = joint_twists(base_T_frame, [Joint("one", kind, 0.0, 0.0, 0.0, 0.0, 0.0)], convention)
        assert velocity_of(p, twist)[0].tolist() == expected
