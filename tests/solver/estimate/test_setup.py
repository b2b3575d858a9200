"""The pose of one arm's base in the other's as an unknown: against the bound, from any start, and where nothing tells
it."""

from dataclasses import replace

import numpy as np
import pytest
import torch
from setup_bound import Scene, bound

from data_synth.kinematics import random_rotations, rigid, rigid_inverse
from rmis_calib.errors import InputError, InsufficientDataError, ObservationsError
from rmis_calib.geometry.rotations import matrix_to_rotvec
from rmis_calib.solver import Problem, SolverSettings, solve
from rmis_calib.solver.observability import Degeneracy
from rmis_calib.solver.settings import UnknownSettings

SETUP = "laparoscope_base_T_instrument_base"
INSIDE_95_OF_12 = 21.03
"""Quantile of chi^2 with 12 degrees of freedom."""


def unknown(setup, **more):
    return SolverSettings(unknowns=UnknownSettings(setup=setup, compliance="never"), **more)


def measured(arrays):
    return Problem.from_arrays(arrays).only("axis", "contours", "ends")


def unstated(arrays, generator):
    """The arrays as somebody has them who knows nothing of the set-up, with the instrument's base anywhere: arm_T_rcm
    is evaluated at the identity. And the true set-up."""
    L, S = arrays["laparoscope_base_T_arm"], arrays[SETUP]
    R = random_rotations(generator, (len(S),))
    anywhere = S @ rigid(R, generator.uniform(-300.0, 300.0, (len(S), 3)))
    moved = rigid_inverse(L) @ rigid_inverse(anywhere)[:, None] @ L @ arrays["arm_T_rcm"]
    known = {key: value for key, value in arrays.items() if key != SETUP}
    return known | {"arm_T_rcm": moved}, anywhere


def error(found, truth):
    """[rotation vector, translation] from the truth, perturbation on the left."""
    truth = torch.as_tensor(truth)
    turn = matrix_to_rotvec(truth[..., :3, :3] @ found[..., :3, :3].mT)
    return torch.cat((turn, truth[..., :3, 3] - found[..., :3, 3]), dim=-1)


def errors(solution, X, S):
    return torch.cat(
        (error(solution.camera_right_T_arm, X), error(solution.setup.laparoscope_base_T_instrument_base, S)), dim=-1
    )


def mahalanobis2(gap, covariance):
    scale = covariance.diagonal(dim1=-2, dim2=-1).rsqrt()
    unit = covariance * scale[..., :, None] * scale[..., None, :]
    return ((gap * scale) * torch.linalg.solve(unit, (gap * scale)[..., None])[..., 0]).sum(-1)


@pytest.fixture(scope="module")
def eight_places(simulate, realistic):
    """The laparoscope at 8 places, with 27 of the instrument at each; 25 trials, anything for a hand-eye transform."""
    return simulate(
        trials=25, seed=3, positions_laparoscope=2, positions_instrument=3, random_hand_eye=True, **realistic
    )


@pytest.fixture(scope="module")
def found_anywhere(eight_places):
    """Solved with no prior, the instrument's base anywhere; and the true set-ups."""
    _, _, arrays = eight_places
    given, S = unstated(arrays, np.random.default_rng(0))
    return solve(measured(given), unknown("known")), S


def test_right_basin_from_nothing(eight_places, found_anywhere):
    _, truth, _ = eight_places
    solution, S = found_anywhere
    assert bool(solution.converged.all())
    gap = errors(solution, truth["camera_right_T_arm"], S)
    assert float(torch.rad2deg(gap[:, :3].norm(dim=-1).max())) < 1.0
    assert float(gap[:, 3:6].norm(dim=-1).max()) < 3.0
    assert bool((mahalanobis2(gap, solution.setup.covariance) < 60.0).all())


