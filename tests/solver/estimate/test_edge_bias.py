"""Shifts of contour points that every picture shares: left alone they bias the answer, estimated they do not."""

from dataclasses import replace

import numpy as np
import torch

from rmis_calib.geometry.rotations import matrix_to_rotvec
from rmis_calib.solver import Problem, SolverSettings, solve
from rmis_calib.solver.settings import UnknownSettings

FOCAL_PX = 1000.0
OUTWARD = np.array([-1.8, 1.2])[:, None]  # of each edge, px: away from the axis, and towards it
KNOWN = UnknownSettings(radius_sigma_relative=0.0, compliance="never")


def shifted(arrays: dict) -> dict:
    """Every contour moved across itself, outwards where positive: by hand, in image coordinates."""
    out = dict(arrays)
    for side in ("right", "left"):
        contour = arrays[f"contour_{side}"]  # (trials, n, edge, point, xy), point 0 on the RCM's side
        along = contour[..., 1, :] - contour[..., 0, :]
        along = along / np.linalg.norm(along, axis=-1, keepdims=True)
        left_hand = np.stack([along[..., 1], -along[..., 0]], axis=-1)  # x right, y down
        outwards = left_hand * np.array([1.0, -1.0])[:, None]
        out[f"contour_{side}"] = contour + (OUTWARD / FOCAL_PX * outwards)[..., None, :]
    return out


def test_shift_shared_by_all_pictures_is_estimated(simulate, realistic):
    good = realistic | {"kinematics_noise_mm": 0.05, "kinematics_noise_deg": 0.02}  # noise that does not hide the shift
    _, truth, arrays = simulate(trials=8, positions_laparoscope=3, positions_instrument=2, **good)
    X = torch.as_tensor(truth["camera_right_T_arm"])

    def rms_deg(problem: Problem, unknowns: UnknownSettings) -> tuple[float, float]:
        solution = solve(problem.with_exact_setup(), SolverSettings(unknowns=unknowns, groups=0))
        turn = matrix_to_rotvec(solution.camera_right_T_arm[:, :3, :3] @ X[:, :3, :3].mT)
        error = float(torch.rad2deg(turn.square().sum(-1).mean().sqrt()))
        return error, float(solution.rotation_sigma_deg.mean())

    clean = Problem.from_arrays(arrays).only("contours")
    shared = Problem.from_arrays(shifted(arrays) | {"sigma_edge_bias": 2.0 / FOCAL_PX}).only("contours")
    without, _ = rms_deg(clean, KNOWN)
    ignored, claimed = rms_deg(shared, replace(KNOWN, edge_bias=False))
    estimated, sigma = rms_deg(shared, KNOWN)
    assert ignored > 4.0 * without and ignored > 4.0 * claimed
    assert estimated < 0.6 * ignored
    assert estimated < 1.5 * sigma  # the covariance knows the price


def test_estimated_shift_is_the_true_one(simulate):
    problem, _, arrays = simulate(trials=1, positions_laparoscope=3, positions_instrument=3)
    solution = solve(Problem.from_arrays(shifted(arrays) | {"sigma_edge_bias": 5.0 / FOCAL_PX}).only("contours"))
    found = solution.nuisances["edge_bias"].value[0].reshape(2, 2, 2) * FOCAL_PX  # edge, point, camera
    # The unknown is added to the residual, the distance on the side of edge 0's outside: it undoes the shift.
    expected = torch.as_tensor(OUTWARD * np.array([1.0, -1.0])[:, None])[..., None].expand(2, 2, 2)
    torch.testing.assert_close(found.abs(), expected.abs(), atol=0.02, rtol=0.0)
    assert problem.n_motions == solution.reason.shape[-1]
