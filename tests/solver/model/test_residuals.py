"""Residuals and analytic Jacobians against plain geometry and torch.func.jacrev."""

from dataclasses import replace

import numpy as np
import pytest
import torch

from rmis_calib.geometry.lines import contour_planes
from rmis_calib.geometry.rotations import rotvec_to_matrix
from rmis_calib.solver import Problem, SolverSettings
from rmis_calib.solver.model import predicted_shaft, residuals
from rmis_calib.solver.model.jacobian import columns
from rmis_calib.solver.model.measurement_rows import END, HEAD, LINE
from rmis_calib.solver.model.packing import pack
from rmis_calib.solver.model.parameters import NuisancePriors, initial_state, make_layout
from rmis_calib.solver.model.residuals import linearise, residual_rows
from rmis_calib.solver.settings import UnknownSettings

EVERYTHING = UnknownSettings(
    rcm_offset="always",
    joint_offsets="always",
    clock=True,
    clock_rate="always",
    readout="always",
    setup="prior",
    compliance="always",
)


@pytest.fixture(scope="module")
def scene(simulate):
    problem, truth, _ = simulate(trials=1)
    n = problem.n_motions
    generator = torch.Generator().manual_seed(1)
    joint = torch.randn(1, n, 6, 2, generator=generator, dtype=torch.float64)
    clock = torch.randn(1, n, 6, 2, generator=generator, dtype=torch.float64)
    head = problem.rcm_p_head + torch.tensor([3.0, -2.0, 0.5])  # off the axis, so that turning about it shows
    one = torch.full((1,), 0.05, dtype=torch.float64)  # an exact stereo pair would not be refined
    problem = replace(
        problem,
        noise=replace(
            problem.noise,
            stereo_mm=one,
            stereo_rad=one,
            edge_bias=1e-3 * one,
            focal=one,
            centre=one,
            lens=one,
            readout=one,
        ),
        joint_derivative=joint,
        clock_derivative=clock,
        joint_offset_sigma=torch.ones(1, 2, dtype=torch.float64),
        rcm_p_head=head,
    )
    X = torch.as_tensor(truth["camera_right_T_arm"])
    measured = pack(problem, SolverSettings().noise)
    state = initial_state(NuisancePriors.of(problem), X[:, :3, :3], X[:, :3, 3])
    return (
        problem,
        measured,
        replace(state, end_offset=torch.full((1,), truth["shaft_end_offset_mm"], dtype=torch.float64)),
        truth,
    )


def test_exact_measurements_have_no_residual(simulate):
    problem, truth, _ = simulate(trials=1)
    X = torch.as_tensor(truth["camera_right_T_arm"])
    measured = pack(problem, SolverSettings().noise)
    state = replace(
        initial_state(NuisancePriors.of(problem), X[:, :3, :3], X[:, :3, 3]),
        end_offset=torch.full((1,), truth["shaft_end_offset_mm"], dtype=torch.float64),
    )
    assert measured.row_kind == (LINE,) * 8 + (END,) * 2 + (HEAD,) * 4
    assert float(residual_rows(measured, state).abs().max()) < 1e-12


def test_line_residual_is_distance_to_contour(scene):
    """Against geometry.lines: the signed distance of the measured point from the line that the contour plane cuts out
    of the image."""
    problem, measured, state, _ = scene
    moved = state.moved(
        {
            "rotation": torch.full((1, 3), 0.01, dtype=torch.float64),
            "translation": torch.full((1, 3), 0.5, dtype=torch.float64),
        }
    )
    A = problem.arm_T_rcm[0]
    p = (moved.R[0] @ A[:, :3, 3].T).T + moved.t[0]
    v = (moved.R[0] @ (A[:, :3, :3] @ problem.rcm_v_axis[0][..., None])[..., 0].T).T
    planes = contour_planes(p, v, moved.radius)  # (n, 2, 3)
    lines = planes / torch.linalg.vector_norm(planes[..., :2], dim=-1, keepdim=True)
    xy = problem.contour_xy[0, 0]
    expected = (lines[:, :, None, :2] * xy).sum(-1) + lines[:, :, None, 2]  # (n, edge, point)
    rows = residual_rows(measured, moved)[
        : 8 : measured.cameras, 0
    ]  # right camera: edge 0 points 0, 1; edge 1 points 0, 1
    expected = expected.permute(1, 2, 0).flatten(0, 1)
    expected = torch.where(torch.isnan(expected), 0.0, expected)  # out of the picture
    torch.testing.assert_close(rows, expected, atol=1e-13, rtol=1e-9)


