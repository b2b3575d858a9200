"""Starts from points seen in the pictures: head points, and the shaft's end where nothing else tells enough.

A point X of `arm` seen along a ray lies on two planes with normals n through that ray, a point of an axis line on one,
so that n.(R X + t + o) = 0 with o of the left camera as in line_statistics.py. One Gram matrix of rows kron([X; 1], n)
takes points and lines alike. Eliminating t leaves a quadratic form in vec(R), of which rotation_search.py finds all
minima over SO(3). So no number of points, plane of points or first guess is needed, as closed forms of
perspective-n-point need them: two minima of points in one plane are two minima. The baseline o enters the translation
only; against the distance it is small.

The end's nominal place is known up to a constant, of which the joint estimate takes care; a start may be off by it.
"""

import torch
from jaxtyping import Bool, Float
from torch import Tensor

from rmis_calib.solver.model.batched_linalg import rotate_back
from rmis_calib.solver.model.measurement_rows import MeasurementRows
from rmis_calib.solver.start.rotation_search import search_rotations, vec

LINE_LEVER_MM = 100.0
"""Second point of an axis line that must lie on its plane, beyond the RCM: about where the shaft is seen."""
FLOOR_MM = 0.3
"""Distance from a plane below which errors count as equal when wrong points are to weigh less: kinematics' noise."""


def point_starts(
    measured: MeasurementRows, grid: int, minima: int, reweightings: int = 0
) -> tuple[Float[Tensor, "b m 3 3"], Float[Tensor, "b m 3"]]:
    """R and t of all minima, best first is not implied.

    Args:
        measured: with heads or ends.
        grid, minima: `SolverSettings`.
        reweightings: rounds of least absolute deviations from the best minimum; 0 for least squares.
    """
    rows, offset, ok = _rows(measured)
    weight = ok.to(rows.dtype)
    for _ in range(reweightings + 1):
        gram = torch.einsum("kb,kbi,kbj->bij", weight, rows, rows)
        R, t = _minima(gram, torch.einsum("kb,kbi->bi", weight * offset, rows[..., 9:]), grid, minima)
        best = torch.cat((vec(R[:, 0]), t[:, 0]), dim=-1)
        error = (torch.einsum("kbi,bi->kb", rows, best) + offset).abs()
        weight = ok / error.clamp_min(FLOOR_MM)
    return R, t


def _rows(measured: MeasurementRows) -> tuple[Float[Tensor, "k b 12"], Float[Tensor, "k b"], Bool[Tensor, "k b"]]:
    """kron([X; 1], n) of every plane and point on it, n.o, and whether it was measured."""
    planes = []
    if measured.has_heads:
        planes += _ray_planes(measured, measured.head_xy, measured.head_ok, (measured.p + measured.head)[:, None])
    if measured.has_ends:
        planes += _ray_planes(
            measured, measured.end_xy, measured.end_ok, (measured.p + measured.s_end * measured.v)[:, None]
        )
    (x0, x1), (y0, y1) = measured.line_xy[:, :2]
    n = torch.stack((y0 - y1, x1 - x0, x0 * y1 - y0 * x1))
    on_axis = measured.line_ok[0] & (measured.line_rho[0] == 0)
    planes += [(n, measured.p[:, None] + s * measured.v[:, None], on_axis) for s in (0.0, LINE_LEVER_MM)]
    rows, offsets, oks = [], [], []
    for n, X, ok in planes:
        n = torch.where(ok, n / n.square().sum(0).sqrt().clamp_min(1e-12), 0.0)  # (3, c, b, n)
        offset = (n * measured.camera_t[..., None]).sum(0)
        n = rotate_back(measured.camera_R[..., None], n)
        one = torch.cat((X, torch.ones_like(X[:1]))).expand(-1, *n.shape[1:])
        rows.append((one[:, None] * n[None]).flatten(0, 1).permute(1, 3, 2, 0).flatten(0, 1))
        offsets.append(offset.transpose(1, 2).flatten(0, 1))
        oks.append(ok.transpose(1, 2).flatten(0, 1))
    return torch.cat(rows), torch.cat(offsets), torch.cat(oks)


def _ray_planes(measured: MeasurementRows, xy: Tensor, ok: Tensor, X: Tensor) -> list[tuple[Tensor, Tensor, Tensor]]:
    """Two planes at right angles through each ray, with the point that lies on them."""
    x, y = xy
    zero, one = torch.zeros_like(x), torch.ones_like(x)
    return [(torch.stack((one, zero, -x)), X, ok), (torch.stack((zero, one, -y)), X, ok)]


def _minima(
    gram: Float[Tensor, "b 12 12"], known: Float[Tensor, "b 3"], grid: int, minima: int
) -> tuple[Tensor, Tensor]:
    """Minima over R with the best t of each; `known` is the sum of the offsets' part of the normal equations of t."""
    scale = gram[:, 9:, 9:].diagonal(dim1=-2, dim2=-1).sum(-1)[:, None, None]
    G_tt = gram[:, 9:, 9:] + (1e-9 * scale + 1e-300) * torch.eye(3, dtype=gram.dtype, device=gram.device)
    solved = torch.linalg.solve(G_tt, gram[:, 9:, :9])  # (b, 3, 9)
    quadratic = gram[:, :9, :9] - gram[:, :9, 9:] @ solved
    R, _ = search_rotations(0.5 * (quadratic + quadratic.mT), grid, minima)
    shift = torch.linalg.solve(G_tt, known[..., None])[..., 0]
    return R, -(vec(R) @ solved.mT) - shift[:, None]
