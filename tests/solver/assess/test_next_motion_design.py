"""Advised motions, made for real in the independent simulation: they keep what was promised, and beat chance."""

from dataclasses import replace

import numpy as np
import pytest
import torch

from rmis_calib.solver import solve
from rmis_calib.solver.assess.next_motion import advise, measured_alike
from tests.benchmarks.bench_solver_advice import SETTINGS as WITH_CORRECTION
from tests.benchmarks.bench_solver_advice import VIEW, left, measure, next_motion, weak_recordings

WITHOUT_DOUBT = replace(WITH_CORRECTION.unknowns, doubt=0.0)
SETTINGS = replace(WITH_CORRECTION, bias_correction=False, groups=0, unknowns=WITHOUT_DOUBT)
WEAK = weak_recordings()


@pytest.fixture(scope="module")
def candidates():
    return np.random.default_rng(9).uniform(-1.0, 1.0, (160, 6))


@pytest.mark.parametrize("weak", WEAK, ids=lambda weak: weak.name.split(",")[0])
def test_the_advised_motion_leaves_what_was_promised_and_beats_chance(weak, candidates):
    advice, before = next_motion(weak, weak.unit, candidates, SETTINGS)
    best = int(advice.chosen[0])
    others = [index for index in np.flatnonzero(advice.visible.numpy()).tolist() if index != best][:5]

    def sigma_with(index):
        return left(weak, np.concatenate((weak.unit, candidates[index : index + 1])), 1, SETTINGS)[0]

    advised, chance = sigma_with(best), [sigma_with(index) for index in others]
    # Predicted from one noisy estimate, then taken from another: 1 to 12 per cent apart.
    assert advised == pytest.approx(float(advice.weakest_mm[1]), rel=0.3)
    assert float(advice.weakest_mm[0]) == pytest.approx(float(before.observability.sigma_mm[0, 0]), rel=1e-6)
    assert advised < 0.6 * float(advice.weakest_mm[0])
    assert sum(advised < other for other in chance) >= 4


def test_one_axis_alone_is_advised_another_axis(candidates):
    """The recording turns the instrument's yaw only: to turn it more is no advice, nor of any use."""
    weak = WEAK[0]
    single = np.kron(np.eye(6), np.linspace(-1.0, 1.0, 9)[:, None])
    advice, _ = next_motion(weak, weak.unit, single, SETTINGS)
    assert int(advice.chosen[0]) // 9 != 3
    yaw = advice.alone_mm[27:36]
    assert float(yaw[torch.isfinite(yaw)].min()) > 0.95 * float(advice.weakest_mm[0])


def test_visible_is_what_the_simulated_camera_sees(candidates):
    weak = WEAK[0]
    wide = 2.5 * candidates
    advice, _ = next_motion(weak, weak.unit, wide, SETTINGS)
    problem, _ = measure(weak, wide, 1)
    seen = problem.valid[0, 0].numpy()
    assert 0.2 < seen.mean() < 0.95
    said = advice.visible.numpy()
    assert seen[said].all()  # the estimate is not the truth: it keeps away from the border...
    assert (said & seen).sum() > 0.7 * seen.sum()  # ...and does not give away much for it


def test_without_any_motion_in_view_nothing_is_advised(candidates):
    weak = WEAK[0]
    problem, _ = measure(weak, weak.unit, 1)
    solution = solve(problem, SETTINGS)
    view = torch.tensor([[5.0, 5.0, 6.0, 6.0]], dtype=torch.float64)
    point = solution.observability.working_point_mm[0]
    advice = advise(measured_alike(problem, 4), solution.posterior, point, view, SETTINGS)
    assert len(advice.chosen) == 0 and not bool(advice.visible.any())
    assert bool(torch.isinf(advice.alone_mm).all())


def test_of_equal_motions_the_easiest_is_advised(candidates):
    weak = WEAK[0]
    advice, solution = next_motion(weak, weak.unit, candidates, SETTINGS)
    at, _ = measure(weak, np.repeat(candidates[advice.chosen.numpy()], 3, axis=0), 1)
    view = torch.tensor([VIEW], dtype=torch.float64)
    point = solution.observability.working_point_mm[0]
    again = advise(at, solution.posterior, point, view, SETTINGS, effort=torch.tensor([3, 1, 2]))
    assert again.chosen.tolist() == [1]


def test_measured_alike_measures_the_same_kinds_with_the_median_sigma():
    problem, _ = measure(WEAK[1], WEAK[1].unit, 1)
    problem.axis_sigma[0, 0, :5] = torch.tensor([1e-4, 2e-4, 3e-4, 4e-4, 5e-4], dtype=torch.float64)
    like = measured_alike(problem, 7, motion=2)
    assert like.n_motions == 7
    torch.testing.assert_close(like.axis_sigma[0, 0], torch.full((7,), 3e-4, dtype=torch.float64))
    assert bool(torch.isfinite(like.axis_xy).all()) and not bool(torch.isfinite(like.contour_xy).any())
    torch.testing.assert_close(like.arm_T_rcm[0, 3], problem.arm_T_rcm[0, 2])
