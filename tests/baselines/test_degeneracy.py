"""Motion that cannot answer is named by every method, with and without noise; motion that can is not."""

import numpy as np
import pytest
from scenes import METHODS, Scene, noisy, scene

import rmis_calib as rc
from rmis_calib.baselines import HandEyeStatus

RNG = np.random.default_rng(0)
N = 15
AXIS = np.array([0.6, 0.0, 0.8])
ANGLES = RNG.normal(size=(N, 1)) * 0.5
SHIFTS = RNG.normal(size=(N, 3)) * 80.0
ALONG = (SHIFTS @ AXIS)[:, None] * AXIS
MOTIONS = {
    "single axis": (HandEyeStatus.SINGLE_AXIS, ANGLES * AXIS, SHIFTS),
    "planar": (HandEyeStatus.PLANAR, ANGLES * AXIS, SHIFTS - ALONG),
    "pure translation": (HandEyeStatus.PURE_TRANSLATION, np.zeros((N, 3)), SHIFTS),
    "identical poses": (HandEyeStatus.IDENTICAL, np.zeros((N, 3)), np.zeros((N, 3))),
    "tiny angles": (HandEyeStatus.TINY, RNG.normal(size=(N, 3)) * 0.002, SHIFTS),
}
NOISE = {
    "board": {"camera": (0.002, 0.3)},
    "robot": {"robot": (0.002, 0.3)},
    "both": {"camera": (0.005, 0.5), "robot": (0.005, 0.5)},
}


@pytest.mark.parametrize("method", METHODS)
@pytest.mark.parametrize("motion", MOTIONS)
def test_degenerate_motion_is_named_and_not_answered(method: str, motion: str) -> None:
    status, turns, shifts = MOTIONS[motion]
    found = scene(1, N, trials=(4,), turns=turns, shifts=shifts).solve(method)
    assert found.status.tolist() == [status] * 4
    assert found.flange_T_camera.isnan().all() and found.base_T_board.isnan().all() and found.covariance.isnan().all()
    assert all(words.startswith("degenerate: ") for words in found.degeneracy())


@pytest.mark.parametrize("noise", NOISE)
@pytest.mark.parametrize("motion", MOTIONS)
@pytest.mark.parametrize("poses", [6, 15, 60])
def test_noise_does_not_hide_it(motion: str, noise: str, poses: int) -> None:
    _, turns, shifts = MOTIONS[motion]
    rows = np.arange(poses) % N + 0.01 * (
        np.arange(poses) // N
    )  # more poses: the same motion again, a little different
    turns, shifts = (values[rows.astype(int)] * (1 + rows - rows.astype(int))[:, None] for values in (turns, shifts))
    data = noisy(scene(2, poses, trials=(60,), turns=turns, shifts=shifts), 3, **NOISE[noise])
    found = data.solve("park", covariance=False)
    named = np.mean([bool(words) for words in found.degeneracy()])
    assert named >= 0.98, f"{named:.3f} of the trials named"


@pytest.mark.parametrize("angle", [0.06, 0.17, 0.5])
@pytest.mark.parametrize("poses", [8, 20, 60])
def test_motion_that_can_answer_is_answered(angle: float, poses: int) -> None:
    noise = (0.05 * angle, 0.2)
    data = noisy(scene(4, poses, trials=(40,), angle=angle), 5, camera=noise, robot=noise)
    assert data.solve("park", covariance=False).ok.double().mean() >= 0.97


def test_the_papers_middle_noise_is_answered_from_many_motions() -> None:
    # 1 deg and 1 mm on robot and camera, a range of 10 deg, 343 motions.
    noise = (np.deg2rad(1.0), 1.0)
    rng = np.random.default_rng(1)
    turns, shifts = np.deg2rad(rng.uniform(-5, 5, (343, 3))), rng.uniform(-10, 10, (343, 3))
    data = noisy(scene(6, 343, trials=(5,), turns=turns, shifts=shifts), 7, camera=noise, robot=noise)
    assert data.solve("park", covariance=False).ok.all()


def test_poses_in_the_wrong_order_are_named() -> None:
    exact = scene(8, 20, trials=(50,))
    shuffled = Scene(
        exact.base_T_flange, np.roll(exact.camera_T_board, 1, axis=1), exact.flange_T_camera, exact.base_T_board
    )
    found = shuffled.solve("park", covariance=False)
    assert (found.status == HandEyeStatus.ROTATIONS_DISAGREE).double().mean() >= 0.98 and not found.ok.any()
    assert found.flange_T_camera.isnan().all()


def test_poses_read_the_wrong_way_round_are_named() -> None:
    exact = scene(9, 20, trials=(50,))
    for robot, board, setup in (
        (np.linalg.inv(exact.base_T_flange), exact.camera_T_board, "eye_in_hand"),
        (exact.base_T_flange, np.linalg.inv(exact.camera_T_board), "eye_in_hand"),
        (exact.base_T_flange, exact.camera_T_board, "eye_to_hand"),
    ):
        found = rc.baselines.hand_eye(robot, board, setup=setup, covariance=False)
        assert not found.ok.any(), f"{setup}: {found.ok.sum()} of 50 answered"


def test_robot_in_metres_is_named() -> None:
    exact = scene(10, 20, trials=(50,))
    metres = exact.base_T_flange * np.array([[1.0, 1.0, 1.0, 1e-3]] * 3 + [[1.0] * 4])
    found = rc.baselines.hand_eye(metres, exact.camera_T_board, covariance=False)
    assert (found.status == HandEyeStatus.TRANSLATIONS_DISAGREE).all()


def test_one_bad_trial_leaves_its_neighbours_alone() -> None:
    exact = scene(11, N, trials=(3,))
    broken = exact.base_T_flange.copy()
    broken[1] = broken[1, 0]
    for method in METHODS:
        data = Scene(broken, exact.camera_T_board, exact.flange_T_camera, exact.base_T_board)
        found = data.solve(method, covariance=False)
        assert found.ok.tolist() == [True, False, True]
        np.testing.assert_allclose(found.flange_T_camera[::2].numpy(), exact.flange_T_camera[::2], atol=1e-9)
