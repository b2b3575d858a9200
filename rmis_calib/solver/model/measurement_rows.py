"""A problem packed for the inner loops: component first, trials and motions last, one row for each scalar measurement.

A row is a *line* row (an image point that lies on a contour, `rho` = +1 or -1, or on the axis, `rho` = 0), an *end* row
(where the shaft stops along its axis) or one of two *head* rows. Where a camera measured both contours of a motion, its
axis line is dropped: detectors derive the one from the other, and counting both would claim information twice.
"""

from dataclasses import dataclass, fields, replace
from functools import cached_property

import torch
from jaxtyping import Bool, Float
from torch import Tensor

from rmis_calib.solver.model.batched_linalg import batch_last, rotate
from rmis_calib.solver.problem import Problem
from rmis_calib.solver.settings import NoiseSettings

LINE, END, HEAD = 0, 1, 2
MIN_SIGMA = 1e-6
"""Least image noise, normalised units (a thousandth of a pixel): exact data are not a division by zero."""


@dataclass(frozen=True)
class MeasurementRows:
    """Measurements of `c` cameras in `b` trials of `n` motions; `l` line points a camera (0, 2 or 4).

    Attributes:
        p: RCM in `arm`, mm.
        v: shaft direction in `arm`.
        R: `arm_R_rcm`.
        head: vector from the RCM to the head point, in `arm`, mm.
        s_end: nominal coordinate of the shaft's end, mm.
        line_xy: points measured on lines.
        line_rho: signed contour (+1, -1) or axis (0).
        line_var: variance across the line before any scale; line_ok: measured.
        end_xy, end_var, end_ok: shaft ends.
        head_xy, head_var, head_ok: head points.
        camera_R: `camera_R_camera_right` as given, batch last.
        camera_t: its translation.
        joint: displacement of the shaft per unit of joint offset, in `arm`; None where unknown.
        clock: displacement per second, in `arm`.
        autograd: whether `residuals.linearise` takes the derivatives from autograd.
        exact: whether autograd also differentiates what the analytic derivatives hold (residuals.py): for the
            derivative of the estimate, not of a residual.
    """

    p: Float[Tensor, "3 b n"]
    v: Float[Tensor, "3 b n"]
    R: Float[Tensor, "3 3 b n"]
    head: Float[Tensor, "3 b n"]
    s_end: Float[Tensor, "b n"]
    line_xy: Float[Tensor, "2 l c b n"]
    line_rho: Float[Tensor, "l c b n"]
    line_var: Float[Tensor, "l c b n"]
    line_ok: Bool[Tensor, "l c b n"]
    end_xy: Float[Tensor, "2 e b n"]
    end_var: Float[Tensor, "e b n"]
    end_ok: Bool[Tensor, "e b n"]
    head_xy: Float[Tensor, "2 h b n"]
    head_var: Float[Tensor, "h b n"]
    head_ok: Bool[Tensor, "h b n"]
    camera_R: Float[Tensor, "3 3 c b"]
    camera_t: Float[Tensor, "3 c b"]
    joint: Float[Tensor, "6 j b n"] | None = None
    clock: Float[Tensor, "6 b n"] | None = None
    autograd: bool = False
    exact: bool = False

    @property
    def trials(self) -> int:
        return self.p.shape[1]

    @property
    def motions(self) -> int:
        return self.p.shape[2]

    @property
    def cameras(self) -> int:
        return self.camera_t.shape[1]

    @property
    def has_contours(self) -> bool:
        return self.line_xy.shape[1] == 4

    @property
    def has_ends(self) -> bool:
        return self.end_xy.shape[1] > 0

    @property
    def has_heads(self) -> bool:
        return self.head_xy.shape[1] > 0

    @property
    def row_camera(self) -> tuple[int, ...]:
        """Camera of each row."""
        cameras = tuple(range(self.cameras))
        return cameras * (self.line_xy.shape[1] + self.has_ends + 2 * self.has_heads)

    @cached_property
    def row_kind(self) -> tuple[int, ...]:
        """LINE, END or HEAD of each row."""
        c = self.cameras
        return (LINE,) * (self.line_xy.shape[1] * c) + (END,) * (c * self.has_ends) + (HEAD,) * (2 * c * self.has_heads)

    @cached_property
    def rows_ok(self) -> Bool[Tensor, "k b n"]:
        heads = self.head_ok.repeat(2, 1, 1) if self.has_heads else self.head_ok
        return torch.cat((self.line_ok.flatten(0, 1), self.end_ok, heads))

    @cached_property
    def rows_var(self) -> Float[Tensor, "k b n"]:
        heads = self.head_var.repeat(2, 1, 1) if self.has_heads else self.head_var
        return torch.cat((self.line_var.flatten(0, 1), self.end_var, heads))

    def narrow(self, trials: slice, motions: slice) -> "MeasurementRows":
        """The part of these trials and motions."""
        if trials.indices(self.trials) == (0, self.trials, 1) and motions.indices(self.motions) == (0, self.motions, 1):
            return self
        part = {}
        for field in fields(self):
            value = getattr(self, field.name)
            if field.name in ("camera_R", "camera_t"):
                part[field.name] = value[..., trials]
            elif isinstance(value, Tensor):
                part[field.name] = value[..., trials, motions]
        return replace(self, **part)

    def take_motions(self, index: Tensor) -> "MeasurementRows":
        """The part of the motions `index`, the same for every trial."""
        fixed = ("camera_R", "camera_t")
        names = [f.name for f in fields(self) if f.name not in fixed and isinstance(getattr(self, f.name), Tensor)]
        return replace(self, **{name: getattr(self, name)[..., index] for name in names})

    def gather(self, trial: Tensor, motion: Tensor) -> "MeasurementRows":
        """Single motions (trial[i], motion[i]) as trials of one motion each."""
        part = {}
        for field in fields(self):
            value = getattr(self, field.name)
            if field.name in ("camera_R", "camera_t"):
                part[field.name] = value[..., trial]
            elif isinstance(value, Tensor):
                part[field.name] = value[..., trial, motion][..., None]
        return replace(self, **part)

    def take_trials(self, index: Tensor) -> "MeasurementRows":
        """The trials `index`, in this order, repeated where it repeats them."""
        part = {}
        for field in fields(self):
            value = getattr(self, field.name)
            if isinstance(value, Tensor):
                dim = value.ndim - (1 if field.name in ("camera_R", "camera_t") else 2)
                part[field.name] = value.index_select(dim, index)
        return replace(self, **part)

    def repeat_trials(self, times: int) -> "MeasurementRows":
        """Every trial `times` times, neighbours together."""
        if times == 1:
            return self
        return self.take_trials(torch.arange(self.trials, device=self.p.device).repeat_interleave(times))

    def keep(self, camera_ok: Bool[Tensor, "c b n"]) -> "MeasurementRows":
        """Measurements of other cameras and motions marked as not measured."""
        return replace(
            self,
            line_ok=self.line_ok & camera_ok,
            end_ok=self.end_ok & camera_ok if self.has_ends else self.end_ok,
            head_ok=self.head_ok & camera_ok if self.has_heads else self.head_ok,
        )


