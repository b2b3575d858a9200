"""Sufficient statistics of the axis lines: a few small matrices, whatever the number of motions.

With n the unit normal of the plane through the optical centre and the imaged axis (in `camera_right`), v the shaft's
direction and p the RCM (both in `arm`), the axis lies in the plane when

    n.R v = kron(v, n) . vec(R) = 0                          (paper, Eqs. 6 and 9)
    n.(R p + t + o) = kron([p; 1], n) . vec([R | t + o]) = 0   (Eqs. 20 and 21; o = 0 right, R_Z^T t_Z left, Eq. 8)

with column-major vec. Sums of squares of both are quadratic forms in the 9x9 and 12x12 Gram matrices of these rows.
Sums over parts of the data add, so motions stream and partial results merge.

**Direction.** From points taken RCM side first, n = X1 x X2 is a positive multiple of p x d (both in the camera's
frame) for a shaft in front of the camera. A sample of the motions is kept for this test (`candidates.cheirality`).
"""

from dataclasses import dataclass, fields

import torch
from jaxtyping import Float
from torch import Tensor

from rmis_calib.errors import InputError
from rmis_calib.geometry.lines import plane_normal_from_points
from rmis_calib.solver.problem import Problem
from rmis_calib.solver.tensors import chunks

SAMPLE = 64
"""Motions kept as they are, for the test whether the visible part of the shaft is in front of the camera."""


