"""Measurements of the user's own: a head point told as one's own gives what the built-in head point gives."""

from dataclasses import replace

import numpy as np
import pytest
import torch

import rmis_calib as rc
from data_synth.lines import simulate_lines
from data_synth.settings import LineStudyConfig
from rmis_calib.errors import InputError, ShapeError
from rmis_calib.solver import Problem, SolverSettings, solve
from rmis_calib.solver.settings import NoiseSettings, UnknownSettings
from rmis_calib.solver.status import MotionReason

FIXED = SolverSettings(noise=NoiseSettings(estimate="never"), tolerance_sigma=1e-7, bias_correction=False, robust="off")


@pytest.fixture
def arrays(realistic):
    """Two trials, with head points where the shaft was seen, since those built in count nowhere else."""
    arrays = simulate_lines(LineStudyConfig(trials=2, positions_laparoscope=2, positions_instrument=2, **realistic))
    for side in ("right", "left"):
        arrays[f"head_{side}"] = np.where(arrays[f"valid_{side}"][..., None], arrays[f"head_{side}"], np.nan)
    return arrays


def image_of_head(arm_T_rcm, rcm_p_head, xy, sigma, camera="right"):
    """The built-in head point, as a user would write it."""

    def residual(R, t, arm_p_head, xy):
        return rc.residuals.head(R, t, arm_p_head, xy)

    arm_p_head = (arm_T_rcm[..., :3, :3] @ rcm_p_head[..., None])[..., 0] + arm_T_rcm[..., :3, 3]
    return rc.Measurement(
        f"marker {camera}", residual, {"arm_p_head": arm_p_head, "xy": xy}, sigma, camera, "focal lengths"
    )


def both_heads(arrays):
    return [
        image_of_head(arrays["arm_T_rcm"], arrays["rcm_p_head"], arrays[f"head_{side}"], arrays["sigma_image"], side)
        for side in ("right", "left")
    ]


@pytest.mark.parametrize("derivatives", ["analytic", "autograd"])
def test_gives_what_the_built_in_head_point_gives(arrays, derivatives):
    settings = replace(FIXED, derivatives=derivatives)
    problem = Problem.from_arrays(arrays)
    expected = solve(problem.only("contours", "heads"), settings)
    found = solve(problem.only("contours").with_own(both_heads(arrays)), settings)
    torch.testing.assert_close(found.camera_right_T_arm, expected.camera_right_T_arm, rtol=0, atol=1e-7)
    torch.testing.assert_close(found.covariance, expected.covariance, rtol=1e-6, atol=1e-14)
    for camera, side in enumerate(("right", "left")):
        own, built_in = found.residual_own[f"marker {side}"], expected.residual_heads[:, camera]
        torch.testing.assert_close(own, built_in, rtol=1e-6, atol=1e-9, equal_nan=True)


def test_offsets_of_joints_and_clock_move_it_as_they_move_the_shaft(arrays):
    generator = torch.Generator().manual_seed(1)
    problem = Problem.from_arrays(arrays)
    n = problem.n_motions
    scale = torch.tensor([1e-1] * 3 + [5.0] * 3, dtype=torch.float64)
    joint = torch.randn(2, n, 6, 2, generator=generator, dtype=torch.float64) * scale[:, None]
    problem = replace(
        problem,
        joint_derivative=joint,
        clock_derivative=torch.randn(2, n, 6, 2, generator=generator, dtype=torch.float64) * scale[:, None],
        joint_offset_sigma=torch.full((2, 2), 0.05, dtype=torch.float64),
    )
    settings = replace(FIXED, unknowns=UnknownSettings(joint_offsets="always", rcm_offset="always"))
    expected = solve(problem.only("contours", "heads"), settings)
    found = solve(problem.only("contours").with_own(both_heads(arrays)), settings)
    for name in ("joint_offset", "clock", "rcm_offset"):
        gap = (found.nuisances[name].value - expected.nuisances[name].value).abs() / expected.nuisances[name].sigma
        assert float(gap.max()) < 0.01  # rotations of the head vector are of first order there, whole here
    gap = (found.camera_right_T_arm - expected.camera_right_T_arm)[:, :3, 3].norm(dim=-1)
    assert float((gap / expected.translation_sigma_mm).max()) < 0.01


def test_noise_outliers_and_bias_take_it_in(arrays):
    """With everything on the answer is that of the built-in ones; a wrong value costs its motion."""
    own = both_heads(arrays)
    problem = Problem.from_arrays(arrays)
    expected, found = solve(problem.only("contours", "heads")), solve(problem.only("contours").with_own(own))
    gap = (found.camera_right_T_arm - expected.camera_right_T_arm)[:, :3, 3].norm(dim=-1)
    assert float((gap / expected.translation_sigma_mm).max()) < 0.02
    wrong = np.array(own[0].values["xy"])
    wrong[0, 5] += 0.05
    own[0] = replace(own[0], values={**own[0].values, "xy": wrong})
    solution = solve(Problem.from_arrays(arrays).only("contours").with_own(own))
    assert int(solution.reason[0, 5]) in (MotionReason.OUTLIER, MotionReason.OUTLIER_ONE_CAMERA)
    assert bool(solution.converged.all())
    gap = solution.camera_right_T_arm[:, :3, 3] - torch.as_tensor(arrays["truth"]["camera_right_T_arm"][:, :3, 3])
    assert bool((gap.norm(dim=-1) < 3.0 * solution.translation_sigma_mm).all())


def test_gradients_pass_to_its_values(arrays):
    own = both_heads(arrays)[0]
    xy = torch.tensor(own.values["xy"], requires_grad=True)
    problem = Problem.from_arrays(arrays).only("contours")

    def translation(xy):
        measurement = replace(own, values={**own.values, "xy": xy})
        return solve(problem.with_own([measurement]), FIXED, differentiable=True).camera_right_T_arm[:, :3, 3].sum()

    (gradient,) = torch.autograd.grad(translation(xy), xy)
    change = torch.nan_to_num(1e-6 * torch.randn(xy.shape, dtype=xy.dtype, generator=torch.Generator().manual_seed(0)))
    expected = (translation(xy + change) - translation(xy - change)) / 2.0
    torch.testing.assert_close((torch.nan_to_num(gradient) * change).sum(), expected.detach(), rtol=1e-4, atol=0)


@pytest.mark.parametrize(
    ("change", "error", "message"),
    [
        ({"name": "contour"}, InputError, "a name that is not built in"),
        ({"values": {}}, InputError, "values of every motion"),
        ({"sigma": -1.0}, InputError, "sigma: expected positive"),
        (
            {"values": {"arm_p_head": np.zeros((3, 3)), "xy": np.zeros((3, 2))}},
            InputError,
            "arm_p_head: expected shape",
        ),
        ({"residual": lambda R, t, arm_p_head, xy: (t * xy.sum()).sum(-1)}, ShapeError, "expected residuals"),
    ],
)
def test_mistakes_are_named(arrays, change, error, message):
    problem = Problem.from_arrays(arrays).only("contours")
    with pytest.raises(error, match=message):
        solve(problem.with_own([replace(both_heads(arrays)[0], **change)]), FIXED)
