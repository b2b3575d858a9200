"""The one list of tests: quiet where the model is right, loud where it is not, and corrected for its length."""

import numpy as np
import pytest
import torch

from data_synth.lines import simulate_lines
from data_synth.settings import LineStudyConfig
from rmis_calib.config import parse_config
from rmis_calib.pipeline.answer.records.tests_in_words import about_neighbours
from rmis_calib.results import ResidualTest, Tests
from rmis_calib.solver import Problem, Solution, solve
from rmis_calib.solver.assess.residual_tests import residual_tests
from rmis_calib.solver.assess.tested_over import over_of_solution
from rmis_calib.solver.assess.tested_residuals import TestedResiduals
from rmis_calib.solver.observability import Verdict
from rmis_calib.solver.test_list import ANSWER, HALVES, LEVEL, TestList, TestName

SETTINGS = parse_config({"solver": {"groups": 8}}).solver
FOCAL_PX = 800.0


def scene(trials: int, motions: int = 120) -> dict:
    noise = {"pixel_noise_px": 0.3, "kinematics_noise_mm": 0.3, "kinematics_noise_deg": 0.1}
    config = LineStudyConfig(
        trials=trials,
        motion="random",
        random_motions=motions,
        seed=11,
        stereo_noise_mm=0.05,
        stereo_noise_deg=0.05,
        **noise,
    )
    return {key: value for key, value in simulate_lines(config).items() if key != "truth" and "head" not in key}


def solved(arrays: dict) -> tuple[Solution, TestList]:
    found = solve(Problem.from_arrays(arrays).only("axis", "contours", "ends"), SETTINGS)
    assert found.tests is not None
    return found, found.tests


def moved(arrays: dict, by_motion_px: np.ndarray, names: tuple[str, ...] = ("contour_right",)) -> dict:
    """With points moved across the picture, right by this many pixels in each motion."""
    off = np.zeros((len(by_motion_px), 2))
    off[:, 0] = by_motion_px / FOCAL_PX
    return arrays | {name: arrays[name] + off.reshape(1, len(off), *[1] * (arrays[name].ndim - 3), 2) for name in names}


def test_the_right_model_passes_and_its_statistics_are_standard_normal() -> None:
    found, tests = solved(scene(60))
    assert not bool(tests.failed.any()) and bool((found.verdict == Verdict.TRUSTWORTHY.code).all())
    of_residuals = [index for index, name in enumerate(tests.names) if name.kind != ANSWER and name.over != "time step"]
    z = tests.statistic[:, of_residuals]
    z = z[torch.isfinite(z)]
    assert len(z) > 60 * 100
    assert abs(float(z.mean())) < 0.1 and 0.9 < float(z.std()) < 1.1
    assert 0.003 < float((z.abs() > 2.576).double().mean()) < 0.02


def test_a_camera_that_is_knocked_is_told_with_the_motion_and_takes_ok_away() -> None:
    arrays = moved(scene(4), 1.5 * (np.arange(120) >= 70), ("contour_right", "axis_right", "end_right"))
    found, tests = solved(arrays)
    steps = [
        index
        for index, name in enumerate(tests.names)
        if name.over == "time step" and bool(tests.failed[:, index].any())
    ]
    assert steps and bool(tests.failed.any(-1).all())
    clearest = tests.chance[:, steps].argmin(-1)
    at = tests.at[:, steps].gather(1, clearest[:, None])
    assert bool(((at - 70).abs() <= 10).all())
    assert not bool((found.verdict == Verdict.TRUSTWORTHY.code).any())


def test_errors_that_neighbours_in_time_share_are_told() -> None:
    """A wander of some pixels with a memory of 8 motions, which no trend or step describes."""
    generator, wander = np.random.default_rng(3), np.zeros(120)
    for i in range(1, 120):
        wander[i] = 0.88 * wander[i - 1] + 1.5 * generator.standard_normal()
    _, tests = solved(moved(scene(4), wander))
    assert any(
        bool(tests.fails(f"{kind}_right", "neighbours in time").any()) for kind in ("shift", "width", "taper", "turn")
    )


