"""Groups of neighbouring motions left out in turn: sigma grows where the data contradict themselves, and only there."""

import numpy as np
import pytest
import torch

import rmis_calib as rc
from rmis_calib.config import parse_config
from rmis_calib.geometry.rotations import matrix_to_rotvec
from rmis_calib.pipeline.answer.records.consistency import about_groups
from rmis_calib.pipeline.words import ranges_in_words
from rmis_calib.results import Change, Consistency, Shift
from rmis_calib.solver import Problem, solve
from rmis_calib.solver.assess.groups import neighbours
from rmis_calib.solver.settings import SolverSettings

INSIDE_95, BOUND = 12.592, 4.49
POINTS = ("axis_right", "contour_right", "end_right", "axis_left", "contour_left", "end_left")


@pytest.fixture(scope="module")
def right(simulate, realistic):
    """40 trials of 64 motions whose noise is as assumed."""
    return simulate(trials=40, positions_laparoscope=2, positions_instrument=2, **realistic)


def kinds(arrays: dict) -> Problem:
    keys = {key: value for key, value in arrays.items() if key != "truth" and "head" not in key}
    return Problem.from_arrays(keys).only("axis", "contours", "ends")


def distance2(found, truth: np.ndarray) -> torch.Tensor:
    T, X = found.camera_right_T_arm, torch.as_tensor(truth)
    gap = torch.cat((matrix_to_rotvec(X[:, :3, :3] @ T[:, :3, :3].mT), X[:, :3, 3] - T[:, :3, 3]), dim=-1)
    return (gap * torch.linalg.solve(found.covariance, gap[..., None])[..., 0]).sum(-1)


def resting(arrays: dict, frames: int) -> dict:
    """Each motion `frames` times over with one kinematic error, and new noise in the picture."""
    generator = np.random.default_rng(0)
    n = arrays["arm_T_rcm"].shape[1]
    rested = {
        key: np.repeat(value, frames, axis=1) if getattr(value, "ndim", 0) > 1 and value.shape[1] == n else value
        for key, value in arrays.items()
    }
    for key in POINTS:
        rested[key] = rested[key] + generator.normal(0.0, float(np.max(arrays["sigma_image"])), rested[key].shape)
    return rested


@pytest.mark.slow
def test_a_right_model_keeps_its_sigma(right) -> None:
    _, truth, arrays = right
    without, with_groups = (solve(kinds(arrays), SolverSettings(groups=groups)) for groups in (0, 8))
    growth = with_groups.translation_sigma_mm / without.translation_sigma_mm
    assert float(growth.min()) >= 1.0 - 1e-9
    assert float(growth.median()) < 1.1
    inside = float((distance2(with_groups, truth["camera_right_T_arm"]) < INSIDE_95).double().mean())
    assert inside >= 0.85  # of 40; 95 % expected
    assert float((with_groups.groups.halves_sigmas > BOUND).double().mean()) <= 0.05
    torch.testing.assert_close(with_groups.camera_right_T_arm, without.camera_right_T_arm)


@pytest.mark.slow
def test_an_arm_that_rests_is_not_believed_a_dozen_times(right) -> None:
    _, truth, arrays = right
    rested = kinds(resting({key: value[:8] if np.ndim(value) > 1 and len(value) == 40 else value
                            for key, value in arrays.items() if key != "truth"}, 12))  # fmt: skip
    X = truth["camera_right_T_arm"][:8]
    blind, seeing = (solve(rested, SolverSettings(groups=groups)) for groups in (0, 8))
    assert float((distance2(blind, X).sqrt() > BOUND).double().mean()) >= 0.5  # the fault
    assert float(distance2(seeing, X).sqrt().max()) < BOUND
    assert float(seeing.groups.inflation.min()) > 2.0


def test_a_trial_grows_by_itself_alone(right) -> None:
    _, _, arrays = right
    problem = kinds(arrays)
    both, alone = solve(problem.take_trials(slice(0, 4))), solve(problem.take_trials(slice(2, 3)))
    torch.testing.assert_close(both.covariance[2], alone.covariance[0], rtol=1e-7, atol=0.0)
    torch.testing.assert_close(both.groups.group[2], alone.groups.group[0])


