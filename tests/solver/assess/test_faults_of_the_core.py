"""Answers that looked right and were not: each case here once went through without a word."""

from dataclasses import replace

import numpy as np
import pytest
import torch
from pydantic import ValidationError

from rmis_calib.errors import ObservationsError
from rmis_calib.geometry.rotations import rotation_angle
from rmis_calib.solver import Problem, SolverSettings, solve
from rmis_calib.solver.assess.nuisances import _unseen
from rmis_calib.solver.assess.observability import assess
from rmis_calib.solver.settings import VerdictSettings
from rmis_calib.solver.start.paper import MIN_LINES, votes
from rmis_calib.solver.status import MotionReason


def turned_deg(found, truth):
    """Largest angle to the truth."""
    R = found.camera_right_T_arm[..., :3, :3].mT @ torch.as_tensor(truth["camera_right_T_arm"])[..., :3, :3]
    return float(torch.rad2deg(rotation_angle(R)).max())


def test_what_is_unobservable_by_one_measure_alone_is_unobservable(simulate):
    problem, truth, _ = simulate(trials=1)
    T = torch.as_tensor(truth["camera_right_T_arm"]).reshape(1, 4, 4)
    covariance = torch.diag_embed(torch.tensor([[1e-12, 1e-12, 1e-12, 400.0, 400.0, 400.0]], dtype=torch.float64))
    settings = VerdictSettings(trustworthy_mm=10.0, unobservable_mm=10.0)
    found = assess(problem, T[:, :3, :3], T[:, :3, 3], covariance, settings, torch.zeros(1, dtype=torch.int64))
    assert int(found.verdict) == 2


@pytest.mark.parametrize(("unit", "least", "most"), [("mm", 12.0, 10.0), ("deg", 9.0, 8.0)])
def test_thresholds_out_of_order_are_refused(unit, least, most):
    with pytest.raises(ValidationError, match=f"trustworthy_{unit} at most unobservable_{unit}"):
        VerdictSettings(**{f"trustworthy_{unit}": least, f"unobservable_{unit}": most})


def test_a_camera_that_hardly_saw_anything_does_not_vote(simulate):
    problem, truth, arrays = simulate(trials=1, positions_laparoscope=3, positions_instrument=3, pixel_noise_px=0.3)
    both = Problem.from_arrays(arrays | {"valid_left": np.arange(problem.n_motions)[None] < 2}).only("axis")
    alone = solve(problem.only("axis").cameras(1), method="paper")
    found = solve(both, method="paper")
    torch.testing.assert_close(found.camera_right_T_arm, alone.camera_right_T_arm, rtol=0, atol=1e-12)
    torch.testing.assert_close(found.covariance, alone.covariance, rtol=1e-9, atol=1e-15)
    assert turned_deg(found, truth) < 3.0


def test_votes_of_cameras():
    count = torch.tensor([[MIN_LINES, MIN_LINES - 1], [40.0, 50.0], [3.0, 5.0]], dtype=torch.float64)
    expected = torch.tensor([[1.0, 0.0], [0.5, 0.5], [0.0, 1.0]], dtype=torch.float64)
    assert torch.equal(votes(count), expected)


@pytest.mark.parametrize("name", ["arm_T_rcm", "rcm_v_axis"])
@pytest.mark.parametrize("method", ["paper", "global", "joint"])
def test_motions_without_kinematics_are_not_valid(simulate, realistic, method, name):
    _, _, arrays = simulate(trials=1, positions_laparoscope=3, positions_instrument=3, **realistic)
    gone = np.array([3, 17, 30])
    with_gaps = np.array(arrays[name])
    with_gaps[:, gone] = np.nan
    found = solve(Problem.from_arrays(arrays | {name: with_gaps}), method=method)
    masked = {key: np.array(arrays[key]) for key in ("valid_right", "valid_left")}
    for valid in masked.values():
        valid[:, gone] = False
    expected = solve(Problem.from_arrays(arrays | masked), method=method)
    # The simulations of the bias correction of `joint` are about all poses: a thousandth of a sigma or so.
    gap = found.camera_right_T_arm[0, :3, 3] - expected.camera_right_T_arm[0, :3, 3]
    assert bool((gap.abs() < 0.01 * expected.covariance[0].diagonal()[3:].sqrt()).all())
    assert (found.reason[0, gone] == MotionReason.NOT_MEASURED).all()


def test_kinematics_that_are_all_missing_are_named(simulate):
    _, _, arrays = simulate(trials=1)
    with pytest.raises(ObservationsError, match="NaN in every motion"):
        Problem.from_arrays(arrays | {"arm_T_rcm": np.full_like(arrays["arm_T_rcm"], np.nan)})


def test_thinning_works_beside_joint_offsets(simulate, realistic):
    problem, truth, _ = simulate(trials=1, positions_laparoscope=3, positions_instrument=3, **realistic)
    generator = torch.Generator().manual_seed(3)
    derivative = torch.randn((1, problem.n_motions, 6, 2), generator=generator, dtype=torch.float64)

    def kinematics(joint_offset, clock):
        return replace(
            problem,
            joint_derivative=derivative,
            joint_offset_sigma=torch.full((1, 2), 1e-3, dtype=torch.float64),
            joint_offset_at=joint_offset,
            clock_at=clock,
        )

    start = kinematics(torch.zeros(1, 2, dtype=torch.float64), torch.zeros(1, 2, dtype=torch.float64))
    found = solve(start, SolverSettings(thin_to=100), kinematics=kinematics)
    assert found.reason.shape[-1] == problem.n_motions
    assert int((found.reason == MotionReason.USED).sum()) > 90
    assert turned_deg(found, truth) < 1.0


def test_offsets_of_which_only_the_sum_shows_are_unseen_as_their_difference():
    """By hand: information (1, 1) (1, 1)^T / s^2 beside unit priors leaves the difference at its prior."""
    s = 1e-2
    information = torch.eye(2, dtype=torch.float64) + torch.ones(2, 2, dtype=torch.float64) / s**2
    unseen = _unseen(torch.linalg.inv(information)[None], torch.ones(1, 2, dtype=torch.float64), 0.95)
    expected = torch.tensor([[0.5, -0.5], [-0.5, 0.5]], dtype=torch.float64)
    torch.testing.assert_close(unseen[0], expected)