def test_noise_below_what_is_stated_does_not_make_neighbours_alike() -> None:
    """What the fit takes of the residuals goes with the stated noise, their products with the real one: a tenth."""
    arrays = scene(30, 40)
    stated = {key: 10.0 * arrays[key] for key in arrays if key.startswith(("sigma_image", "sigma_kinematics"))}
    settings = parse_config({"solver": {"groups": 8, "noise": {"estimate": "never"}}}).solver
    tests = solve(Problem.from_arrays(arrays | stated).only("axis", "contours", "ends"), settings).tests
    assert len(stated) == 3 and tests is not None
    for index, name in enumerate(tests.names):
        if name.over.startswith("neighbours"):
            assert not bool(tests.failed[:, index].any()), name


def test_motions_at_one_place_count_as_one() -> None:
    """10 stops of 12 frames share their errors of the kinematics: told once, they are no evidence."""
    arrays = scene(30)
    by_motion = [key for key, value in arrays.items() if isinstance(value, np.ndarray) and value.shape[1:2] == (120,)]
    rested = arrays | {key: np.repeat(arrays[key][:, ::12], 12, axis=1) for key in by_motion}
    generator = np.random.default_rng(5)
    for name in ("contour_right", "contour_left", "end_right", "end_left"):
        rested[name] = rested[name] + generator.normal(0.0, 0.3 / FOCAL_PX, rested[name].shape)
    _, tests = solved(rested)
    residuals = torch.stack([tests.failed[:, i] for i, name in enumerate(tests.names) if name.kind != ANSWER], dim=-1)
    assert not bool(residuals.any())


def test_correction_by_hand() -> None:
    """Two halves have half of the level; two other tests share 0.4 of it."""
    names = (TestName(ANSWER, HALVES), TestName("a", "mean"), TestName("b", "mean"), TestName("c", "mean"))
    chance = torch.tensor([[0.001, 1e-5, 0.5, torch.nan]], dtype=torch.float64)
    tests = TestList(names, torch.ones_like(chance), chance, torch.full((1, 4), -1))
    # a: 1e-5 / 0.2 x (0.2 + 0.5 + 0.2); halves: 0.001 / 0.5 x (0.5 + 0.2); b: 0.5 / 0.2 x 0.2
    assert tests.corrected[0, :3].tolist() == pytest.approx([0.0014, 4.5e-5, 0.5])
    assert bool(tests.corrected[0, 3].isnan())
    assert tests.failed.tolist() == [[True, True, False, False]] and LEVEL == 0.005


def test_further_residuals_join_the_list() -> None:
    """Residuals that are no rows of the estimate, here with a trend over the first angle of the instrument."""
    arrays = scene(3)
    problem = Problem.from_arrays(arrays).only("axis", "contours", "ends")
    found, tests = solved(arrays)
    over = over_of_solution(found, problem, SETTINGS.noise)
    generator = torch.Generator().manual_seed(1)
    noise = torch.randn(2, 3, 120, generator=generator, dtype=torch.float64)
    values = 0.4 * noise + torch.stack((torch.zeros_like(noise[0]), 0.6 * over.joints[0]))
    values[0, :, 5] = torch.nan
    more = TestedResiduals.of_values(("profile_right", "profile_left"), (0, 1), values, torch.ones_like(values))
    joined = tests.joined(residual_tests(more, over))
    assert not bool(joined.fails("profile_right", "angle 1").any()) and bool(
        joined.fails("profile_left", "angle 1").all()
    )
    assert len(joined.names) > len(tests.names) and joined.corrected.shape == (3, len(joined.names))


def test_neighbours_alone_do_not_take_ok_away_and_are_said() -> None:
    names = (TestName("taper_right", "neighbours in time"), TestName("taper_right", "mean"))
    chance = torch.tensor([[1e-6, 0.5], [0.5, 1e-6]], dtype=torch.float64)
    tests = TestList(names, torch.full_like(chance, 4.8), chance, torch.full((2, 2), -1))
    assert tests.failed.tolist() == [[True, False], [False, True]]
    assert tests.against.tolist() == [[False, False], [False, True]]
    listed = Tests(
        LEVEL,
        tuple(
            ResidualTest(name.kind, name.over, 4.8, p, p < LEVEL and name.over == "mean", None, f"{name.over} in words")
            for name, p in zip(names, chance[0].tolist(), strict=True)
        ),
        (),
    )
    assert about_neighbours(listed) == (
        "Neighbours in time in words (+4.8 sigmas): sigmas count such motions together.",
    )
    assert about_neighbours(None) == ()
