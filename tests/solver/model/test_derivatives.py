"""`solver.derivatives: autograd` against the analytic derivatives: rows, and answers on every kind of measurement."""

from dataclasses import replace

import pytest
import torch

from rmis_calib.solver import SolverSettings, solve
from rmis_calib.solver.model.packing import pack
from rmis_calib.solver.model.parameters import NuisancePriors, initial_state
from rmis_calib.solver.model.residuals import linearise

KINDS = [("axis",), ("contours",), ("ends", "axis"), ("axis", "heads"), ("contours", "ends", "heads")]


@pytest.mark.parametrize("cameras", [1, 2])
def test_rows_agree_where_the_residual_vanishes(simulate, cameras):
    """Away from there they differ by the held factors, times the residual."""
    problem, truth, _ = simulate(trials=1)
    problem = problem.cameras(cameras)
    X = torch.as_tensor(truth["camera_right_T_arm"])
    state = replace(
        initial_state(NuisancePriors.of(problem), X[:, :3, :3], X[:, :3, 3]),
        end_offset=torch.full((1,), truth["shaft_end_offset_mm"], dtype=torch.float64),
    )
    measured = pack(problem, SolverSettings().noise)
    analytic, _ = linearise(measured, state)
    autograd, _ = linearise(replace(measured, autograd=True), state)
    for name in ("r", "w", "a", "radius", "end"):
        expected = getattr(analytic, name)
        scale = float(expected.abs().max().clamp_min(1e-12))
        torch.testing.assert_close(getattr(autograd, name), expected, rtol=0, atol=1e-10 * scale + 1e-14, msg=name)


@pytest.mark.parametrize("kinds", KINDS, ids="-".join)
@pytest.mark.parametrize("cameras", [1, 2])
def test_both_give_the_same_answer(simulate, realistic, kinds, cameras):
    problem, _, _ = simulate(trials=1, **realistic)
    problem = problem.only(*kinds).cameras(cameras)
    tight = SolverSettings(tolerance_sigma=1e-9)
    expected = solve(problem, tight)
    found = solve(problem, replace(tight, derivatives="autograd"))
    gap = (found.camera_right_T_arm - expected.camera_right_T_arm).abs().max()
    assert float(gap) < 1e-8  # mm; and entries of a rotation
    torch.testing.assert_close(found.covariance, expected.covariance, rtol=1e-6, atol=1e-12)