def test_few_motions_have_no_groups(right) -> None:
    _, _, arrays = right
    few = solve(kinds(arrays).take_trials(slice(0, 2)).select_motions(slice(0, 64, 4)))
    assert few.groups.count == 0
    assert bool((few.groups.group == -1).all())
    torch.testing.assert_close(few.groups.growth, torch.eye(6, dtype=torch.float64).expand(2, 6, 6))


def test_neighbours_are_grouped() -> None:
    """Three clouds far apart, one point of them not used."""
    generator = torch.Generator().manual_seed(0)
    centres = torch.tensor([[0.0, 0.0], [100.0, 0.0], [0.0, 100.0]], dtype=torch.float64)
    place = (centres[:, None] + torch.randn(3, 5, 2, generator=generator, dtype=torch.float64)).reshape(1, 15, 2)
    used = torch.ones(1, 15, dtype=torch.bool)
    used[0, 7] = False
    group = neighbours(place, used, 3)[0]
    assert group[7] == -1
    clouds = [set(group[start : start + 5].tolist()) - {-1} for start in (0, 5, 10)]
    assert [len(cloud) for cloud in clouds] == [1, 1, 1]
    assert len(set.union(*clouds)) == 3


def knocked(realistic: dict, angle: float, simulate) -> rc.ShaftObservations:
    """64 motions of a still camera, in random order, which is turned by `angle` about z of `arm` after half of them."""
    _, _, arrays = simulate(trials=1, positions_laparoscope=1, positions_instrument=4, **realistic)
    order = np.random.default_rng(0).permutation(64)
    turn = np.eye(4)
    turn[:2, :2] = [[np.cos(angle), np.sin(angle)], [-np.sin(angle), np.cos(angle)]]
    poses = arrays["arm_T_rcm"][0][order]
    poses[32:] = turn @ poses[32:]
    common = ("shaft_radius_mm", "sigma_image", "sigma_kinematics_mm", "sigma_kinematics_rad", "sigma_stereo_mm",
              "sigma_stereo_rad")  # fmt: skip
    return rc.ShaftObservations(
        arm_T_rcm=poses,
        camera_left_T_camera_right=arrays["camera_left_T_camera_right"][0],
        **{key: arrays[key][0][order] for key in ("rcm_v_axis", "rcm_s_end_mm", *POINTS)},
        **{key: float(np.max(arrays[key])) for key in common},
    )


@pytest.mark.slow
@pytest.mark.parametrize("angle", [0.005, 0.05])
def test_a_camera_that_was_knocked_is_told_and_not_believed(simulate, realistic, angle) -> None:
    """A small turn is averaged, a large one leaves half of the motions as outliers: neither may look like an answer."""
    config = parse_config({"solver": {"noise": {"estimate": "never"}}})
    result = rc.solve(knocked(realistic, angle, simulate), config, throw=False)
    assert result.status == "weak"
    assert "the motions before and after motion 32 give different answers" in result.message
    assert result.tests is not None and "moved before motion 32" in result.tests.causes[0]
    change = result.consistency.change
    assert change.sigmas > 5.5
    assert change.rotation_deg == pytest.approx(np.rad2deg(angle), abs=0.5)
    again = rc.CalibrationResult.from_dict(result.to_dict())
    assert again.to_dict()["consistency"] == result.to_dict()["consistency"]


def test_a_camera_that_stands_still_is_believed(simulate, realistic) -> None:
    result = rc.solve(knocked(realistic, 0.0, simulate), throw=False)
    assert result.status == "ok"
    groups = result.consistency.groups
    assert sum(group.motions for group in groups) == int(result.motions.used.sum())


def test_words() -> None:
    assert ranges_in_words([3, 7, 8, 9, 12]) == "3, 7 to 9, 12"
    assert ranges_in_words([1, 3, 5, 7, 9]) == "1, 3, 5, 7, ..."
    assert about_groups(None) == ()
    slight = {"rotation_deg": 0.1, "translation_mm": 0.1, "sigmas": 0.5}
    agreeing = Consistency(
        inflation=1.1, group_by_motion=[], groups=(), halves=Shift(**slight), change=Change(**slight, before_motion=0)
    )
    assert about_groups(agreeing) == ()
