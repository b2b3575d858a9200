"""Gradients through the whole solve, held against finite differences of the whole solve."""

from dataclasses import replace

import numpy as np
import pytest
import torch

import rmis_calib as rc
from data_synth.lines import simulate_lines
from data_synth.settings import LineStudyConfig
from rmis_calib.config import parse_config
from rmis_calib.errors import InputError
from rmis_calib.solver import Problem, SolverSettings, solve
from rmis_calib.solver.settings import NoiseSettings, UnknownSettings

STEP = 1e-3
CHANGES = {
    "arm_T_rcm": 0.1, "rcm_v_axis": 1e-3, "camera_T_camera_right": 0.02, "axis_xy": 3e-4, "contour_xy": 3e-4,
    "end_xy": 3e-4, "head_xy": 3e-4, "radius_mm": 1e-2,
}  # fmt: skip
"""What is differentiated by, and how large a change of it is as large as noise."""
NO_DOUBT = UnknownSettings(doubt=0.0)  # what the covariance allows for besides is held
PLAIN = SolverSettings(
    robust="off", bias_correction=False, noise=NoiseSettings(estimate="never"), unknowns=NO_DOUBT, groups=0
)
CASES = {
    "paper": ("paper", SolverSettings()),
    "global": ("global", SolverSettings()),
    "joint, noise known": ("joint", PLAIN),
    "joint, bias": ("joint", replace(PLAIN, bias_correction=True)),
    "joint, noise estimated": ("joint", replace(PLAIN, noise=NoiseSettings(estimate="always"))),
    "joint, everything": ("joint", SolverSettings(noise=NoiseSettings(estimate="always"), unknowns=NO_DOUBT, groups=0)),
    "joint, thinned": ("joint", replace(PLAIN, thin_to=30)),
}


@pytest.fixture(scope="module")
def scene(realistic):
    """Two trials of 64 motions; one contour and one end were not measured."""
    arrays = simulate_lines(
        LineStudyConfig(trials=2, positions_laparoscope=2, positions_instrument=2, rotation_range_deg=20, **realistic)
    )
    arrays["contour_left"][0, 3] = np.nan
    arrays["end_right"][1, 5] = np.nan
    return Problem.from_arrays(arrays)


def summary(solution):
    """One number for rotation, translation and the sigma of each, per trial."""
    T, sigma = solution.camera_right_T_arm, solution.covariance.diagonal(dim1=-2, dim2=-1).sqrt()
    mix = T.new_tensor([[0.3, -1.1, 0.7], [1.3, 0.2, -0.4], [-0.6, 0.9, 1.0]])
    parts = ((T[:, :3, :3] * mix).sum((1, 2)), (T[:, :3, 3] * mix[0]).sum(1), sigma[:, :3].sum(1), sigma[:, 3:].sum(1))
    return torch.stack(parts, dim=-1)


@pytest.mark.parametrize("case", CASES)
def test_gradients_are_those_of_the_whole_solve(scene, case):
    method, settings = CASES[case]
    problem = scene.take_trials(slice(0, 1)) if settings.thin_to else scene
    generator = torch.Generator().manual_seed(0)
    base = {name: getattr(problem, name) for name in CHANGES}
    change = {
        name: CHANGES[name] * torch.randn(value.shape, generator=generator, dtype=value.dtype)
        for name, value in base.items()
    }
    for name in ("arm_T_rcm", "camera_T_camera_right"):
        change[name][..., :, :3] = 0.0  # rotations stay rotations; positions move
    change["camera_T_camera_right"][:, 0] = 0.0

    def solved(h):
        at = {name: (value + h * change[name]).requires_grad_() for name, value in base.items()}
        return at, summary(solve(replace(problem, **at), settings, method, differentiable=True))

    at, values = solved(0.0)
    found = []
    for value in values.unbind(-1):
        gradients = torch.autograd.grad(value.sum(), list(at.values()), retain_graph=True, allow_unused=True)
        along = [
            (gradient * change[name]).flatten(1).sum(1) if gradient.ndim > 1 else gradient * change[name]
            for name, gradient in zip(at, gradients, strict=True)
            if gradient is not None
        ]
        assert all(bool(torch.isfinite(x).all()) for x in along)
        found.append(torch.stack(along).sum(0))
    expected = (solved(STEP)[1] - solved(-STEP)[1]).detach() / (2.0 * STEP)
    torch.testing.assert_close(torch.stack(found, dim=-1), expected, rtol=1e-4, atol=0)


