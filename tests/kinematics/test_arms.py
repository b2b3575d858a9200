"""Both arms together: `RobotKinematics` for tables that can be worked out by hand, and for the shipped ones."""

import math
from dataclasses import replace

import pytest
import torch
from torch.autograd import gradcheck

from rmis_calib.errors import RobotError, ShapeError
from rmis_calib.geometry import rigid_inverse, transform_points
from rmis_calib.io.robot import load_robot
from rmis_calib.kinematics import RobotKinematics
from rmis_calib.robot import Arm, HeadPoint, Robot

PRESETS = ["dvrk-classic", "dvrk-classic-si-tool", "dvrk-si", "rcm-3x3"]


def tensor(*values: float) -> torch.Tensor:
    return torch.tensor(values, dtype=torch.float64)


def with_instrument(robot: Robot, **changes) -> Robot:
    arm: Arm = replace(robot.arms["instrument"], **changes)
    return replace(robot, arms={**robot.arms, "instrument": arm})


@pytest.fixture(scope="module")
def rcm_3x3() -> RobotKinematics:
    return RobotKinematics(load_robot("rcm-3x3"), "laparoscope", "instrument")


def test_rcm_3x3_is_the_scene_that_its_comments_promise(rcm_3x3: RobotKinematics) -> None:
    base_T_arm = rcm_3x3.base_T_arm(tensor(0.0, 0.0, 80.0))
    # At zero angles `arm` has the axes of base, 80 mm ahead of the RCM.
    expected = torch.eye(4, dtype=torch.float64)
    expected[2, 3] = 80.0
    torch.testing.assert_close(base_T_arm, expected, rtol=0, atol=1e-13)
    camera_p_arm = tensor(0.0, 0.0, -40.0)
    pose = rcm_3x3.instrument(tensor(0.0, 0.0, math.sqrt(90**2 + 40**2 + 80**2)))
    arm_T_rcm = rigid_inverse(base_T_arm) @ pose.base_T_rcm
    torch.testing.assert_close(arm_T_rcm[:3, 3] + camera_p_arm, tensor(90.0, -40.0, 20.0), rtol=0, atol=1e-12)
    arm_p_head = transform_points(arm_T_rcm, pose.rcm_p_head)
    torch.testing.assert_close(arm_p_head + camera_p_arm, tensor(0.0, 0.0, 100.0), rtol=0, atol=1e-12)


def test_rcm_3x3_signs_of_yaw_and_pitch(rcm_3x3: RobotKinematics) -> None:
    # Yaw about y takes the forward axis to the right (+x), pitch about x takes it up (-y).
    yawed = rcm_3x3.base_T_arm(tensor(math.pi / 6, 0.0, 100.0))
    torch.testing.assert_close(yawed[:3, 3], tensor(50.0, 0.0, 50 * math.sqrt(3)), rtol=0, atol=1e-12)
    pitched = rcm_3x3.base_T_arm(tensor(0.0, math.pi / 6, 100.0))
    torch.testing.assert_close(pitched[:3, 3], tensor(0.0, -50.0, 50 * math.sqrt(3)), rtol=0, atol=1e-12)


@pytest.mark.parametrize("name", PRESETS)
def test_shaft_axis_passes_through_the_rcm_towards_the_tip(name: str) -> None:
    kinematics = RobotKinematics(load_robot(name), "laparoscope", "instrument")
    count = len(kinematics.instrument_joints)
    joints = 0.5 * torch.randn(200, count, generator=torch.Generator().manual_seed(1), dtype=torch.float64)
    joints[:, 2] = 150.0 + 20 * joints[:, 2]
    pose = kinematics.instrument(joints)
    torch.testing.assert_close(pose.rcm_v_axis.norm(dim=-1), torch.ones(200, dtype=torch.float64))
    # The RCM does not move, and insertion moves the head along the axis, away from it, by as much as it says.
    torch.testing.assert_close(pose.base_T_rcm, pose.base_T_rcm[:1].expand_as(pose.base_T_rcm))
    deeper = kinematics.instrument(joints + tensor(0.0, 0.0, 7.0, *[0.0] * (count - 3)))
    torch.testing.assert_close(deeper.rcm_p_head - pose.rcm_p_head, 7.0 * pose.rcm_v_axis, rtol=0, atol=1e-10)
    torch.testing.assert_close(deeper.rcm_s_end_mm - pose.rcm_s_end_mm, torch.full((200,), 7.0, dtype=torch.float64))