@dataclass(frozen=True)
class LineStatistics:
    """Sums over motions of the axis lines of each camera (`c`, right first), for a batch of trials.

    Attributes:
        rotation_gram: of kron(v, n).
        point_gram: of kron([p; 1], n), mm^2 in the blocks of p.
        count: motions summed.
        offset: o of the left camera, zero for the right one, mm.
        sample_n, sample_p, sample_v, sample_x: up to SAMPLE motions as they are; NaN rows for what was not measured.
    """

    rotation_gram: Float[Tensor, "b c 9 9"]
    point_gram: Float[Tensor, "b c 12 12"]
    count: Float[Tensor, "b c"]
    offset: Float[Tensor, "b c 3"]
    sample_n: Float[Tensor, "b c s 3"]
    sample_p: Float[Tensor, "b s 3"]
    sample_v: Float[Tensor, "b s 3"]
    sample_x: Float[Tensor, "b c s 3"]

    def __add__(self, other: "LineStatistics") -> "LineStatistics":
        """Statistics of both parts.

        Raises:
            InputError: the two parts come from different stereo extrinsics.
        """
        if not torch.equal(self.offset, other.offset):
            raise InputError(
                where="LineStatistics", expected="parts with the same stereo extrinsics", found="different ones"
            )
        sums = {name: getattr(self, name) + getattr(other, name) for name in ("rotation_gram", "point_gram", "count")}
        samples = {
            f.name: torch.cat((getattr(self, f.name), getattr(other, f.name)), dim=-2)[..., :: self._stride(other), :][
                ..., :SAMPLE, :
            ]
            for f in fields(self)
            if f.name.startswith("sample_")
        }
        return LineStatistics(**sums, **samples, offset=self.offset)

    def _stride(self, other: "LineStatistics") -> int:
        return max(1, -(-(self.sample_p.shape[-2] + other.sample_p.shape[-2]) // SAMPLE))

    def apart(self) -> "LineStatistics":
        """Every camera of every trial as a trial of its own, cameras of one trial together."""
        cameras = self.count.shape[1]
        shared = ("sample_p", "sample_v")
        return LineStatistics(
            **{
                f.name: getattr(self, f.name).repeat_interleave(cameras, dim=0)
                if f.name in shared
                else getattr(self, f.name).flatten(0, 1)[:, None]
                for f in fields(self)
            }
        )

    @classmethod
    def from_problem(cls, problem: Problem, chunk: int = 16384) -> "LineStatistics":
        """Sums of a problem with one trial axis, `chunk` motions (times trials) at a time; lines that were not
        measured do not count."""
        trials, motions = problem.n_trials, problem.n_motions
        sums = []
        for part, along in chunks(trials, motions, chunk):
            parts = [_sums(problem, part, each) for each in along]
            total = parts[0]
            for part in parts[1:]:
                total = [x.add_(y) for x, y in zip(total, part, strict=True)]
            sums.append(total)
        rotation, point, count = (torch.cat([part[i] for part in sums]) for i in range(3))
        R_Z, t_Z = problem.camera_T_camera_right[..., :3, :3], problem.camera_T_camera_right[..., :3, 3]
        sample = problem.select_motions(slice(None, None, max(1, -(-motions // SAMPLE))))
        n, x, ok = plane_normals(sample)
        return cls(
            rotation_gram=rotation,
            point_gram=point,
            count=count,
            offset=(R_Z.mT @ t_Z[..., None])[..., 0],
            sample_n=torch.where(ok[..., None], n, torch.nan),
            sample_p=sample.arm_T_rcm[..., :3, 3],
            sample_v=_arm_v(sample),
            sample_x=x,
        )


def _sums(problem: Problem, trials: slice, motions: slice) -> list[Tensor]:
    """Gram matrices and count of some motions; vectors by component, so that every operation runs along
    memory."""
    axis, T = problem.axis_xy[trials, :, motions], problem.arm_T_rcm[trials, motions]
    x0, y0, x1, y1 = (axis[..., i, j].contiguous() for i in (0, 1) for j in (0, 1))
    ok = torch.isfinite(x0 + y0 + x1 + y1) & problem.valid[trials, :, motions]
    if axis.requires_grad:  # the derivative of a NaN is NaN, even where it does not count
        x0, y0, x1, y1 = (torch.where(ok, x, 0.0) for x in (x0, y0, x1, y1))
    n = [y0 - y1, x1 - x0, x0 * y1 - y0 * x1]
    scale = torch.where(ok, (n[0].square() + n[1].square() + n[2].square()).clamp_min(1e-300).rsqrt(), 0.0)
    n = [torch.where(ok, component, 0.0) * scale for component in n]
    if problem.n_cameras == 2:  # n R = R^T n, into camera_right
        R = problem.camera_T_camera_right[trials, :, :3, :3, None]
        n = [n[0] * R[:, :, 0, i] + n[1] * R[:, :, 1, i] + n[2] * R[:, :, 2, i] for i in range(3)]
    n = torch.stack(n, dim=2)  # (b, c, 3, n)
    axis_rcm = problem.rcm_v_axis[trials, motions]
    v = [
        T[..., i, 0] * axis_rcm[..., 0] + T[..., i, 1] * axis_rcm[..., 1] + T[..., i, 2] * axis_rcm[..., 2]
        for i in range(3)
    ]
    p = [T[..., i, 3] for i in range(3)]
    one = torch.ones_like(p[0])
    left = torch.stack((*v, *p, one), dim=1)  # (b, 7, n)
    rows = (left[:, None, :, None] * n[:, :, None]).flatten(2, 3)  # (b, c, 21, n): kron(v, n), kron([p; 1], n)
    return [rows[:, :, :9] @ rows[:, :, :9].mT, rows[:, :, 9:] @ rows[:, :, 9:].mT, ok.sum(-1).to(n.dtype)]


def plane_normals(problem: Problem) -> tuple[Float[Tensor, "b c n 3"], Float[Tensor, "b c n 3"], Tensor]:
    """Unit normals and rays of the first axis point, both turned into `camera_right`, and which lines were measured."""
    a, b = problem.axis_xy[..., 0, :], problem.axis_xy[..., 1, :]
    ok = torch.isfinite(problem.axis_xy).all(-1).all(-1) & problem.valid
    safe_a = torch.where(ok[..., None], a, 0.0)
    safe_b = torch.where(ok[..., None], b, 1.0)
    rays = torch.cat((safe_a, torch.ones_like(safe_a[..., :1])), dim=-1)
    R = problem.camera_T_camera_right[..., :3, :3]  # rows: n R = R^T n
    return plane_normal_from_points(safe_a, safe_b) @ R, rays @ R, ok


def _arm_v(problem: Problem) -> Float[Tensor, "b n 3"]:
    return (problem.arm_T_rcm[..., :3, :3] @ problem.rcm_v_axis[..., None])[..., 0]
