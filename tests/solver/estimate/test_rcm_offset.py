"""An instrument's shaft that misses its nominal RCM."""

from dataclasses import replace

import torch

from rmis_calib.solver import SolverSettings, solve
from rmis_calib.solver.settings import UnknownSettings


def test_rcm_offset_needs_nothing_but_the_observations(simulate, realistic):
    """The shaft misses the nominal RCM by 1.5 and -1 mm across its axis, in a plane fixed to `rcm`."""
    problem, truth, _ = simulate(trials=4, positions_laparoscope=2, positions_instrument=4, **realistic)
    v, R = problem.rcm_v_axis, problem.arm_T_rcm[..., :3, :3]
    x = torch.eye(3, dtype=v.dtype)[0].expand_as(v)
    e1 = torch.nn.functional.normalize(x - (x * v).sum(-1, keepdim=True) * v, dim=-1)
    e2 = torch.linalg.cross(v, e1)
    T = problem.arm_T_rcm.clone()
    T[..., :3, 3] -= (R @ (1.5 * e1 - 1.0 * e2)[..., None])[..., 0]
    moved = replace(problem, arm_T_rcm=T, laparoscope_base_T_arm=None).only("contours", "ends")
    X = torch.as_tensor(truth["camera_right_T_arm"])[:, :3, 3]
    alone = {"radius_sigma_relative": 0.0, "compliance": "never"}
    found = solve(moved, SolverSettings(unknowns=UnknownSettings(rcm_offset="always", **alone)))
    ignored = solve(moved, SolverSettings(unknowns=UnknownSettings(**alone)))
    offset = found.nuisances["rcm_offset"]
    assert bool(((offset.value - offset.value.new_tensor([1.5, -1.0])).abs() < 4.0 * offset.sigma).all())
    assert not bool(offset.held.any())
    gap, without = (torch.linalg.vector_norm(s.camera_right_T_arm[:, :3, 3] - X, dim=-1) for s in (found, ignored))
    assert bool((gap < 4.0 * found.translation_sigma_mm).all())
    assert float(without.mean()) > 2.0 * float(gap.mean())