def test_dvrk_lengths_at_zero_angles() -> None:
    # By hand: insertion 100 - 431.8 to frame 3, 416.2 along the shaft to the wrist, 9.1 from wrist pitch to wrist yaw.
    pose = RobotKinematics(load_robot("dvrk-classic"), None, "instrument").instrument(tensor(0, 0, 100, 0, 0, 0))
    assert float(pose.rcm_s_end_mm) == pytest.approx(100 - 431.8 + 416.2 + 9.1, abs=1e-6)
    # The instrument hangs down from its base, -z. Tilted by the 1.5708 of the offsets, which is pi/2 + 3.7e-6.
    torch.testing.assert_close(pose.rcm_v_axis, tensor(0.0, 0.0, -1.0), rtol=0, atol=1e-5)


def test_shaft_end_does_not_depend_on_the_wrist() -> None:
    kinematics = RobotKinematics(load_robot("dvrk-classic"), None, "instrument")
    bent = kinematics.instrument(tensor(0.1, 0.2, 100, 0.7, 0.9, -0.8))
    straight = kinematics.instrument(tensor(0.1, 0.2, 100, 0.0, 0.0, 0.0))
    torch.testing.assert_close(bent.rcm_s_end_mm, straight.rcm_s_end_mm)
    torch.testing.assert_close(bent.rcm_v_axis, straight.rcm_v_axis)
    assert float((bent.rcm_p_head - straight.rcm_p_head).norm()) > 5.0


@pytest.mark.parametrize("name", PRESETS)
def test_laparoscope_turns_about_its_rcm(name: str) -> None:
    kinematics = RobotKinematics(load_robot(name), "laparoscope", "instrument")
    joints = 0.5 * torch.randn(50, len(kinematics.laparoscope_joints), dtype=torch.float64)
    joints[:, 2] = 100.0
    base_T_arm = kinematics.base_T_arm(joints)
    distance = base_T_arm[:, :3, 3].norm(dim=-1)  # the RCM is the origin of base in these presets
    torch.testing.assert_close(distance, distance[:1].expand(50))
    # The arm's z axis is the scope's axis: it passes through the RCM.
    along = (base_T_arm[:, :3, 2] * base_T_arm[:, :3, 3]).sum(-1).abs()
    torch.testing.assert_close(along, distance)


def test_camera_that_stands_still() -> None:
    kinematics = RobotKinematics(load_robot("dvrk-classic"), None, "instrument")
    assert kinematics.laparoscope_joints == ()
    base_T_arm = kinematics.base_T_arm(torch.zeros(5, 2, 0, dtype=torch.float64))
    torch.testing.assert_close(base_T_arm, torch.eye(4, dtype=torch.float64).expand(5, 2, 4, 4))
    with pytest.raises(ShapeError, match="no arm"):
        kinematics.base_T_arm(torch.zeros(5, 4, dtype=torch.float64))


@pytest.mark.parametrize("batch", [(), (1,), (3, 1, 2)])
@pytest.mark.parametrize("dtype", [torch.float32, torch.float64])
def test_any_batch_and_precision(batch: tuple[int, ...], dtype: torch.dtype) -> None:
    kinematics = RobotKinematics(load_robot("dvrk-si"), "laparoscope", "instrument", dtype)
    pose = kinematics.instrument(torch.zeros(*batch, 6, dtype=dtype))
    assert pose.base_T_rcm.shape == (*batch, 4, 4) and pose.rcm_s_end_mm.shape == batch
    assert pose.rcm_v_axis.shape == pose.rcm_p_head.shape == (*batch, 3)
    assert kinematics.base_T_arm(torch.zeros(*batch, 4, dtype=dtype)).shape == (*batch, 4, 4)
    assert {value.dtype for value in vars(pose).values()} == {dtype}


