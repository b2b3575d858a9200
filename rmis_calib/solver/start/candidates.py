"""Starts for the joint estimate, and the `global` method: rotation over all of SO(3), then translation, then
cheirality.

**Starts from contours.** The planes of both contours have normals n0, n1 = cos(alpha) m +- sin(alpha) u
(model/residuals.py), so one picture gives the axis in the camera:

    direction d ~ n1 x n0,   half angle sin(alpha) = |n0 - n1| / 2,   distance D = r / sin(alpha),   nearest point D u,

and with the shaft's end, its point in space. Directions then give R (Wahba's problem), points give R and t (absolute
orientation). These starts carry where the axis planes alone are degenerate: a laparoscope that stands still, small
motions.
"""

from dataclasses import dataclass

import torch
from jaxtyping import Bool, Float
from torch import Tensor

from rmis_calib.geometry.rotations import project_to_so3
from rmis_calib.solver.model.batched_linalg import batch_last, cross, dot, rotate, rotate_back
from rmis_calib.solver.model.measurement_rows import MeasurementRows
from rmis_calib.solver.start.line_statistics import LineStatistics
from rmis_calib.solver.start.rotation_search import on_graph, search_rotations, vec

CHEIRALITY_SLACK = 0.9
"""Minima whose cheirality is at least this part of the best one's compete by cost."""
COLLAPSED_MM = 5.0
"""An RCM nearer to the optical centre than this is no solution: see `collapsed`."""
LIFTED_MM = 100.0
"""Distance of the RCM from the camera that a start takes where the lines do not tell it."""
DIRECTION_LENGTH_MM = 30.0
"""Weight of a direction against a point in the mixed start: a direction counts like points this far apart."""


@dataclass(frozen=True)
class Candidates:
    """Minima of the axis-plane cost, with translation: best first is not implied.

    Attributes:
        R: `camera_right_R_arm`.
        t: its translation, mm.
        score: mean squared sine of both plane errors.
        cheirality: part of the sampled lines with the visible shaft in front and the tip where the image has it.
    """

    R: Float[Tensor, "b m 3 3"]
    t: Float[Tensor, "b m 3"]
    score: Float[Tensor, "b m"]
    cheirality: Float[Tensor, "b m"]

    def order(self) -> Tensor:
        """Candidates from best to worst: cheirality first (with slack), then cost; (b, m)."""
        enough = self.cheirality >= CHEIRALITY_SLACK * self.cheirality.amax(-1, keepdim=True)
        key = torch.where(torch.isfinite(self.score), self.score, 1e30) + torch.where(enough, 0.0, 1e31)
        return key.argsort(-1)

    def best(self) -> tuple[Tensor, Tensor, Tensor]:
        """R (b, 3, 3), t (b, 3) and cheirality (b,) of the best candidate."""
        index = self.order()[:, 0]
        rows = torch.arange(index.shape[0], device=index.device)
        return self.R[rows, index], self.t[rows, index], self.cheirality[rows, index]


def solve_translation(
    statistics: LineStatistics, R: Float[Tensor, "b m 3 3"]
) -> tuple[Float[Tensor, "b m 3"], Float[Tensor, "b m"]]:
    """t that minimises sum (n.(R p + t + o))^2 over all cameras, and that sum, mm^2. Paper, Eqs. 22 and 23, both
    cameras at once."""
    r = vec(R)
    gram = statistics.point_gram.sum(1)
    G_tt, G_rt = gram[:, 9:, 9:], gram[:, :9, 9:]
    tt = statistics.point_gram[:, :, 9:, 9:]
    known_t = (tt @ statistics.offset[..., None])[..., 0].sum(1)  # sum_c G_tt o_c
    known_r = (statistics.point_gram[:, :, :9, 9:] @ statistics.offset[..., None])[..., 0].sum(1)
    known = (statistics.offset[..., None, :] @ tt @ statistics.offset[..., None])[..., 0, 0].sum(1)
    ridge = 1e-12 * G_tt.diagonal(dim1=-2, dim2=-1).sum(-1)[:, None, None] + 1e-300
    eye = torch.eye(3, dtype=r.dtype, device=r.device)
    right = r @ G_rt + known_t[:, None]
    t = -torch.linalg.solve(G_tt + ridge * eye, right.mT).mT
    quadratic = ((r @ gram[:, :9, :9]) * r).sum(-1) + 2.0 * (r @ known_r[..., None])[..., 0] + known[:, None]
    return t, (quadratic + (t * right).sum(-1)).clamp_min(0.0)


def cheirality(
    statistics: LineStatistics, R: Float[Tensor, "b m 3 3"], t: Float[Tensor, "b m 3"]
) -> Float[Tensor, "b m"]:
    """Part of the sampled lines whose visible shaft is in front of its camera and runs to the tip as in the picture."""
    p = (statistics.sample_p[:, None] @ R.mT + t[:, :, None])[:, :, None] + statistics.offset[
        :, None, :, None
    ]  # (b, m, c, s, 3)
    d = (statistics.sample_v[:, None] @ R.mT)[:, :, None].expand_as(p)
    M = torch.linalg.cross(p, d)
    turn = (statistics.sample_n[:, None] * M).sum(-1)
    depth = (statistics.sample_x[:, None] * torch.linalg.cross(d, M)).sum(-1)
    known = torch.isfinite(turn)
    return ((turn > 0) & (depth > 0) & known).sum((-2, -1)) / known.sum((-2, -1)).clamp_min(1)