def test_both_transforms_reach_the_bound(simulate, realistic):
    """Root mean square of the errors in units of the bound, over 12 numbers and 30 trials (known to 4 per cent)."""
    config = {"positions_laparoscope": 2, "positions_instrument": 3}
    _, _, exact = simulate(trials=1, **config)
    C = torch.as_tensor(bound(Scene(exact, 0.3 / 800.0, 0.3, np.deg2rad(0.1), (0.05, np.deg2rad(0.05)))))
    _, truth, arrays = simulate(trials=30, seed=5, **config, **realistic)
    solution = solve(measured(arrays), unknown("free"))
    gap = errors(solution, truth["camera_right_T_arm"], arrays[SETUP])
    efficiency = (mahalanobis2(gap, C.expand(30, 12, 12)).mean() / 12.0).sqrt()
    assert 0.9 < float(efficiency) < 1.15
    inside = (mahalanobis2(gap, solution.setup.covariance) < INSIDE_95_OF_12).double().mean()
    assert 0.9 < float(inside) <= 1.0
    sigma = solution.setup.covariance.diagonal(dim1=-2, dim2=-1).sqrt().median(0).values
    torch.testing.assert_close(sigma, C.diagonal().sqrt(), rtol=0.12, atol=0.0)


def test_a_prior_about_a_wrong_set_up_gives_the_same(simulate, realistic):
    """Stated 30 mm and 3 deg off: within the prior, and far outside of one linearisation."""
    _, _, arrays = simulate(trials=6, seed=5, positions_laparoscope=2, positions_instrument=3, **realistic)
    off = rigid(rotation := np.eye(3)[None], np.array([[20.0, -18.0, 14.0]]))[0]
    off[:3, :3] = rotation[0] @ turned([0.03, -0.03, 0.03])
    L, S = arrays["laparoscope_base_T_arm"], arrays[SETUP]
    wrong = arrays | {
        "arm_T_rcm": rigid_inverse(L) @ (S @ off @ rigid_inverse(S))[:, None] @ L @ arrays["arm_T_rcm"],
        SETUP: S @ off,
    }
    free, prior = solve(measured(arrays), unknown("free")), solve(measured(wrong), unknown("prior"))
    gap = error(prior.camera_right_T_arm, free.camera_right_T_arm)
    assert float((gap.abs() / free.covariance.diagonal(dim1=-2, dim2=-1).sqrt()).max()) < 0.2
    away = prior.setup.from_stated[:, 3:].norm(dim=-1)
    torch.testing.assert_close(away, torch.full_like(away, np.linalg.norm(off[:3, 3])), rtol=0.1, atol=0.0)


def turned(rotvec):
    from data_synth.kinematics import rotation_from_rotvec

    return rotation_from_rotvec(rotvec)


def test_a_stated_set_up_that_is_wrong_is_found_out(simulate, realistic):
    """3 mm and 0.5 deg: believed, the answer would be many of its own sigmas off."""
    _, truth, arrays = simulate(trials=10, seed=7, positions_laparoscope=3, positions_instrument=3, **realistic)
    off = np.eye(4)
    off[:3, :3], off[:3, 3] = turned(np.deg2rad([0.3, -0.3, 0.26])), [2.0, -1.5, 1.66]
    wrong = arrays | {SETUP: arrays[SETUP] @ off}
    L = arrays["laparoscope_base_T_arm"]
    wrong["arm_T_rcm"] = (
        rigid_inverse(L) @ (arrays[SETUP] @ off @ rigid_inverse(arrays[SETUP]))[:, None] @ L @ arrays["arm_T_rcm"]
    )
    told = {key: value for key, value in wrong.items() if key not in (SETUP, "laparoscope_base_T_arm")}
    settings = unknown("known")
    believed, tested = solve(measured(told), settings), solve(measured(wrong), settings)
    X = truth["camera_right_T_arm"]
    assert bool((mahalanobis2(error(believed.camera_right_T_arm, X), believed.covariance) > 40.0).all())
    assert bool((tested.evidence["setup"] < 1e-6).all()) and "setup" in tested.nuisances
    assert bool((mahalanobis2(error(tested.camera_right_T_arm, X), tested.covariance) < 22.5).all())


def test_a_stated_set_up_that_is_right_is_believed(simulate, realistic):
    """The test frees one of 50 by chance; its probabilities are uniform."""
    _, _, arrays = simulate(trials=60, seed=9, motion="random", random_motions=60, **realistic)
    solution = solve(measured(arrays), unknown("known"))
    chance = solution.evidence["setup"]
    assert float((chance < 0.02).double().mean()) < 0.07
    assert 0.3 < float((chance < 0.5).double().mean()) < 0.7


