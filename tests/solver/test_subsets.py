"""Any kind of measurement on its own or with others, in any motion and camera, against the simulation's truth."""

from dataclasses import replace

import numpy as np
import pytest
import torch

import rmis_calib as rc
from rmis_calib.config import parse_config
from rmis_calib.errors import InsufficientDataError
from rmis_calib.geometry.rotations import rotation_angle
from rmis_calib.solver import SolverSettings, SolveStatus, solve
from rmis_calib.solver.model.packing import pack
from rmis_calib.solver.start.from_points import point_starts

KINDS = ("axis", "contour", "end", "head")


@pytest.fixture(scope="module")
def moving(simulate, realistic):
    """Both arms move: every single kind fixes the transform."""
    return simulate(trials=3, positions_laparoscope=2, positions_instrument=3, **realistic)


@pytest.fixture(scope="module")
def still(simulate, realistic):
    return simulate(trials=3, positions_laparoscope=1, positions_instrument=5, **realistic)


def gaps(solution, truth):
    """Errors in rad and mm."""
    X, T = torch.as_tensor(truth["camera_right_T_arm"]), solution.camera_right_T_arm
    return rotation_angle(T[:, :3, :3] @ X[:, :3, :3].mT), torch.linalg.vector_norm(T[:, :3, 3] - X[:, :3, 3], dim=-1)


def assert_right(solution, truth, factor=3.5):
    """Converged, and within its own sigmas: 3.5 roots of the trace is further than any axis goes."""
    rad, mm = gaps(solution, truth)
    assert bool((solution.status == SolveStatus.CONVERGED).all()), solution.status
    assert bool((torch.rad2deg(rad) < factor * solution.rotation_sigma_deg).all())
    assert bool((mm < factor * solution.translation_sigma_mm).all())


@pytest.mark.parametrize("cameras", [1, 2])
@pytest.mark.parametrize("kinds", [("heads",), ("ends",), ("ends", "heads"), ("axis", "heads"), ("contours", "heads")])
def test_kinds_without_lines_and_with_them(moving, kinds, cameras):
    problem, truth, _ = moving
    solution = solve(problem.only(*kinds).cameras(cameras))
    assert_right(solution, truth)
    assert bool((solution.rotation_sigma_deg < 0.7).all() & (solution.translation_sigma_mm < 2.0).all())


def test_head_points_of_a_still_laparoscope_are_enough(still):
    problem, truth, _ = still
    solution = solve(problem.only("heads").cameras(1))
    assert_right(solution, truth)
    assert bool((solution.verdict == 0).all())


def test_starts_of_exact_points_are_the_truth(simulate):
    problem, truth, _ = simulate(trials=2, positions_laparoscope=1, positions_instrument=4, random_hand_eye=True)
    R, _ = point_starts(pack(problem.only("heads").cameras(2), SolverSettings().noise), 576, 4)
    X = torch.as_tensor(truth["camera_right_T_arm"])
    angle = rotation_angle(R @ X[:, None, :3, :3].mT)
    index = angle.argmin(-1)
    rows = torch.arange(2)
    # The stereo baseline is left out of the rotation's form: 5 mm of 100 mm in half of the rows.
    assert bool((angle[rows, index] < 0.06).all())
    mono, _ = point_starts(pack(problem.only("heads").cameras(1), SolverSettings().noise), 576, 4)
    assert bool((rotation_angle(mono @ X[:, None, :3, :3].mT).amin(-1) < 1e-5).all())


def test_wrong_head_points_are_rejected(moving):
    problem, truth, _ = moving
    generator = torch.Generator().manual_seed(3)
    head = problem.only("heads").cameras(1).head_xy.clone()
    wrong = torch.randperm(head.shape[2], generator=generator)[: head.shape[2] // 5]
    head[:, :, wrong] = torch.rand((3, 1, len(wrong), 2), generator=generator, dtype=head.dtype) - 0.5
    solution = solve(replace(problem.only("heads").cameras(1), head_xy=head))
    assert_right(solution, truth)
    assert bool((solution.reason[:, wrong] != 0).double().mean() > 0.9)


def test_every_motion_has_its_own_subset(moving):
    """Each measurement of each camera and motion is there with probability 0.4; one camera's axis lines never are."""
    problem, truth, _ = moving
    generator = torch.Generator().manual_seed(1)
    changed = {}
    for kind in KINDS:
        xy = getattr(problem, f"{kind}_xy")
        keep = torch.rand(xy.shape[:3], generator=generator) < 0.4
        if kind == "axis":
            keep[:, 1] = False
        changed[f"{kind}_xy"] = torch.where(keep.view(*keep.shape, *(1,) * (xy.ndim - 3)), xy, torch.nan)
    solution = solve(replace(problem, **changed))
    assert_right(solution, truth)
    measured = sum(((torch.isfinite(x).flatten(3).all(-1)) & problem.valid).any(1) for x in changed.values()) > 0
    assert bool(((solution.reason != 1) == measured).all())  # 1: no camera measured the shaft


def test_a_few_lines_and_a_few_points_together(moving):
    """Four lines, four head points and four ends of different motions, none enough on its own."""
    problem, truth, _ = moving
    changed = {}
    for kind, motions in (("axis", range(0, 160, 40)), ("head", range(3, 160, 40)), ("end", range(7, 160, 40))):
        xy = getattr(problem, f"{kind}_xy")
        keep = torch.zeros(xy.shape[2], dtype=torch.bool)
        keep[list(motions)] = True
        changed[f"{kind}_xy"] = torch.where(keep.view(1, 1, -1, *(1,) * (xy.ndim - 3)), xy, torch.nan)
    solution = solve(replace(problem.only("axis", "ends", "heads"), **changed))
    assert_right(solution, truth, factor=4.0)


def test_too_few_points_are_refused_with_the_reason(moving):
    problem, _, _ = moving
    head = problem.only("heads").cameras(1).head_xy.clone()
    head[:, :, 2:] = torch.nan
    with pytest.raises(InsufficientDataError, match=r"at least 6 measured rows \(3 lines or head points\), found 4"):
        solve(replace(problem.only("heads").cameras(1), head_xy=head))
    with pytest.raises(InsufficientDataError, match="axis lines"):
        solve(problem.only("heads"), method="paper")


def test_an_observations_file_of_head_points_alone(moving):
    _, truth, arrays = moving
    seen = rc.ShaftObservations(
        arm_T_rcm=arrays["arm_T_rcm"][0],
        rcm_v_axis=arrays["rcm_v_axis"][0],
        rcm_p_head=arrays["rcm_p_head"][0],
        head_right=arrays["head_right"][0],
        sigma_image=float(np.squeeze(arrays["sigma_image"])),
    )
    result = rc.solve(seen, parse_config({"measurements": ["heads"]}))
    gap = result.camera_right_T_arm.t.numpy() - truth["camera_right_T_arm"][0, :3, 3]
    assert np.linalg.norm(gap) < 3.5 * result.translation_sigma_mm
    assert result.observability.next_motions