def pack(problem: Problem, noise: NoiseSettings) -> MeasurementRows:
    """The packed form of a problem with exactly one trial axis."""
    image = torch.nan_to_num(problem.noise.image, nan=noise.image).clamp_min(MIN_SIGMA)[:, None, None]
    arm_R_rcm = batch_last(problem.arm_T_rcm[..., :3, :3], 2)
    head_rcm = torch.nan_to_num(batch_last(problem.rcm_p_head, 1))
    line = _lines(problem, image)
    ends_known = torch.isfinite(problem.rcm_s_end_mm)
    heads_known = torch.isfinite(problem.rcm_p_head).all(-1)
    end_xy, end_var, end_ok = _points(problem.end_xy, problem.end_sigma, problem.valid & ends_known[:, None], image)
    head_xy, head_var, head_ok = _points(
        problem.head_xy, problem.head_sigma, problem.valid & heads_known[:, None], image
    )
    joint = (
        None
        if problem.joint_derivative is None
        else _to_arm(arm_R_rcm[:, :, None], batch_last(problem.joint_derivative, 2))
    )
    clock = None if problem.clock_derivative is None else _to_arm(arm_R_rcm, batch_last(problem.clock_derivative, 1))
    camera = problem.camera_T_camera_right.permute(2, 3, 1, 0).contiguous()
    return MeasurementRows(
        p=batch_last(problem.arm_T_rcm[..., :3, 3], 1),
        v=rotate(arm_R_rcm, batch_last(problem.rcm_v_axis, 1)),
        R=arm_R_rcm,
        head=rotate(arm_R_rcm, head_rcm),
        s_end=torch.nan_to_num(problem.rcm_s_end_mm),
        line_xy=line[0],
        line_rho=line[1],
        line_var=line[2],
        line_ok=line[3],
        end_xy=end_xy,
        end_var=end_var,
        end_ok=end_ok,
        head_xy=head_xy,
        head_var=head_var,
        head_ok=head_ok,
        camera_R=camera[:3, :3],
        camera_t=camera[:3, 3],
        joint=joint,
        clock=clock,
    )


