"""What the data ask for is freed, by evidence that counts neighbours together; what they cannot tell is allowed for.

Errors and scenes are those of `bench_solver_misspecified.py`, made in the independent simulation.
"""

import numpy as np
import pytest
import torch

from rmis_calib.geometry.rotations import matrix_to_rotvec
from rmis_calib.solver import Problem, solve
from rmis_calib.solver.assess.doubt import part_that_covers
from rmis_calib.solver.settings import SolverSettings
from tests.benchmarks.bench_solver_misspecified import CAMERAS, ERRORS, INSIDE_95, scene

SETUP, BASE_OFF = "laparoscope_base_T_instrument_base", "base 3 mm, 0.5 deg off"
TRIALS, MOTIONS = 8, 64
STATED = ("sigma_setup_mm", "sigma_setup_rad", "sigma_rcm_mm")
EXACT = dict.fromkeys(STATED, 0.0)


def observed(what, error, motions=MOTIONS):
    """Arrays with an error in them, of which nobody says how well the set-up is known; and those without."""
    right = scene(what, TRIALS, motions, 0.3, error)
    wrong = ERRORS[error](right, np.random.default_rng(0))
    return {key: value for key, value in wrong.items() if key not in ("truth", *STATED)}, right


def solved(arrays, groups=8, **more):
    return solve(Problem.from_arrays(arrays | more).only("axis", "contours", "ends"), SolverSettings(groups=groups))


def inside(T, covariance, truth):
    truth = torch.as_tensor(truth)
    gap = torch.cat((matrix_to_rotvec(truth[:, :3, :3] @ T[:, :3, :3].mT), truth[:, :3, 3] - T[:, :3, 3]), dim=-1)
    return (gap * torch.linalg.solve(covariance, gap[..., None])[..., 0]).sum(-1) < INSIDE_95


def test_a_right_set_up_is_believed_where_neighbours_share_errors():
    """12 frames at each stop: taken as independent motions they contradict any set-up; as groups they do not."""
    arrays, _ = observed("moving", "12 frames a stop", motions=120)
    grouped, alone = (solved(arrays, groups).evidence["setup"] for groups in (8, 0))
    assert float((alone < 0.02).double().mean()) > 0.7
    assert float((grouped < 0.02).double().mean()) < 0.3


def test_a_laparoscope_that_stands_still_does_not_vouch_for_the_set_up():
    """Told wrong by 3 mm and 0.5 deg: no data can tell. The covariance allows for it unless the set-up is said to be
    exact; where the instrument's base is in the camera the data tell all the same."""
    arrays, right = observed("still", BASE_OFF)
    error = ERRORS[BASE_OFF]({"arm_T_rcm": np.eye(4)}, np.random.default_rng(0))["arm_T_rcm"]
    arrays[SETUP] = right[SETUP] @ error
    solution, X = solved(arrays, sigma_rcm_mm=0.0), right["truth"]["camera_right_T_arm"]
    assert bool((solution.verdict != 0).all())
    assert bool(inside(solution.camera_right_T_arm, solution.covariance, X).all())
    base = solution.instrument_base
    camera_right_T_instrument_base = X @ np.linalg.inv(right["laparoscope_base_T_arm"][:, 0]) @ right[SETUP]
    assert bool(inside(base.camera_right_T_instrument_base, base.covariance, camera_right_T_instrument_base).all())
    exact = solved(arrays, **EXACT)
    assert bool((exact.verdict == 0).all())
    assert not bool(inside(exact.camera_right_T_arm, exact.covariance, X).any())
    torch.testing.assert_close(exact.instrument_base.covariance, base.covariance)


@pytest.mark.parametrize("error", ["compliance 0.3 deg", "centre 10 px off"])
def test_what_a_still_camera_absorbs_is_allowed_for(error):
    arrays, right = observed("still", error)
    solution = solved(arrays, **EXACT, **CAMERAS)
    name = "centre" if "centre" in error else "compliance"
    X = right["truth"]["camera_right_T_arm"]
    assert float(inside(solution.camera_right_T_arm, solution.covariance, X).double().mean()) > 0.8
    without = solution.covariance - solution.doubt[name]
    assert float(inside(solution.camera_right_T_arm, without, X).double().mean()) < 0.7


@pytest.mark.parametrize("what", ["moving", "still"])
def test_a_missed_rcm_is_allowed_for_unless_it_is_said_to_be_none(what):
    """By 1 mm, to a side fixed to `rcm`: no laparoscope that stands still, and few that move, tell it."""
    arrays, right = observed(what, "RCM missed by 1 mm", motions=125)
    X, known = right["truth"]["camera_right_T_arm"], EXACT if what == "still" else {}
    solution = solved(arrays, **known | {"sigma_rcm_mm": 1.0}, **CAMERAS)
    without = solved(arrays, **known | {"sigma_rcm_mm": 0.0}, **CAMERAS)
    allowed, believed = (inside(s.camera_right_T_arm, s.covariance, X).double().mean() for s in (solution, without))
    assert float(allowed) > 0.8 and float(believed) < 0.7


def test_a_bent_shaft_is_not_called_trustworthy():
    arrays, _ = observed("moving", "bent shaft 1 mm")
    assert bool((solved(arrays, **CAMERAS).verdict != 0).all())


def test_the_doubt_of_an_unknown_holds_the_case_that_it_is_off():
    """Against draws: with probability p an error has covariance C, else none; 95 % of all draws are to be inside."""
    for p in (0.03, 0.1, 0.4, 0.9):
        part = float(part_that_covers(torch.tensor([p], dtype=torch.float64)))
        off = np.random.default_rng(0).standard_normal((400_000, 6))
        beyond = p * ((off**2).sum(-1) > INSIDE_95 * part).mean()
        assert beyond < 0.0505
        assert p <= part < 1.0 and (part == p or beyond > 0.0495)


def test_doubt_of_what_the_data_see_is_small():
    """A right model and a laparoscope that moves: sigma grows by less than a fifth."""
    arrays, _ = observed("moving", "right model", motions=125)
    solution = solved(arrays, sigma_rcm_mm=0.0, **CAMERAS)
    doubt = sum(solution.doubt.values())
    mm2, deg2 = (solution.covariance.diagonal(dim1=-2, dim2=-1)[:, part].sum(-1) for part in (slice(3, 6), slice(3)))
    gained = doubt.diagonal(dim1=-2, dim2=-1)
    for variance, more in ((mm2, gained[:, 3:].sum(-1)), (deg2, gained[:, :3].sum(-1))):
        assert float((variance / (variance - more)).sqrt().median()) < 1.25
