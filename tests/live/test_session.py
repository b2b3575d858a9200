"""`rc.Session`: answers while frames come in are near the truth, near a solve of everything, and never say ok."""

from collections.abc import Iterator
from dataclasses import replace
from itertools import chain, repeat

import numpy as np
import pytest
import torch
from scipy.spatial.transform import Rotation

import rmis_calib as rc
from rmis_calib.config import parse_config
from rmis_calib.errors import InputError, ShapeError, VideoError
from rmis_calib.live import LiveAnswer, Session, session
from rmis_calib.vision import FrameReason, ShaftDetector

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


def test_the_result_is_that_of_calibrate(frames, whole) -> None:
    """The same motions and pictures; a session has no clock to estimate, and searches every picture from the start."""
    config = parse_config({"search_every": 1, "solver": {"unknowns": {"clock": False}}})
    result, other = whole[0].result(), rc.calibrate(frames.recording, config, throw=False)
    assert (result.status, result.message) == (other.status, other.message)
    np.testing.assert_allclose(result.camera_right_T_arm.matrix, other.camera_right_T_arm.matrix, atol=1e-6)
    np.testing.assert_array_equal(result.motions.used, other.motions.used)
    assert result.picture is not None and result.picture.views.keys() == {"right", "left"}
    # The live answer, which knows of no offsets, is nearer to it than sigma (of 6 unknowns: 2.4).
    live = error(whole[1][-1].camera_right_T_arm.matrix.numpy(), other.camera_right_T_arm.matrix.numpy())
    assert np.sqrt(live @ np.linalg.solve(other.covariance, live)) < 2.0
    assert whole[1][-1].used == result.motions.used.sum()
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
    hangs = live.add(frames.joints[9], frames.right[9], frames.left[9])
    assert not hangs.frame_used and "repeats" in hangs.frame_reason
    good = live.add(frames.joints[10], frames.right[10], frames.left[10])
    assert good.frame_used and good.used == 10 and good.frames == 13


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


class Blind(ShaftDetector):
    """A detector that finds nothing by itself in some calls, and looks along an expectation as any."""

    def __init__(self, own: ShaftDetector, sees: Iterator[bool]) -> None:
        super().__init__(own.settings, own.lens.camera)
        self._sees = sees

    def detect(self, images, masks=None):
        found = super().detect(images, masks)
        if next(self._sees):
            return found
        reason = torch.full_like(found.reason, int(FrameReason.NOT_A_CYLINDER))
        return replace(found, valid=torch.zeros_like(found.valid), reason=reason)


def blinded(live: Session, first_seen: int) -> None:
    """After the first motions every picture is one in which a search of all of it finds nothing."""
    for side, detector in live._detectors.items():
        live._detectors[side] = Blind(detector, chain(repeat(True, first_seen), repeat(False)))


def test_a_hidden_shaft_is_found_where_the_estimate_puts_it(frames, whole) -> None:
    live = Session.like(frames.recording)
    blinded(live, 9)
    answers = [live.add(frames.joints[k], frames.right[k], frames.left[k]) for k in range(18)]
    assert answers[-1].used >= 16  # of 18, of which 9 are found by looking along the estimate alone
    assert sigmas(answers[-1], frames.truth) < THREE_SIGMA
    sigma = [np.sqrt(np.trace(each.covariance[3:, 3:])) for each in (answers[8], answers[-1], whole[1][-1])]
    assert sigma[1] < 0.8 * sigma[0] and sigma[1] == pytest.approx(sigma[2], rel=0.25)
    result = live.result()
    assert result.motions.used.sum() >= 16
    assert any("by looking again" in note for note in result.notes)


def test_a_wrong_estimate_finds_nothing(frames) -> None:
    """5 deg and 10 mm off, and sure of itself."""
    live = Session.like(frames.recording)
    blinded(live, 9)
    before = [live.add(frames.joints[k], frames.right[k], frames.left[k]) for k in range(9)][-1]
    right, taken = live._posterior, 0
    for start, turn_deg, shift_mm in ((9, (0, 0, 5.0), (10.0, 0, 0)), (13, (-5.0, 0, 0), (0, 10.0, 0))):
        R = torch.from_numpy(Rotation.from_rotvec(turn_deg, degrees=True).as_matrix()) @ right.state.R
        t = right.state.t + torch.tensor(shift_mm, dtype=torch.float64)
        live._posterior = replace(right, state=replace(right.state, R=R, t=t))
        answers = [live.add(frames.joints[k], frames.right[k], frames.left[k]) for k in range(start, start + 4)]
        taken += sum(answer.frame_used for answer in answers)
    assert taken <= 1  # a right estimate takes all of them, see above
    assert answers[-1].used <= before.used + 1
    # Solved again from what was found without the estimate, it is right again.
    live._solve_all()
    assert sigmas(live._answer(""), frames.truth) < THREE_SIGMA


def test_old_pictures_are_forgotten_where_there_is_no_room(frames) -> None:
    megabytes = 2 * frames.right[0].nbytes / 1e6  # of each pose
    live = Session(frames.recording.robot, frames.recording.stereo, picture_memory_mb=2.5 * megabytes)
    right = frames.right[:8].clone()
    for k in range(8):
        live.add(frames.joints[k], right[k], frames.left[k])
        right[k] = 0  # the session has its own
    source = live._collected.recording().right
    assert [source.has(k) for k in range(8)] == [False] * 6 + [True] * 2
    assert torch.equal(source.frames([7, 6]), frames.right[[7, 6]])
    with pytest.raises(VideoError, match="frame 3"):
        source.frames([3])
    assert live.result().motions.used.sum() == 8


def covered(frames, rng) -> tuple[torch.Tensor, torch.Tensor]:
    """Another instrument, which no joints move, comes from the left in every picture; and tissue lies over our own in
    every third one."""
    order, half = rng.permutation(18), frames.right.shape[-1] // 2
    pictures = frames.right.clone(), frames.left.clone()
    for new, old in zip(pictures, (frames.right, frames.left), strict=True):
        tissue = old[1::3, :, :, :half].clone()
        new[..., :half] = old[order][..., half:].flip(-1)
        new[1::3, :, :, half:] = tissue.flip(-2)
    return pictures


def test_the_shaft_is_found_among_things_that_outnumber_it(frames) -> None:
    live = Session.like(frames.recording)
    right, left = covered(frames, np.random.default_rng(0))
    answers = [live.add(frames.joints[k], right[k], left[k]) for k in range(13)]
    told = [answer for answer in answers if answer.camera_right_T_arm is not None]
    assert len(told) >= 3
    assert all(sigmas(answer, frames.truth) < THREE_SIGMA for answer in told)
    assert answers[-1].used == 9 and [answer.frame_used for answer in answers[-3:]] == [False, True, True]


def test_one_camera(frames) -> None:
    stereo = frames.recording.stereo
    live = rc.Session(frames.recording.robot, type(stereo)(stereo.right))
    for k in range(8):
        answer = live.add(frames.joints[k], frames.right[k])
    assert answer.camera_right_T_arm is not None
    assert sigmas(answer, frames.truth) < THREE_SIGMA