def line_points(problem: Problem) -> int:
    """Line rows a camera has in the packed form: the points of both contours where any motion has them, else of the
    axis."""
    return 4 if bool(_contour_ok(problem).any()) else 2


def _contour_ok(problem: Problem) -> Bool[Tensor, "b c n"]:
    known = torch.isfinite(problem.contour_xy).all(-1).all(-1).all(-1) & problem.valid
    return known & torch.isfinite(problem.radius_mm)[:, None, None]


def _to_arm(arm_R_rcm: Tensor, displacement: Tensor) -> Tensor:
    """Rotation and translation parts of displacements, turned from `rcm` into `arm`."""
    return torch.cat((rotate(arm_R_rcm, displacement[:3]), rotate(arm_R_rcm, displacement[3:])))


def _lines(problem: Problem, image: Tensor) -> tuple[Tensor, Tensor, Tensor, Tensor]:
    """Contour points where both contours were measured, else axis points; (2, l, c, b, n), rho, variance, measured."""
    axis_ok = torch.isfinite(problem.axis_xy).all(-1).all(-1) & problem.valid  # (b, c, n)
    contour_ok = _contour_ok(problem)
    axis = problem.axis_xy.permute(4, 3, 1, 0, 2)  # (xy, point, c, b, n)
    axis_var = torch.where(torch.isfinite(problem.axis_sigma), problem.axis_sigma, image).square().transpose(0, 1)
    axis_ok = axis_ok.transpose(0, 1)
    if not bool(contour_ok.any()):
        xy = torch.nan_to_num(axis).contiguous()
        return (
            xy,
            torch.zeros_like(xy[0]),
            axis_var.expand_as(xy[0]).contiguous(),
            axis_ok.expand_as(xy[0]).contiguous(),
        )
    contour = problem.contour_xy.permute(5, 3, 4, 1, 0, 2)  # (xy, edge, point, c, b, n)
    contour_sigma = torch.where(torch.isfinite(problem.contour_sigma), problem.contour_sigma, image[..., None])
    contour_var = contour_sigma.square().permute(3, 1, 0, 2)[:, None].expand(contour.shape[1:])
    contour_ok = contour_ok.transpose(0, 1)
    rho = (
        contour_ok.to(axis.dtype)
        * torch.tensor([1.0, -1.0], dtype=axis.dtype, device=axis.device)[:, None, None, None, None]
    )
    first = torch.tensor([True, False], device=axis.device)[
        :, None, None, None, None
    ]  # an axis line takes the rows of edge 0
    xy = torch.where(contour_ok, contour, axis[:, None])
    ok = contour_ok | (axis_ok & first)
    var = torch.where(contour_ok, contour_var, axis_var.expand(contour.shape[1:]))
    shape = (4, *contour.shape[3:])
    return (
        torch.nan_to_num(xy).reshape(2, *shape).contiguous(),
        rho.expand(contour.shape[1:]).reshape(shape).contiguous(),
        var.reshape(shape).contiguous(),
        ok.expand(contour.shape[1:]).reshape(shape).contiguous(),
    )


def _points(xy: Tensor, sigma: Tensor, known: Tensor, image: Tensor) -> tuple[Tensor, Tensor, Tensor]:
    """(2, c, b, n) coordinates, (c, b, n) variances and where measured; no cameras when nothing was measured at all."""
    ok = torch.isfinite(xy).all(-1) & known
    cameras = ok.shape[1] if bool(ok.any()) else 0
    var = torch.where(torch.isfinite(sigma), sigma, image).square()
    points = torch.nan_to_num(xy).permute(3, 1, 0, 2)[:, :cameras]
    return points.contiguous(), var.transpose(0, 1)[:cameras].contiguous(), ok.transpose(0, 1)[:cameras].contiguous()
