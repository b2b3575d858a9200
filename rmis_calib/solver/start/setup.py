"""Starts for a set-up that nobody states: both transforms from what contours and ends say of each shaft in space.

A shaft of direction w in `instrument_base` (from the instrument's joints) is seen, at the pose L of the laparoscope's
arm in its own base, along

    d = X L^T S w,      X = camera_right_R_arm,  S = laparoscope_base_R_instrument_base,

with d from the two contours of one picture (candidates.py). Given S, the best X is Wahba's problem, with the
correlation B(S) = sum d (L^T S w)^T: linear in S, so that one 9x9 matrix of sums takes every S of a covering grid at
once. The best of them descend together by Gauss-Newton in (X, S), the distinct minima are kept, and points on the axes
then give both translations by linear least squares. Where the laparoscope turns by a few degrees only, wrong S fit
nearly as well as the right one: what is returned competes by all measurements (estimate/setup_start.py).
"""

import torch
from jaxtyping import Float
from torch import Tensor

from rmis_calib.geometry.rigid import rigid_from_rotation_translation
from rmis_calib.geometry.rotations import project_to_so3, rotvec_to_matrix, skew
from rmis_calib.solver.model.measurement_rows import MeasurementRows
from rmis_calib.solver.start.candidates import SeenAxes, seen_axes
from rmis_calib.solver.start.rotation_search import distinct_minima, rotation_grid, unvec, vec

KEPT = 24
"""Grid rotations that descend."""
STEPS = 12
DAMPING = 1e-4
"""Of the Gauss-Newton steps, relative to the trace: X and S are told apart by what the laparoscope turned alone."""
FLOOR = 0.02
"""Distance of two unit directions from which errors count less (a degree): about the noise of one picture."""
FLOOR_MM = 2.0
"""The same of points on the axis."""
REWEIGHTINGS = 3


def setup_starts(
    measured: MeasurementRows,
    laparoscope_base_T_arm: Float[Tensor, "b n 4 4"],
    radius: Float[Tensor, " b"],
    grid: int,
    minima: int,
) -> Float[Tensor, "b m 4 4"]:
    """`laparoscope_base_T_instrument_base` of every minimum, lowest first.

    Args:
        measured: with contours, at the identity for a set-up.
        laparoscope_base_T_arm: of the same motions.
        radius: of the shaft, mm.
        grid: rotations of the covering grid.
        minima: distinct minima to return.
    """
    axes = seen_axes(measured, radius)
    L, p_arm = laparoscope_base_T_arm[..., :3, :3], laparoscope_base_T_arm[..., :3, 3]
    d, weight = axes.direction.permute(2, 1, 3, 0), axes.weight.transpose(0, 1)  # (b, c, n, ...)
    w = (L @ measured.v.permute(1, 2, 0)[..., None])[..., 0]
    S = _descend(d, weight, L, w, _best_of_grid(d, weight, L, w, grid))
    S, cost = distinct_minima(*S, minima)
    S = torch.where(torch.isfinite(cost)[..., None, None], S, S[:, :1])
    X = _best_hand_eye(d, weight, L, w, S)
    p = (L @ measured.p.permute(1, 2, 0)[..., None])[..., 0] + p_arm
    s = _translations(axes, L, p_arm, w, p + measured.s_end[..., None] * w, X, S)
    return rigid_from_rotation_translation(S, s)


def _correlations(d: Tensor, weight: Tensor, L: Tensor, w: Tensor) -> Float[Tensor, "b 9 9"]:
    """C with vec(B(S)) = C vec(S) for B(S) = sum d (L^T S w)^T."""
    weighted = (weight[..., None] * d).sum(1)  # (b, n, 3)
    # B_ij = sum d_i L_ki S'_k.. with (L^T S w)_j = L_kj S_kl w_l; vec takes columns, so indices run (j, i) and (l, k)
    return torch.einsum("bni,bnkj,bnl->bjilk", weighted, L, w).flatten(1, 2).flatten(2, 3)


def _best_hand_eye(d: Tensor, weight: Tensor, L: Tensor, w: Tensor, S: Float[Tensor, "b m 3 3"]) -> Tensor:
    """The rotation `camera_right_R_arm` of least squared error for every S."""
    return project_to_so3(unvec(vec(S) @ _correlations(d, weight, L, w).mT))


def _best_of_grid(d: Tensor, weight: Tensor, L: Tensor, w: Tensor, grid: int) -> Float[Tensor, "b k 3 3"]:
    """The rotations S of the covering grid for which the best X fits best."""
    rotations = rotation_grid(grid, d)
    B = unvec(vec(rotations) @ _correlations(d, weight, L, w).mT)  # (b, grid, 3, 3)
    fit = (project_to_so3(B) * B).sum((-2, -1))
    return rotations[fit.topk(min(KEPT, grid), dim=-1).indices]


