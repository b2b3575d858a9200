"""`rc.Session`: answers while frames come in are near the truth, near a solve of everything, and never say ok."""

import numpy as np
import pytest
import torch
from scipy.spatial.transform import Rotation

import rmis_calib as rc
from rmis_calib.errors import InputError, ShapeError
from rmis_calib.live import LiveAnswer, Session, session

THREE_SIGMA = 4.49
"""Of 6 unknowns."""


def fed(frames, count: int) -> tuple[Session, list[LiveAnswer]]:
    live = Session.like(frames.recording)
    answers = [live.add(frames.joints[k], frames.right[k], frames.left[k]) for k in range(count)]
    return live, answers


@pytest.fixture(scope="module")
def whole(frames) -> tuple[Session, list[LiveAnswer]]:
    return fed(frames, len(frames.joints))


def error(matrix: np.ndarray, truth: np.ndarray) -> np.ndarray:
    """Rotation vector, rad, then translation, mm: R = exp(dphi) R^, t = t^ + dt."""
    dphi = Rotation.from_matrix(truth[:3, :3] @ matrix[:3, :3].T).as_rotvec()
    return np.concatenate([dphi, truth[:3, 3] - matrix[:3, 3]])


def sigmas(answer: LiveAnswer, truth: np.ndarray) -> float:
    assert answer.camera_right_T_arm is not None and answer.covariance is not None
    e = error(answer.camera_right_T_arm.matrix.numpy(), truth)
    return float(np.sqrt(e @ np.linalg.solve(answer.covariance, e)))


def test_answers_come_from_the_sixth_motion_on_and_hold_the_truth(frames, whole) -> None:
    _, answers = whole
    assert [answer.status for answer in answers[:5]] == ["collecting"] * 5
    assert answers[4].message == "5 usable motions, 6 are needed"
    for answer in answers[5:]:
        assert answer.frame_used, answer.frame_reason
        assert sigmas(answer, frames.truth) < THREE_SIGMA
    first, last = (np.trace(answers[k].covariance[3:, 3:]) for k in (5, -1))
    assert last < first
    assert answers[-1].status == "ready" and answers[-1].used == len(frames.joints)


def test_the_filter_is_near_a_solve_of_all_motions_each_time(frames, whole, monkeypatch) -> None:
    monkeypatch.setattr(session, "SOLVE_AGAIN", 1.0)
    _, solved = fed(frames, len(frames.joints))
    for live, exact in zip(whole[1][5:], solved[5:], strict=True):
        # What linearising each motion where it came costs is a small part of sigma.
        assert sigmas(live, exact.camera_right_T_arm.matrix.numpy()) < 1.0
    sigma = [np.sqrt(np.trace(answers[-1].covariance[3:, 3:])) for answers in (whole[1], solved)]
    assert sigma[0] == pytest.approx(sigma[1], rel=0.1)


def test_the_result_is_a_checked_calibration(frames, whole) -> None:
    result = whole[0].result()
    assert result.camera_right_T_arm is not None and result.status in ("ok", "weak")
    e = error(result.camera_right_T_arm.matrix.numpy(), frames.truth)
    assert np.sqrt(e @ np.linalg.solve(result.covariance, e)) < THREE_SIGMA
    assert len(result.motions.used) == len(frames.joints)


def test_advice_names_joints(whole) -> None:
    advice = whole[0].advice()
    assert advice and advice[0].startswith("First ") and "." in advice[0]
    assert any(column.rpartition("_")[0] in advice[0] for column in whole[0].columns)


def test_frames_that_say_nothing_or_the_contrary_change_nothing(frames) -> None:
    live, answers = fed(frames, 9)
    grey = torch.full_like(frames.right[0], 128)
    blind = live.add(frames.joints[9], grey, grey)
    assert not blind.frame_used and blind.frame_reason.startswith("the frame is black")
    wrong = dict(frames.joints[9])
    column = next(name for name in wrong if name.startswith("instrument.") and name.endswith("_rad"))
    wrong[column] += 0.3
    contrary = live.add(wrong, frames.right[9], frames.left[9])
    assert not contrary.frame_used and "contradicts" in contrary.frame_reason
    for answer in (blind, contrary):
        assert torch.equal(answer.camera_right_T_arm.matrix, answers[-1].camera_right_T_arm.matrix)
        assert answer.used == 9
    good = live.add(frames.joints[9], frames.right[9], frames.left[9])
    assert good.frame_used and good.used == 10 and good.frames == 12


def test_mistakes_are_named(frames) -> None:
    live = Session.like(frames.recording)
    joints = frames.joints[0]
    with pytest.raises(InputError, match=r"no laparoscope\."):
        live.add(dict(list(joints.items())[1:]), frames.right[0], frames.left[0])
    with pytest.raises(InputError, match="elbow_rad, of no arm in use"):
        live.add(joints | {"elbow_rad": 0.0}, frames.right[0], frames.left[0])
    with pytest.raises(InputError, match="finite"):
        live.add(dict.fromkeys(joints, float("nan")), frames.right[0], frames.left[0])
    with pytest.raises(InputError, match="a right picture and a left picture"):
        live.add(joints, frames.right[0])
    with pytest.raises(ShapeError):
        live.add(joints, frames.right[0][:, ::2], frames.left[0][:, ::2])
    with pytest.raises(InputError, match="frames"):
        live.result()


def test_one_camera(frames) -> None:
    stereo = frames.recording.stereo
    live = rc.Session(frames.recording.robot, type(stereo)(stereo.right))
    for k in range(8):
        answer = live.add(frames.joints[k], frames.right[k])
    assert answer.camera_right_T_arm is not None
    assert sigmas(answer, frames.truth) < THREE_SIGMA