def test_a_laparoscope_that_stands_still_leaves_the_instruments_base(simulate, realistic):
    _, truth, arrays = simulate(trials=4, positions_laparoscope=1, positions_instrument=5, **realistic)
    given, S = unstated(arrays, np.random.default_rng(1))
    solution = solve(measured(given), unknown("known"))
    assert solution.frame == "instrument_base" and solution.setup is None
    expected = truth["camera_right_T_arm"] @ rigid_inverse(arrays["laparoscope_base_T_arm"][:, 0]) @ S
    gap = error(solution.camera_right_T_arm, expected)
    assert bool((mahalanobis2(gap, solution.covariance) < 25.0).all())
    assert bool((solution.verdict == 0).all())


def test_turns_about_one_axis_do_not_tell_the_transform_from_the_set_up(simulate, realistic):
    """Of the laparoscope only the yaw moves: AX = XB leaves directions free, and the answer says so."""
    problem, _, _ = simulate(trials=1, positions_laparoscope=3, positions_instrument=4, **realistic)
    L = problem.laparoscope_base_T_arm[0]
    axis = matrix_to_rotvec(L[0, :3, :3].mT @ L[:, :3, :3])
    direction = torch.nn.functional.normalize(axis[axis.norm(dim=-1).argmax()], dim=-1)
    off = (axis - (axis @ direction)[:, None] * direction).norm(dim=-1)
    one = problem.select_motions(torch.nonzero(off < 1e-6)[:, 0]).only("axis", "contours", "ends")
    solution = solve(one, unknown("free"))
    assert int(solution.verdict) == 2
    assert int(solution.observability.degeneracy) & Degeneracy.SETUP_AND_TRANSFORM
    assert "two axes" in solution.observability.describe().sentences[0]


def test_what_the_set_up_cannot_be_found_from(simulate, realistic):
    problem, _, arrays = simulate(trials=1, **realistic)
    with pytest.raises(InsufficientDataError, match="base_T_arm_base"):
        solve(problem.only("axis"), unknown("free"))
    with pytest.raises(InputError, match="joint"):
        solve(problem, unknown("free"), method="global")
    without = {key: value for key, value in arrays.items() if key != "laparoscope_base_T_arm"}
    with pytest.raises(ObservationsError, match="laparoscope_base_T_arm"):
        solve(Problem.from_arrays(without), unknown("prior"))


def test_effects_of_the_laparoscopes_joints_turn_with_the_set_up(simulate):
    """What a step of the laparoscope does to the shaft, evaluated at one set-up and moved to another, against the step
    itself made there."""
    problem, _, _ = simulate(trials=1)
    generator = torch.Generator().manual_seed(0)
    step = torch.randn(6, generator=generator, dtype=torch.float64) * 1e-6

    def displacement(at):
        moved = torch.eye(4, dtype=torch.float64)
        moved[:3, :3] += torch.tensor([[0.0, -step[2], step[1]], [step[2], 0.0, -step[0]], [-step[1], step[0], 0.0]])
        moved[:3, 3] = step[3:]
        after = moved @ at.arm_T_rcm  # `arm` moves, and the shaft in it the other way round
        change = after - at.arm_T_rcm
        turn = at.arm_T_rcm[..., :3, :3].mT @ change[..., :3, :3]
        omega = torch.stack((turn[..., 2, 1], turn[..., 0, 2], turn[..., 1, 0]), dim=-1)
        return torch.cat((omega, (at.arm_T_rcm[..., :3, :3].mT @ change[..., :3, 3:])[..., 0]), dim=-1) / 1e-6

    other = problem.laparoscope_base_T_instrument_base @ torch.as_tensor(
        rigid(turned([0.5, -0.3, 0.8]), [40.0, 9.0, -60.0])
    )
    here = replace(problem, joint_derivative=displacement(problem)[..., None], laparoscope_joints=1)
    there = here.at_setup(other)
    torch.testing.assert_close(there.joint_derivative[..., 0], displacement(there), atol=1e-6, rtol=1e-6)
