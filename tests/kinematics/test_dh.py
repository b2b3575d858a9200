"""DH tables as chains, against matrices derived by hand in NumPy."""

from dataclasses import replace

import numpy as np
import pytest
import torch
from torch.autograd import gradcheck, gradgradcheck

from rmis_calib.errors import RobotError, ShapeError
from rmis_calib.kinematics import build_chain, dh_matrix, frame_poses
from rmis_calib.robot import Joint

# Every entry differs from zero, so that no factor of the product can be left out or put in the wrong place unseen.
TABLE = [
    Joint("one", "revolute", 0.3, 11.0, -0.7, 5.0, 0.0),
    Joint("two", "prismatic", -1.1, -3.0, 0.4, 40.0, 0.0),
    Joint("three", "revolute", 0.8, 7.0, 1.9, -6.0, 0.0),
    Joint("four", "revolute", -0.2, 0.5, 0.1, 2.0, 0.0),
]
READINGS = [0.25, -12.0, 1.4, -0.6]


def turn(axis: str, angle: float) -> np.ndarray:
    c, s = np.cos(angle), np.sin(angle)
    T = np.eye(4)
    T[:3, :3] = {"x": [[1, 0, 0], [0, c, -s], [0, s, c]], "z": [[c, -s, 0], [s, c, 0], [0, 0, 1]]}[axis]
    return T


def shift(axis: str, length: float) -> np.ndarray:
    T = np.eye(4)
    T["xyz".index(axis), 3] = length
    return T


def by_hand(table: list[Joint], readings: list[float], convention: str) -> np.ndarray:
    """Poses of frame 0 to frame J, one elementary matrix after the other."""
    frames = [np.eye(4)]
    for row, q in zip(table, readings, strict=True):
        theta = row.theta_rad + (q if row.type == "revolute" else 0.0)
        d = row.d_mm + (q if row.type == "prismatic" else 0.0)
        twist = turn("x", row.alpha_rad) @ shift("x", row.a_mm)
        screw = turn("z", theta) @ shift("z", d)
        frames.append(frames[-1] @ (twist @ screw if convention == "modified" else screw @ twist))
    return np.stack(frames)


@pytest.mark.parametrize("convention", ["modified", "standard"])
def test_chain_is_the_product_of_elementary_matrices(convention: str) -> None:
    chain = build_chain(TABLE, convention, torch.float64)
    poses = frame_poses(chain, torch.tensor(READINGS, dtype=torch.float64))
    torch.testing.assert_close(poses, torch.from_numpy(by_hand(TABLE, READINGS, convention)), rtol=0, atol=1e-13)


@pytest.mark.parametrize("convention", ["modified", "standard"])
def test_convention_the_two_tables_are_not_the_same(convention: str) -> None:
    # Counter-literal: the same numbers read the other way miss by centimetres.
    other = {"modified": "standard", "standard": "modified"}[convention]
    poses = frame_poses(build_chain(TABLE, convention, torch.float64), torch.tensor(READINGS, dtype=torch.float64))
    assert np.linalg.norm(poses[-1, :3, 3].numpy() - by_hand(TABLE, READINGS, other)[-1, :3, 3]) > 10.0


@pytest.mark.parametrize("convention", ["modified", "standard"])
def test_dh_matrix_of_one_row(convention: str) -> None:
    row = TABLE[0]
    values = [torch.tensor(v, dtype=torch.float64) for v in (row.alpha_rad, row.a_mm, row.theta_rad, row.d_mm)]
    expected = by_hand([row], [0.0], convention)[1]
    torch.testing.assert_close(dh_matrix(*values, convention), torch.from_numpy(expected), rtol=0, atol=1e-14)


def test_dh_matrix_broadcasts() -> None:
    zero = torch.zeros((), dtype=torch.float64)
    assert dh_matrix(zero, zero, torch.zeros(5, 1, dtype=torch.float64), zero, "modified").shape == (5, 1, 4, 4)


@pytest.mark.parametrize("convention", ["modified", "standard"])
@pytest.mark.parametrize("batch", [(), (1,), (3, 1, 2), (0,)])
def test_batched_equals_looped(convention: str, batch: tuple[int, ...]) -> None:
    joints = torch.randn(*batch, 4, generator=torch.Generator().manual_seed(0), dtype=torch.float64)
    poses = frame_poses(build_chain(TABLE, convention, torch.float64), joints)
    assert poses.shape == (*batch, 5, 4, 4)
    for pose, q in zip(poses.reshape(-1, 5, 4, 4), joints.reshape(-1, 4), strict=True):
        torch.testing.assert_close(pose, torch.from_numpy(by_hand(TABLE, q.tolist(), convention)), rtol=0, atol=1e-13)


@pytest.mark.parametrize("convention", ["modified", "standard"])
def test_gradients_with_respect_to_the_readings(convention: str) -> None:
    chain = build_chain(TABLE, convention, torch.float64)
    joints = torch.tensor([READINGS, [0.0] * 4], dtype=torch.float64, requires_grad=True)
    assert gradcheck(lambda q: frame_poses(chain, q), (joints,))
    # The library's analytic backward pass, which is on by default there, fails this one.
    assert gradgradcheck(lambda q: frame_poses(chain, q), (joints,))


def test_single_precision_is_the_rounded_chain() -> None:
    chain = build_chain(TABLE, "modified", torch.float32)
    poses = frame_poses(chain, torch.tensor(READINGS))
    assert poses.dtype == torch.float32
    exact = by_hand(TABLE, READINGS, "modified")
    assert np.abs(poses.numpy() - exact).max() < 1e-5  # 60 mm in float32: 4e-6 a rounding


@pytest.mark.parametrize("convention", ["modified", "standard"])
def test_everything_moves_to_the_device(convention: str) -> None:
    # "meta" refuses to meet CPU tensors as a GPU would, and is present everywhere.
    chain = build_chain(TABLE, convention, torch.float64, "meta")
    poses = frame_poses(chain, torch.zeros(2, 4, dtype=torch.float64, device="meta"))
    assert poses.device.type == "meta" and poses.shape == (2, 5, 4, 4)


def test_precision_is_never_mixed_silently() -> None:
    chain = build_chain(TABLE, "modified", torch.float64)
    with pytest.raises(ShapeError, match=r"expected \(..., 4\) of torch.float64, found \(4,\) of torch.float32"):
        frame_poses(chain, torch.zeros(4))
    with pytest.raises(ShapeError, match=r"found \(2, 3\)"):
        frame_poses(chain, torch.zeros(2, 3, dtype=torch.float64))


def test_impossible_tables_are_refused() -> None:
    with pytest.raises(RobotError, match="modified or standard"):
        build_chain(TABLE, "craig", torch.float64)
    fixed = replace(TABLE[0])
    object.__setattr__(fixed, "type", "fixed")  # what a type checker would have refused
    with pytest.raises(RobotError, match="joint one: expected type revolute or prismatic, found 'fixed'"):
        build_chain([fixed], "modified", torch.float64)
    with pytest.raises(RobotError, match="at least one joint"):
        build_chain([], "modified", torch.float64)