@pytest.mark.parametrize("method", ["paper", "global", "joint"])
def test_the_answer_is_that_of_the_plain_solve(scene, method):
    """To a small part of sigma: noise levels and the last step are carried to their end here."""
    plain = solve(scene, SolverSettings(), method)
    found = solve(scene, SolverSettings(), method, differentiable=True)
    gap = (found.camera_right_T_arm - plain.camera_right_T_arm).detach()
    assert float(gap[:, :3, 3].norm(dim=-1).max()) < 0.01 * float(plain.translation_sigma_mm.min())
    torch.testing.assert_close(found.covariance.detach(), plain.covariance, rtol=0.02, atol=1e-9)
    torch.testing.assert_close(found.status, plain.status)


def test_a_rejected_outlier_has_no_gradient(realistic):
    arrays = simulate_lines(LineStudyConfig(trials=1, positions_laparoscope=2, positions_instrument=2, **realistic))
    arrays["contour_right"][0, 7] += 0.05
    problem = Problem.from_arrays(arrays).only("contours")
    contour = problem.contour_xy.clone().requires_grad_()
    solution = solve(replace(problem, contour_xy=contour), SolverSettings(), differentiable=True)
    (gradient,) = torch.autograd.grad(solution.camera_right_T_arm.square().sum(), contour)
    size = torch.nan_to_num(gradient).abs().amax((-3, -2, -1))[0, 0]
    assert int(solution.reason[0, 7]) != 0
    assert float(size[7]) < 1e-4 * float(size.median())


def test_observations_as_a_mapping_of_tensors(realistic):
    arrays = simulate_lines(LineStudyConfig(trials=3, positions_laparoscope=2, positions_instrument=2, **realistic))
    arrays["contour_right"] = torch.tensor(arrays["contour_right"], requires_grad=True)
    solution = rc.solve(arrays, parse_config({"measurements": ["contours"]}), differentiable=True)
    assert solution.camera_right_T_arm.shape == (3, 4, 4)
    solution.rotation_sigma_deg.sum().backward()
    assert arrays["contour_right"].grad.abs().sum() > 0


def test_kinematics_are_refused(scene):
    with pytest.raises(InputError, match="differentiable: expected a solve without kinematics"):
        solve(scene, kinematics=lambda joint, clock: scene, differentiable=True)


@pytest.mark.skipif(not torch.cuda.is_available(), reason="no CUDA device on this machine")
@pytest.mark.parametrize("method", ["paper", "global", "joint"])
def test_gradients_on_cuda_are_those_of_the_cpu(realistic, method):
    arrays = simulate_lines(LineStudyConfig(trials=2, positions_laparoscope=2, positions_instrument=2, **realistic))

    def gradient(device):
        problem = Problem.from_arrays(arrays, device=device)
        axis, contour = (getattr(problem, name).clone().requires_grad_() for name in ("axis_xy", "contour_xy"))
        at = replace(problem, axis_xy=axis, contour_xy=contour)
        summed = summary(solve(at, PLAIN, method, differentiable=True)).sum()
        return torch.autograd.grad(summed, contour if method == "joint" else axis)[0].cpu()

    torch.testing.assert_close(gradient("cuda"), gradient("cpu"), rtol=1e-6, atol=1e-9, equal_nan=True)