def _descend(
    d: Tensor, weight: Tensor, L: Tensor, w: Tensor, S: Float[Tensor, "b k 3 3"]
) -> tuple[Float[Tensor, "b k 3 3"], Float[Tensor, "b k"]]:
    """Every S, its X with it, after Gauss-Newton steps on least absolute deviations beyond FLOOR; and the cost."""
    X = _best_hand_eye(d, weight, L, w, S)
    eye = torch.eye(6, dtype=d.dtype, device=d.device)
    for step in range(STEPS + 1):
        M = X[:, :, None] @ (L.mT[:, None] @ S[:, :, None])  # (b, k, n, 3, 3): instrument_base to camera_right
        seen = (M @ w[:, None, :, :, None])[..., 0]
        error = d[:, None] - seen[:, :, None]  # (b, k, c, n, 3)
        length = torch.linalg.vector_norm(error, dim=-1)
        if step == STEPS:
            return S, (weight[:, None] * torch.minimum(length.square(), FLOOR * length)).sum((-2, -1))
        each = weight[:, None] / (length / FLOOR).clamp_min(1.0)
        J = torch.cat((skew(seen), M @ skew(w)[:, None]), dim=-1)  # of the error; (b, k, n, 3, 6)
        H = torch.einsum("bkn,bknip,bkniq->bkpq", each.sum(2), J, J)
        g = torch.einsum("bkni,bknip->bkp", (each[..., None] * error).sum(2), J)
        size = H.diagonal(dim1=-2, dim2=-1).mean(-1)[..., None, None]
        delta = -torch.linalg.solve(H + (DAMPING * size + 1e-12) * eye, g[..., None])[..., 0]
        delta = delta * (0.5 / torch.linalg.vector_norm(delta, dim=-1, keepdim=True).clamp_min(0.5))
        X = rotvec_to_matrix(delta[..., :3]) @ X
        S = S @ rotvec_to_matrix(delta[..., 3:])
    raise AssertionError("the loop returns")


def _translations(
    axes: SeenAxes, L: Tensor, p_arm: Tensor, w: Tensor, p_end: Tensor, X: Float[Tensor, "b m 3 3"], S: Tensor
) -> Float[Tensor, "b m 3"]:
    """Translation of the set-up for every pair of rotations, that of the hand-eye transform and one constant offset of
    the ends eliminated with it: axes pass through the points seen on them, ends lie where they are seen."""
    turned = X[:, :, None] @ L.mT[:, None]  # (b, m, n, 3, 3)
    direction = (turned @ (S[:, :, None] @ w[:, None, :, :, None]))[..., 0]
    known = (turned @ (S[:, :, None] @ p_end[:, None, :, :, None] - p_arm[:, None, :, :, None]))[..., 0]
    eye = torch.eye(3, dtype=X.dtype, device=X.device)
    across = eye - direction[..., :, None] * direction[..., None, :]  # (b, m, n, 3, 3)
    blocks = torch.cat((turned, eye.expand_as(turned), direction[..., None]), dim=-1)  # of s, t and the offset
    nearest, end = axes.nearest.permute(2, 1, 3, 0)[:, None], axes.end.permute(2, 1, 3, 0)[:, None]
    gap_axis = (across[:, :, None] @ (nearest - known[:, :, None])[..., None])[..., 0]  # (b, m, c, n, 3)
    gap_end = (direction[:, :, None] * (end - known[:, :, None])).sum(-1)
    rows_axis = across @ blocks  # the offset is along the axis: its column is zero
    rows_end = (direction[..., None, :] @ blocks)[..., 0, :]
    weight_axis = axes.weight.transpose(0, 1)[:, None].expand(gap_axis.shape[:-1])
    weight_end = axes.end_weight.transpose(0, 1)[:, None].expand(gap_end.shape)
    ridge = 1e-9 * torch.eye(7, dtype=X.dtype, device=X.device)
    solved = X.new_zeros((*X.shape[:2], 7))
    for _ in range(REWEIGHTINGS):
        miss_axis = gap_axis - (rows_axis @ solved[:, :, None, :, None])[..., 0][:, :, None]
        miss_end = gap_end - (rows_end * solved[:, :, None]).sum(-1)[:, :, None]
        each_axis = weight_axis * FLOOR_MM / torch.linalg.vector_norm(miss_axis, dim=-1).clamp_min(FLOOR_MM)
        each_end = weight_end * FLOOR_MM / miss_end.abs().clamp_min(FLOOR_MM)
        H = torch.einsum("bmn,bmnip,bmniq->bmpq", each_axis.sum(2), rows_axis, rows_axis)
        H = H + torch.einsum("bmn,bmnp,bmnq->bmpq", each_end.sum(2), rows_end, rows_end)
        g = torch.einsum("bmcni,bmnip->bmp", each_axis[..., None] * gap_axis, rows_axis)
        g = g + torch.einsum("bmcn,bmnp->bmp", each_end * gap_end, rows_end)
        size = H.diagonal(dim1=-2, dim2=-1).mean(-1)[..., None, None]
        solved = torch.linalg.solve(H + (size + 1.0) * ridge, g[..., None])[..., 0]
    return solved[..., :3]