def best_candidate(
    statistics: LineStatistics, grid: int, minima: int
) -> tuple[Float[Tensor, "b 3 3"], Float[Tensor, "b 3"]]:
    """R and t of the best minimum; with derivatives to the statistics, where these have any."""
    if not statistics.rotation_gram.requires_grad:
        return find_candidates(statistics, grid, minima).best()[:2]
    with torch.no_grad():
        R, *_ = find_candidates(statistics, grid, minima).best()
    R = on_graph(statistics.rotation_gram.sum(1), R)[:, None]
    return R[:, 0], lift(statistics, R, solve_translation(statistics, R)[0])[:, 0]


def find_candidates(statistics: LineStatistics, grid: int, minima: int) -> Candidates:
    """All distinct minima of the rotation cost, each with its translation."""
    count = statistics.count.sum(-1, keepdim=True).clamp_min(1.0)
    R, rotation = search_rotations(statistics.rotation_gram.sum(1), grid, minima)
    t, points = solve_translation(statistics, R)
    t = lift(statistics, R, t)
    reach = _mean_distance(statistics, R, t)
    score = rotation / count + points / (count * reach.clamp_min(1.0).square())
    return Candidates(R, t, torch.where(torch.isfinite(rotation), score, torch.inf), cheirality(statistics, R, t))


def collapsed(p: Float[Tensor, "*batch n 3"]) -> Bool[Tensor, "*batch"]:
    """Whether the RCM, in the camera's frame, has fallen into the optical centre.

    Every plane through the optical centre contains p = 0, so this fits any lines of one camera without a residual. It
    is what least squares returns where the distance of the RCM cannot be seen: one camera, and a laparoscope that does
    not move.
    """
    return torch.linalg.vector_norm(p, dim=-1).mean(-1) < COLLAPSED_MM


def lift(statistics: LineStatistics, R: Float[Tensor, "b m 3 3"], t: Float[Tensor, "b m 3"]) -> Float[Tensor, "b m 3"]:
    """t with a collapsed RCM moved out along the ray that all planes share, to the side where the tips point as
    imaged."""
    p = statistics.sample_p[:, None] @ R.mT + t[:, :, None]
    chosen = collapsed(p)
    if not bool(chosen.any()):
        return t
    _, rays = torch.linalg.eigh(statistics.point_gram[:, :, 9:, 9:].sum(1))
    shift = (LIFTED_MM * rays[:, None, :, 0]).expand_as(t) - p.mean(-2)
    ahead, behind = t + shift, t + shift - 2.0 * LIFTED_MM * rays[:, None, :, 0]
    towards = cheirality(statistics, R, ahead) >= cheirality(statistics, R, behind)
    return torch.where(chosen[..., None], torch.where(towards[..., None], ahead, behind), t)


def _mean_distance(statistics: LineStatistics, R: Tensor, t: Tensor) -> Tensor:
    """Mean |n.(p x d)| of the sample: how far the shaft passes from the optical centre, mm."""
    p = statistics.sample_p[:, None] @ R.mT + t[:, :, None]
    M = torch.linalg.cross(p, statistics.sample_v[:, None] @ R.mT)
    return torch.linalg.vector_norm(M, dim=-1).mean(-1)


@dataclass(frozen=True)
class SeenAxes:
    """What contours and ends say about each shaft, in `camera_right`: nearest point of the axis to the camera,
    direction, end; and their weights."""

    nearest: Float[Tensor, "3 c b n"]
    direction: Float[Tensor, "3 c b n"]
    end: Float[Tensor, "3 c b n"]
    weight: Float[Tensor, "c b n"]
    end_weight: Float[Tensor, "c b n"]


def seen_axes(measured: MeasurementRows, radius: Float[Tensor, " b"]) -> SeenAxes:
    """Axes and ends in space, each from one picture. Needs `measured.has_contours`."""
    camera_R, camera_t = measured.camera_R[..., None], measured.camera_t[..., None]
    x, y = measured.line_xy.unflatten(1, (2, 2))  # (edge, point, c, b, n) each
    rays = torch.stack((x, y, torch.ones_like(x)))
    n = cross(rays[:, :, 0], rays[:, :, 1])
    n = n / dot(n, n).sqrt().clamp_min(1e-12)  # (3, edge, c, b, n)
    ok = (measured.line_ok & (measured.line_rho != 0)).all(0)
    apart = n[:, 0] - n[:, 1]
    length = dot(apart, apart).sqrt().clamp_min(1e-6)
    u, D = apart / length, radius[:, None] * 2.0 / length
    d = cross(n[:, 1], n[:, 0])
    d = d / dot(d, d).sqrt().clamp_min(1e-12)
    weight = ok.to(D.dtype)
    end, end_weight = D * u, torch.zeros_like(weight)
    if measured.has_ends:
        ex, ey = measured.end_xy
        X_u, X_d = u[0] * ex + u[1] * ey + u[2], d[0] * ex + d[1] * ey + d[2]
        end = D * (u + X_d / torch.where(X_u.abs() < 1e-6, 1e-6, X_u) * d)
        end_weight = weight * measured.end_ok
    return SeenAxes(
        nearest=rotate_back(camera_R, D * u - camera_t),
        direction=rotate_back(camera_R, d),
        end=rotate_back(camera_R, end - camera_t),
        weight=weight,
        end_weight=end_weight,
    )


