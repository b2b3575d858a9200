"""What must not change the answer: order, unit, frames; and what the answer's derivatives are."""

import numpy as np
import pytest
import torch
from scenes import METHODS, RCM_IN_BASE, Scene, noisy, pose, scene
from scipy.spatial.transform import Rotation

from rmis_calib.baselines import hand_eye

NOISE = {"camera": (0.004, 0.5), "robot": (0.002, 0.2)}
DATA = noisy(scene(1, 9), 2, **NOISE)
SHIFT = pose(Rotation.from_rotvec([0.7, -1.1, 0.4]), np.array([120.0, -40.0, 75.0]))
TURN = pose(Rotation.from_rotvec([0.7, -1.1, 0.4]), np.zeros(3))


def solve(data: Scene, method: str, **options) -> np.ndarray:
    return data.solve(method, covariance=False, **options).flange_T_camera.numpy()


@pytest.mark.parametrize("method", METHODS)
def test_order_of_the_samples(method: str) -> None:
    order = np.random.default_rng(0).permutation(9)
    shuffled = Scene(DATA.base_T_flange[order], DATA.camera_T_board[order], DATA.flange_T_camera, DATA.base_T_board)
    np.testing.assert_allclose(solve(shuffled, method), solve(DATA, method), atol=1e-7 if method == "rcm" else 1e-9)


@pytest.mark.parametrize("method", METHODS)
def test_unit_of_length(method: str) -> None:
    scale = np.ones((4, 4))
    scale[:3, 3] = 1e-3
    metres = Scene(*(values * scale for values in vars(DATA).values()))
    extra = {name: point * 1e-3 for name, point in DATA.inputs(method).items()}
    found = hand_eye(metres.base_T_flange, metres.camera_T_board, method, covariance=False, **extra).flange_T_camera
    tolerance = 1e-6 if method == "rcm" else 1e-9
    np.testing.assert_allclose(found.numpy() / scale, solve(DATA, method), atol=tolerance)


@pytest.mark.parametrize("method", METHODS)
def test_frame_of_the_base(method: str) -> None:
    # Left multiplication: the base is somewhere else. Nothing that the camera or the flange knows changes.
    data = Scene(SHIFT @ DATA.base_T_flange, DATA.camera_T_board, DATA.flange_T_camera, SHIFT @ DATA.base_T_board)
    extra = {"base_p_rcm": SHIFT[:3, :3] @ RCM_IN_BASE + SHIFT[:3, 3]} if method == "rcm" else {}
    extra = DATA.inputs(method) | extra
    found = hand_eye(data.base_T_flange, data.camera_T_board, method, covariance=False, **extra)
    tolerance = 1e-7 if method == "rcm" else 1e-9
    np.testing.assert_allclose(found.flange_T_camera.numpy(), solve(DATA, method), atol=tolerance)


@pytest.mark.parametrize("method", METHODS)
def test_frame_of_the_board(method: str) -> None:
    # Right multiplication. The noise model of `refine` is of the board's origin, so there the board is only turned.
    change = TURN if method == "refine" else SHIFT
    base_T_board = DATA.base_T_board @ change
    data = Scene(DATA.base_T_flange, DATA.camera_T_board @ change, DATA.flange_T_camera, base_T_board)
    tolerance = 1e-7 if method == "rcm" else 1e-9
    np.testing.assert_allclose(solve(data, method), solve(DATA, method), atol=tolerance)


@pytest.mark.parametrize("method", METHODS)
@pytest.mark.parametrize("side", ["flange", "camera", "board"])
def test_exact_data_in_any_frames(method: str, side: str) -> None:
    # With noise a method may prefer a flange or camera frame; without, the answer moves along with the frame.
    exact = scene(3, 9)
    inverse = np.linalg.inv(SHIFT)
    A, C, X, Z = vars(exact).values()
    if side == "flange":
        moved = Scene(A @ SHIFT, C, inverse @ X, Z)
    elif side == "camera":
        moved = Scene(A, inverse @ C, X @ SHIFT, Z)
    else:
        moved = Scene(A, C @ SHIFT, X, Z @ SHIFT)
    np.testing.assert_allclose(solve(moved, method), moved.flange_T_camera, atol=1e-9)


@pytest.mark.parametrize("method", METHODS)
def test_derivatives_are_those_of_finite_differences(method: str) -> None:
    data = noisy(scene(4, 6), 5, **NOISE)
    board = torch.from_numpy(data.camera_T_board).requires_grad_()
    extra = data.inputs(method)
    weights = torch.from_numpy(np.random.default_rng(0).normal(size=(4, 4)))

    def value(camera_T_board: torch.Tensor) -> torch.Tensor:
        found = hand_eye(data.base_T_flange, camera_T_board, method, covariance=False, **extra)
        return (weights * found.flange_T_camera)[:3].sum()

    (gradient,) = torch.autograd.grad(value(board), board)
    rng = np.random.default_rng(1)
    for _ in range(3):
        twist, shift = rng.normal(size=(6, 3)), rng.normal(size=(6, 3))
        step = 1e-7 if method == "rcm" else 1e-6  # sums of norms bend sharply near zero
        turned = [Rotation.from_rotvec(sign * step * twist).as_matrix() for sign in (1, -1)]
        ends = [data.camera_T_board.copy() for _ in turned]
        for end, turn, sign in zip(ends, turned, (1, -1), strict=True):
            end[:, :3, :3] = turn @ end[:, :3, :3]
            end[:, :3, 3] += sign * step * shift
        # With derivatives asked for, a last Newton step takes the values beyond the iteration's tolerance.
        high, low = (float(value(torch.from_numpy(end).requires_grad_()).detach()) for end in ends)
        direction = torch.from_numpy((ends[0] - ends[1]) / (2 * step))
        expected = (high - low) / (2 * step)
        assert float((gradient * direction).sum()) == pytest.approx(expected, rel=2e-4, abs=2e-4)


def test_single_precision_is_solved_in_double() -> None:
    exact = scene(6, 8)
    found = hand_eye(torch.from_numpy(exact.base_T_flange).float(), torch.from_numpy(exact.camera_T_board).float())
    assert found.flange_T_camera.dtype == torch.float64
    np.testing.assert_allclose(found.flange_T_camera.numpy(), exact.flange_T_camera, atol=1e-3)