def test_hand_derived_line_residual():
    """A shaft along +x, 100 mm in front of the camera, radius 4: contours at y = -+ 4/sqrt(100^2 - 4^2); a point 0.01
    below the upper edge (edge 0, y down) is at residual +0.01, and dz of the camera's arm by 1 mm towards the far side
    narrows the edges by about 4/100^2."""
    edge = 4.0 / np.sqrt(100.0**2 - 16.0)
    contour = np.array([[[-0.2, -edge + 0.01], [0.3, -edge + 0.01]], [[-0.2, edge], [0.3, edge]]])
    arrays = {
        "arm_T_rcm": np.tile(np.eye(4), (3, 1, 1)), "rcm_v_axis": np.tile([1.0, 0.0, 0.0], (3, 1)),
        "contour_right": np.tile(contour, (3, 1, 1, 1)), "shaft_radius_mm": 4.0,
    }  # fmt: skip
    problem = Problem.from_arrays(arrays).flatten_batch()
    measured = pack(problem, SolverSettings().noise)
    state = initial_state(
        NuisancePriors.of(problem),
        torch.eye(3, dtype=torch.float64)[None],
        torch.tensor([[-30.0, 0.0, 100.0]], dtype=torch.float64),
    )
    assert residual_rows(measured, state)[:, 0, 0].tolist() == pytest.approx([0.01, 0.01, 0.0, 0.0], abs=1e-12)
    rows, _ = linearise(measured, state)
    slope = 100.0 * 4.0 / (100.0**2 - 16.0) ** 1.5  # d(edge)/dz
    assert rows.w[2, :, 0, 0].tolist() == pytest.approx(
        [-slope, -slope, slope, slope], rel=1e-3
    )  # the counter-sign would say that shafts grow with distance


def test_jacobian_of_every_unknown_equals_autodiff(scene):
    problem, measured, state, _ = scene
    settings = SolverSettings(unknowns=EVERYTHING)
    layout = make_layout(NuisancePriors.of(problem), measured, state, settings.unknowns, settings.noise)
    assert list(layout.blocks) == [
        "rotation", "translation", "stereo_rotation", "stereo_translation", "radius", "end_offset", "rcm_offset",
        "joint_offset", "clock", "clock_rate", "readout", "edge_bias", "intrinsics", "setup", "compliance",
    ]  # fmt: skip
    exact = replace_measurements(measured, state)
    rows, shaft = linearise(exact, state)
    analytic = columns(layout, rows, shaft, exact, state)[:, :, 0]  # (k, p, n)

    def residuals(delta):
        return residual_rows(exact, forced(state, layout, delta))[:, 0]

    numeric = torch.func.jacrev(residuals)(torch.zeros(1, layout.size, dtype=torch.float64))[:, :, 0].permute(0, 2, 1)
    scale = numeric.abs().amax((0, 2), keepdim=True)
    assert float(((analytic - numeric) / scale).abs().max()) < 1e-9


def replace_measurements(measured, state):
    """Head rows of the shifted head point become exact, so that the Jacobian of first order is the whole Jacobian."""
    heads = slice(-2 * measured.cameras, None)
    r = residual_rows(measured, state)[heads].view(2, measured.cameras, *measured.p.shape[1:])
    return replace(measured, head_xy=measured.head_xy - r)


def forced(state, layout, delta):
    """`State.moved`, with offsets that autodiff sees although they are zero."""
    tiny = 1e-300
    step = layout.step(delta + tiny)
    return state.moved(step)


def test_rotation_moves_the_estimate_on_the_left(scene):
    """R = exp(dphi) R^ and t = t^ + dt: the convention of the covariance."""
    _, _, state, _ = scene
    phi = torch.tensor([[0.1, -0.2, 0.3]], dtype=torch.float64)
    moved = state.moved({"rotation": phi, "translation": torch.ones(1, 3, dtype=torch.float64)})
    torch.testing.assert_close(moved.R, rotvec_to_matrix(phi) @ state.R)
    torch.testing.assert_close(moved.t, state.t + 1.0)


def test_absent_measurements_have_zero_rows(simulate):
    problem, _, _ = simulate(trials=1)
    contour = problem.contour_xy.clone()
    contour[:, 0, 5] = torch.nan  # falls back to the axis line
    axis = problem.axis_xy.clone()
    axis[:, 0, 6] = torch.nan
    contour[:, 0, 6] = torch.nan  # nothing left in the right camera
    measured = pack(replace(problem, contour_xy=contour, axis_xy=axis), SolverSettings().noise)
    right = measured.line_ok[:, 0, 0]
    assert right[:, 4].tolist() == [True] * 4
    assert right[:, 5].tolist() == [True, True, False, False]
    assert measured.line_rho[:, 0, 0, 5].tolist() == [0.0] * 4
    assert right[:, 6].tolist() == [False] * 4


def test_edges_are_put_into_canonical_order(simulate):
    problem, _, arrays = simulate(trials=1)
    swapped = dict(arrays) | {
        f"contour_{side}": arrays[f"contour_{side}"][:, :, ::-1].copy() for side in ("right", "left")
    }
    torch.testing.assert_close(Problem.from_arrays(swapped).contour_xy, problem.contour_xy, equal_nan=True)


def test_offsets_of_zero_change_nothing_where_they_are_not_looked_at(scene, monkeypatch):
    """As on an accelerator, where asking whether they are zero would wait for all that is queued."""
    _, measured, state, _ = scene
    rows, linear = residual_rows(measured, state), linearise(measured, state)[0]
    for module in (predicted_shaft, residuals):
        monkeypatch.setattr(module, "matters", lambda offset: True)
    torch.testing.assert_close(residual_rows(measured, state), rows, rtol=0, atol=1e-15)
    again = linearise(measured, state)[0]
    for name in ("r", "w", "a", "radius", "end"):
        torch.testing.assert_close(getattr(again, name), getattr(linear, name), rtol=1e-12, atol=1e-12)