def contour_starts(
    measured: MeasurementRows, radius: Float[Tensor, " b"], reweightings: int = 0, all_kinds: bool = True
) -> tuple[Float[Tensor, "b s 3 3"], Float[Tensor, "b s 3"]]:
    """Starts from contours and, where measured, ends; s = 1 or 3. Needs `measured.has_contours`.

    Args:
        reweightings: rounds of least absolute deviations; 0 for least squares.
        all_kinds: False for the most accurate one alone.
    """
    axes = seen_axes(measured, radius)
    v = measured.v[:, None].expand_as(axes.direction)
    arm_end = (measured.p + measured.s_end * measured.v)[:, None].expand_as(v)
    enough = axes.end_weight.sum((0, 2)) >= 3
    kinds: list[float | None] = [None]
    if bool(enough.any()):
        kinds += [0.0, DIRECTION_LENGTH_MM**2]
    if not all_kinds:
        kinds = kinds[-1:] if bool(enough.all()) else [None, *kinds[1:][-1:]]
    starts = []
    for mix in kinds:
        weight = axes.weight if mix is None else axes.end_weight
        for _ in range(reweightings + 1):
            correlation = _correlate(axes.direction, v, weight)
            if mix is None:
                R = project_to_so3(correlation)
                t = _translation_from_axes(measured, R, axes.nearest, axes.direction, weight)
                error = _length(axes.direction - _turn(R, v)) * DIRECTION_LENGTH_MM
            else:
                R, t = _absolute_orientation(axes.end, arm_end, weight, mix * correlation)
                error = _length(axes.end - _turn(R, arm_end) - t.T[:, None, :, None])
            weight = (axes.weight if mix is None else axes.end_weight) / error.clamp_min(1.0)
        if mix is not None and starts:  # trials with too few ends start from contours alone
            R, t = torch.where(enough[:, None, None], R, starts[0][0]), torch.where(enough[:, None], t, starts[0][1])
        starts.append((R, t))
    if not all_kinds:
        starts = starts[-1:]
    return torch.stack([s[0] for s in starts], dim=1), torch.stack([s[1] for s in starts], dim=1)


def _turn(R: Float[Tensor, "b 3 3"], v: Float[Tensor, "3 c b n"]) -> Float[Tensor, "3 c b n"]:
    return rotate(batch_last(R, 2)[:, :, None, :, None], v)


def _length(v: Float[Tensor, "3 c b n"]) -> Float[Tensor, "c b n"]:
    return dot(v, v).sqrt()


def _correlate(
    a: Float[Tensor, "3 c b n"], b: Float[Tensor, "3 c b n"], weight: Float[Tensor, "c b n"]
) -> Float[Tensor, "b 3 3"]:
    """Weighted sum of a b^T."""
    return ((weight * a).permute(1, 2, 0, 3) @ b.permute(1, 2, 3, 0)).sum(0)


def _absolute_orientation(camera: Tensor, arm: Tensor, weight: Tensor, extra: Tensor) -> tuple[Tensor, Tensor]:
    """R, t that carry arm points to camera points in the least-squares sense; `extra` adds directions to the
    correlation."""
    total = weight.sum((0, 2)).clamp_min(1e-12)
    camera_mean = (weight * camera).sum((1, 3)) / total  # (3, b)
    arm_mean = (weight * arm).sum((1, 3)) / total
    R = project_to_so3(
        _correlate(camera - camera_mean[:, None, :, None], arm - arm_mean[:, None, :, None], weight) + extra
    )
    return R, camera_mean.T - (R @ arm_mean.T[..., None])[..., 0]


def _translation_from_axes(
    measured: MeasurementRows, R: Tensor, nearest: Tensor, direction: Tensor, weight: Tensor
) -> Tensor:
    """t for which the RCM lies nearest to the axes seen: sum (I - d d^T)(R p + t - c) = 0."""
    turned = (R @ measured.p.permute(1, 0, 2)).permute(1, 0, 2)[:, None]
    gap = nearest - turned
    gap = gap - dot(direction, gap) * direction
    eye = torch.eye(3, dtype=R.dtype, device=R.device)
    total = weight.sum((0, 2))
    system = total[:, None, None] * eye - _correlate(direction, direction, weight)
    right = (weight * gap).sum((1, 3)).T
    ridge = 1e-9 * total[:, None, None].clamp_min(1.0) * eye
    return torch.linalg.solve(system + ridge, right[..., None])[..., 0]