@pytest.mark.skipif(not torch.cuda.is_available(), reason="no CUDA device")
def test_same_answers_on_a_gpu() -> None:
    robot = load_robot("dvrk-classic")
    joints = torch.randn(5, 6, generator=torch.Generator().manual_seed(0), dtype=torch.float64)
    here = RobotKinematics(robot, "laparoscope", "instrument")
    there = RobotKinematics(robot, "laparoscope", "instrument", device="cuda")
    for name, value in vars(there.instrument(joints.cuda())).items():
        torch.testing.assert_close(value.cpu(), getattr(here.instrument(joints), name))
    torch.testing.assert_close(there.base_T_arm(joints[:, :4].cuda()).cpu(), here.base_T_arm(joints[:, :4]))


def test_gradients_flow_to_joint_offsets() -> None:
    kinematics = RobotKinematics(load_robot("dvrk-classic"), "laparoscope", "instrument")
    readings = torch.randn(3, 6, generator=torch.Generator().manual_seed(0), dtype=torch.float64)
    offsets = torch.zeros(6, dtype=torch.float64, requires_grad=True)

    def instrument(offsets: torch.Tensor) -> tuple[torch.Tensor, ...]:
        pose = kinematics.instrument(readings + offsets)
        return pose.rcm_v_axis, pose.rcm_p_head, pose.rcm_s_end_mm

    assert gradcheck(instrument, (offsets,))
    scope = torch.zeros(4, dtype=torch.float64, requires_grad=True)
    assert gradcheck(lambda o: kinematics.base_T_arm(readings[:, :4] + o), (scope,))


def test_joint_offset_of_the_table_is_added_to_the_reading() -> None:
    robot = load_robot("rcm-3x3")
    joints = robot.arms["instrument"].joints
    shifted = with_instrument(robot, joints=(replace(joints[0], offset=0.1), joints[1], replace(joints[2], offset=5.0)))
    with_offset = RobotKinematics(shifted, None, "instrument").instrument(tensor(0.2, 0.3, 100.0))
    without = RobotKinematics(robot, None, "instrument").instrument(tensor(0.3, 0.3, 105.0))
    torch.testing.assert_close(with_offset.rcm_p_head, without.rcm_p_head)


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"rcm_frame": 7}, "rcm_frame: expected a frame number, 0 .the arm's base. to 6, found 7"),
        ({"shaft_frame": None}, "shaft_frame: expected a frame number"),
        ({"head_point": None}, "expected a head_point"),
        ({"head_point": HeadPoint(-1, (0.0, 0.0, 0.0))}, "head_point.frame"),
        (
            {"shaft_frame": 6},
            "expected the z axis of shaft_frame 6 through the origin of rcm_frame 0, found a distance",
        ),
        ({"rcm_frame": 6}, "through the origin of rcm_frame 6"),
    ],
)
def test_wrong_frames_are_refused(changes: dict, message: str) -> None:
    robot = with_instrument(load_robot("dvrk-classic"), **changes)
    with pytest.raises(RobotError, match=message):
        RobotKinematics(robot, None, "instrument")


def test_missing_arms_and_wrong_readings_are_refused() -> None:
    robot = load_robot("rcm-3x3")
    with pytest.raises(RobotError, match="expected an arm 'psm', found laparoscope, instrument"):
        RobotKinematics(robot, None, "psm")
    kinematics = RobotKinematics(robot, "laparoscope", "instrument")
    with pytest.raises(ShapeError, match=r"of torch.float64: yaw, pitch, insertion, found \(4,\) of torch.float64"):
        kinematics.instrument(torch.zeros(4, dtype=torch.float64))
    with pytest.raises(ShapeError, match=r"found \(3,\) of torch.float32"):
        kinematics.base_T_arm(torch.zeros(3))
