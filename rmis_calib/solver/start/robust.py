"""Starts that survive many wrong lines: least absolute deviations on SO(3), from the whole covering grid.

sum |n.R v| is minimised by reweighting: each candidate rotation carries its own weights 1/max(|n.R v|, floor), hence
its own 9x9 Gram matrix, one matrix product for all of them. The median-like cost keeps its minimum with 40 % of wrong
lines, where the squared cost loses it.
"""

import torch
from jaxtyping import Float
from torch import Tensor

from rmis_calib.geometry.rotations import rotvec_to_matrix
from rmis_calib.solver.problem import Problem
from rmis_calib.solver.start.candidates import Candidates, cheirality
from rmis_calib.solver.start.line_statistics import LineStatistics, plane_normals
from rmis_calib.solver.start.rotation_search import derivatives, distinct_minima, newton_step, rotation_grid, vec

FLOOR = 5e-3
"""Sine below which errors count as equal (0.3 degrees): about the noise of a plane."""
KEPT = 64
REWEIGHTINGS = 15


def robust_candidates(problem: Problem, grid: int, minima: int) -> Candidates:
    """Distinct minima of sum |n.R v|, each with the t that minimises sum |n.(R p + t + o)|; best by absolute cost."""
    n, _, ok = plane_normals(problem)
    b = n.shape[0]
    v = (problem.arm_T_rcm[..., :3, :3] @ problem.rcm_v_axis[..., None])[..., 0][:, None].expand_as(n).flatten(1, 2)
    p = problem.arm_T_rcm[..., :3, 3][:, None].expand_as(n).flatten(1, 2)
    known = ok.flatten(1).to(n.dtype)
    normals = n.flatten(1, 2)
    rows = (v[..., :, None] * normals[..., None, :]).flatten(-2) * known[..., None]  # (b, c n, 9)
    products = (rows[..., :, None] * rows[..., None, :]).flatten(-2)
    R = rotation_grid(grid, n)
    cost = (vec(R) @ rows.mT).abs().sum(-1)
    kept = cost.topk(min(KEPT, grid), dim=-1, largest=False).indices
    R = R[kept]
    for _ in range(REWEIGHTINGS):
        weight = 1.0 / (vec(R) @ rows.mT).abs().clamp_min(FLOOR)  # (b, g, c n)
        gram = (weight @ products).unflatten(-1, (9, 9)).flatten(0, 1)
        _, gradient, hessian, gauss_newton = derivatives(gram, R.flatten(0, 1)[:, None])
        R = (rotvec_to_matrix(newton_step(gradient, hessian, gauss_newton))[:, 0] @ R.flatten(0, 1)).unflatten(
            0, (b, -1)
        )
    cost = (vec(R) @ rows.mT).abs().sum(-1)
    R, cost = distinct_minima(R, cost, minima)
    statistics = LineStatistics.from_problem(problem)
    offset = statistics.offset[:, :, None].expand_as(n).flatten(1, 2)
    t, gap = _absolute_translation(normals, p, offset, known, R)
    reach = torch.linalg.vector_norm(p.mean(1)[:, None, None] @ R.mT + t[:, :, None], dim=-1)[..., 0].clamp_min(1.0)
    total = known.sum(-1, keepdim=True).clamp_min(1.0)
    return Candidates(R, t, cost / total + gap / (reach * total), cheirality(statistics, R, t))


def _absolute_translation(
    n: Float[Tensor, "b k 3"],
    p: Float[Tensor, "b k 3"],
    offset: Float[Tensor, "b k 3"],
    known: Float[Tensor, "b k"],
    R: Float[Tensor, "b m 3 3"],
) -> tuple[Float[Tensor, "b m 3"], Float[Tensor, "b m"]]:
    """t that minimises sum |n.(R p + t + o)| by reweighting, and that sum, mm."""
    constant = ((p[:, None] @ R.mT + offset[:, None]) * n[:, None]).sum(-1)  # (b, m, k)
    weight = known[:, None].expand_as(constant)
    eye = torch.eye(3, dtype=n.dtype, device=n.device)
    for _ in range(REWEIGHTINGS):
        system = torch.einsum("bmk,bki,bkj->bmij", weight, n, n)
        right = torch.einsum("bmk,bki->bmi", weight * constant, n)
        ridge = 1e-9 * system.diagonal(dim1=-2, dim2=-1).sum(-1)[..., None, None] + 1e-300
        t = -torch.linalg.solve(system + ridge * eye, right[..., None])[..., 0]
        gap = (constant + torch.einsum("bmi,bki->bmk", t, n)).abs()
        weight = known[:, None] / gap.clamp_min(0.3)
    return t, (gap * known[:, None]).sum(-1)
