"""Every method on exact data: the answer to 1e-9, in both set-ups, in stereo, for hard mountings."""

import numpy as np
import pytest
from scenes import METHODS, RCM_IN_BASE, pose, scene
from scipy.spatial.transform import Rotation

import rmis_calib as rc
from rmis_calib.errors import FrameMismatchError, InputError, InsufficientDataError, ShapeError

TOLERANCE = 1e-9  # rad and mm


@pytest.mark.parametrize("method", METHODS)
@pytest.mark.parametrize("angle", [1.5, 0.4, 0.1])
def test_exact_data_give_the_exact_answer(method: str, angle: float) -> None:
    truth = scene(1, 12, trials=(4,), angle=angle)
    found = truth.solve(method, covariance=False)
    assert found.ok.all()
    np.testing.assert_allclose(found.flange_T_camera.numpy(), truth.flange_T_camera, atol=TOLERANCE)
    np.testing.assert_allclose(found.base_T_board.numpy(), truth.base_T_board, atol=TOLERANCE)
    assert float(found.residual_deg.max()) < 1e-9 and float(found.residual_mm.max()) < 1e-9


@pytest.mark.parametrize("method", METHODS)
def test_three_poses_are_enough(method: str) -> None:
    truth = scene(5, 3, trials=(4,), angle=0.6)
    found = truth.solve(method, covariance=False)
    assert found.ok.all()
    np.testing.assert_allclose(found.flange_T_camera.numpy(), truth.flange_T_camera, atol=1e-8)


@pytest.mark.parametrize("method", METHODS)
@pytest.mark.parametrize(
    "turn", [[np.pi, 0, 0], [0, np.pi, 0], [0, 0, np.pi], [0, np.pi / np.sqrt(2), np.pi / np.sqrt(2)]]
)
def test_a_camera_mounted_upside_down(method: str, turn: list[float]) -> None:
    exact = scene(2, 10)
    X = pose(Rotation.from_rotvec(turn), np.array([5.0, -7.0, 30.0]))
    board = np.linalg.inv(exact.base_T_flange @ X) @ exact.base_T_board
    found = type(exact)(exact.base_T_flange, board, X, exact.base_T_board).solve(method, covariance=False)
    np.testing.assert_allclose(found.flange_T_camera.numpy(), X, atol=TOLERANCE)


@pytest.mark.parametrize("method", METHODS)
def test_motions_of_half_a_turn(method: str) -> None:
    # A relative rotation by exactly pi has two axes and two quaternions; robot and camera must take the same one.
    axes = np.eye(3)[[0, 1, 2, 0, 1, 2]] * np.array([np.pi, np.pi, np.pi, 0.3, 0.5, -0.4])[:, None]
    turns = np.concatenate([np.zeros((1, 3)), axes])
    truth = scene(3, len(turns), trials=(5,), turns=turns)
    found = truth.solve(method, covariance=False)
    assert found.ok.all()
    np.testing.assert_allclose(found.flange_T_camera.numpy(), truth.flange_T_camera, atol=TOLERANCE)


@pytest.mark.parametrize("method", [name for name in METHODS if name != "rcm"])
def test_eye_to_hand_by_name(method: str) -> None:
    truth = scene(4, 10)
    # The same numbers with the robot read the other way: base and flange change places.
    found = rc.baselines.hand_eye(
        np.linalg.inv(truth.base_T_flange), truth.camera_T_board, method, setup="eye_to_hand", covariance=False
    )
    np.testing.assert_allclose(found.base_T_camera.numpy(), truth.flange_T_camera, atol=TOLERANCE)
    np.testing.assert_allclose(found.flange_T_board.numpy(), truth.base_T_board, atol=TOLERANCE)
    with pytest.raises(FrameMismatchError, match="eye_to_hand: expected one of base_T_camera"):
        _ = found.flange_T_camera


def test_both_directions() -> None:
    truth = scene(4, 10)
    transforms = truth.solve("park").transforms()
    assert list(transforms) == ["flange_T_camera", "camera_T_flange", "base_T_board", "board_T_base"]
    inverse = np.linalg.inv(truth.flange_T_camera)
    np.testing.assert_allclose(transforms["camera_T_flange"].numpy(), inverse, atol=TOLERANCE)


@pytest.mark.parametrize("method", METHODS)
def test_stereo(method: str) -> None:
    truth = scene(6, 8, trials=(3,))
    camera_left_T_camera = pose(Rotation.from_rotvec([0.01, -0.02, 0.005]), np.array([5.0, 0.1, -0.2]))
    left = camera_left_T_camera @ truth.camera_T_board
    found = truth.solve(method, covariance=False, camera_left_T_board=left, camera_left_T_camera=camera_left_T_camera)
    np.testing.assert_allclose(found.flange_T_camera.numpy(), truth.flange_T_camera, atol=TOLERANCE)
    assert found.residual_mm.shape == (3, 16)  # the second camera's samples after the first one's


def test_shapes_follow_the_input() -> None:
    truth = scene(7, 6, trials=(2, 3))
    found = truth.solve("park")
    assert found.flange_T_camera.shape == (2, 3, 4, 4) and found.covariance.shape == (2, 3, 6, 6)
    assert found.status.shape == (2, 3) and found.residual_deg.shape == (2, 3, 6)
    assert len(found.sentences()) == 6
    one = scene(7, 6).solve("park", covariance=False)
    assert one.flange_T_camera.shape == (4, 4) and one.covariance is None and one.rotation_sigma_deg is None


def test_a_batch_is_its_trials_one_by_one() -> None:
    truth = scene(8, 7, trials=(3,))
    for method in METHODS:
        batch = truth.solve(method, covariance=False)
        for k in range(3):
            alone = type(truth)(*(values[k] for values in vars(truth).values())).solve(method, covariance=False)
            np.testing.assert_allclose(alone.flange_T_camera.numpy(), batch.flange_T_camera[k].numpy(), atol=1e-10)


def test_bad_input_is_named() -> None:
    truth = scene(9, 6)
    A, C = truth.base_T_flange, truth.camera_T_board
    mirrored = A * np.array([1.0, 1.0, -1.0, 1.0])
    gone = A.copy()
    gone[2, 0, 3] = np.nan
    cases = (
        (lambda: rc.baselines.hand_eye(A, C, "parc"), InputError, "expected one of tsai, park"),
        (lambda: rc.baselines.hand_eye(A, C, setup="in_hand"), InputError, "expected one of eye_in_hand"),
        (lambda: rc.baselines.hand_eye(A, C[:5]), ShapeError, "one shape"),
        (lambda: rc.baselines.hand_eye(A[:2], C[:2]), InsufficientDataError, "3 to 1000 poses .*, found 2"),
        (lambda: rc.baselines.hand_eye(mirrored, C), InputError, "base_T_flange: expected rotations"),
        (lambda: rc.baselines.hand_eye(gone, C), InputError, "base_T_flange: expected finite"),
        (lambda: rc.baselines.hand_eye(A, C, "rcm"), InputError, "base_p_rcm and board_p_rcm"),
        (lambda: rc.baselines.hand_eye(A, C, camera_left_T_board=C), InputError, "together"),
        (
            lambda: rc.baselines.hand_eye(
                A, C, "rcm", setup="eye_to_hand", base_p_rcm=RCM_IN_BASE, board_p_rcm=RCM_IN_BASE
            ),
            InputError,
            "setup eye_in_hand",
        ),
    )
    for call, kind, message in cases:
        with pytest.raises(kind, match=message):
            call()
