"""Forward kinematics of the shipped dVRK tables against thousands of poses that real arms recorded.

A row holds six joints and the pose of the tip, both from the arm's own controller. In 97 % of the rows the two belong
to the same tick of the controller. In the others the arm had moved by some encoder counts in between; the last test
shows that this, and not the kinematics, is the difference.
"""

from pathlib import Path

import numpy as np
import pytest
import torch
from scipy.spatial.transform import Rotation
from torch import Tensor

from rmis_calib.io.robot import load_robot
from rmis_calib.kinematics import build_chain, frame_poses

MICROMETRE = 1e-3  # in mm
# File, preset, rows, rows whose joints and pose are from different ticks (counted here, so that it cannot grow).
LOGS = [("classic_tool_fixed.csv", "dvrk-classic", 4506, 138), ("Si_tool_fixed.csv", "dvrk-classic-si-tool", 4473, 145)]
# The dVRK's tip frame of wristed instruments: frame 6 with its axes renamed.
TIP_R = torch.tensor([[0.0, -1.0, 0.0], [0.0, 0.0, 1.0], [-1.0, 0.0, 0.0]], dtype=torch.float64)
# Encoder counts of the arm's joints, rad, rad and mm, as they show in the steps between rows of the logs.
COUNT = torch.tensor([7.72e-6, 7.72e-6, 1.297e-3], dtype=torch.float64)


def load(path: Path) -> tuple[Tensor, Tensor, Tensor]:
    """Joints (rad, mm), tip position (mm) and rotation."""
    rows = np.loadtxt(path, delimiter=",", skiprows=1)
    joints = rows[:, 1:7].copy()
    joints[:, 2] *= 1000
    R = Rotation.from_rotvec(rows[:, 10:13]).as_matrix()
    return torch.from_numpy(joints), torch.from_numpy(1000 * rows[:, 7:10]), torch.from_numpy(R)


def tip(preset: str, joints: Tensor) -> tuple[Tensor, Tensor]:
    """Tip position and rotation in the arm's base, all rows in one call."""
    robot = load_robot(preset)
    table = robot.arms["instrument"].joints
    offsets = torch.tensor([row.offset for row in table], dtype=torch.float64)
    base_T_end = frame_poses(build_chain(table, robot.dh_convention, torch.float64), joints + offsets)[..., -1, :, :]
    return base_T_end[..., :3, 3], base_T_end[..., :3, :3] @ TIP_R


def rotation_difference(R_a: Tensor, R_b: Tensor) -> Tensor:
    return torch.from_numpy(Rotation.from_matrix((R_a @ R_b.mT).detach().numpy()).as_rotvec())


@pytest.mark.parametrize(("log", "preset", "count", "moved"), LOGS)
def test_recorded_poses_are_reproduced(shared_data: Path, log: str, preset: str, count: int, moved: int) -> None:
    joints, position, R = load(shared_data / "dvrk" / log)
    assert len(joints) == count
    predicted, predicted_R = tip(preset, joints)
    error = (predicted - position).norm(dim=-1)
    same_tick = error < MICROMETRE
    assert count - int(same_tick.sum()) == moved
    # Rows of one tick agree to the digits that the log was written with, not merely to a micrometre.
    assert float(error[same_tick].quantile(0.99)) < 1e-9
    assert float(error.median()) < 1e-12
    # The rotation agrees in the same rows. 1e-6 rad: for rows a fraction of a count apart.
    assert float(rotation_difference(predicted_R, R).norm(dim=-1)[error < 1e-9].max()) < 1e-12
    # The rest are less than 0.08 mm off: an arm that moves at some mm/s, a millisecond or so later.
    assert float(error.max()) < 0.08


@pytest.mark.parametrize(("log", "preset", "count", "moved"), LOGS)
def test_rows_that_differ_are_whole_encoder_counts_apart(
    shared_data: Path, log: str, preset: str, count: int, moved: int
) -> None:
    joints, position, R = load(shared_data / "dvrk" / log)
    moving = (tip(preset, joints)[0] - position).norm(dim=-1) > MICROMETRE
    joints, position, R = joints[moving], position[moving], R[moving]
    at_tick = joints.clone()
    for _ in range(3):  # Newton: which joints have exactly the recorded pose?
        predicted, predicted_R = tip(preset, at_tick)
        twist = torch.cat([position - predicted, rotation_difference(R, predicted_R)], dim=-1)
        at_tick = at_tick + torch.linalg.solve(jacobian(preset, at_tick), twist[..., None])[..., 0]
    assert float((tip(preset, at_tick)[0] - position).norm(dim=-1).max()) < 1e-9
    counts = (at_tick - joints)[:, :3] / COUNT
    # Up to 50 counts apart, and each time a whole number of them: no fit of wrong kinematics would do that.
    assert float(counts.abs().max()) < 60
    assert float((counts - counts.round()).abs().quantile(0.95)) < 0.05


def test_wrong_arm_file_is_50_8_mm_off(shared_data: Path) -> None:
    # An S/Si instrument on a classic arm is not an Si arm: the tables differ by the shaft's 50.8 mm.
    joints, position, _ = load(shared_data / "dvrk" / "Si_tool_fixed.csv")
    error = (tip("dvrk-si", joints)[0] - position).norm(dim=-1)
    torch.testing.assert_close(error, torch.full_like(error, 50.8), rtol=0, atol=0.1)


def jacobian(preset: str, joints: Tensor) -> Tensor:
    """Twist of the tip (mm, rad) a change of each joint, (rows, 6, 6), by autograd."""
    joints = joints.clone().requires_grad_()
    position, R = tip(preset, joints)
    R_fixed = R.detach()
    spin = R @ R_fixed.mT  # the identity, with the derivative of the rotation
    twist = [*position.unbind(-1), spin[:, 2, 1], spin[:, 0, 2], spin[:, 1, 0]]
    rows = [torch.autograd.grad(entry.sum(), joints, retain_graph=True)[0] for entry in twist]
    return torch.stack(rows, dim=-2)
