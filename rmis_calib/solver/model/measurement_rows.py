"""A problem packed for the inner loops: component first, trials and motions last, one row for each scalar measurement.

A row is a *line* row (an image point that lies on a contour, `rho` = +1 or -1, or on the axis, `rho` = 0), an *end* row
(where the shaft stops along its axis), one of two *head* rows, or a component of a measurement of the user's *own*.
Where a camera measured both contours of a motion, its axis line is dropped: detectors derive the one from the other,
and counting both would claim information twice.
"""

from collections.abc import Callable
from dataclasses import dataclass, replace
from functools import cached_property
from typing import Any

import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor

from rmis_calib.solver.own_measurement import OwnResidual
from rmis_calib.solver.tensors import axes_of

LINE, END, HEAD, OWN = 0, 1, 2, 3


@dataclass(frozen=True)
class OwnRows:
    """A measurement of the user's own, packed.

    Attributes:
        name: of the measurement.
        residual: see `OwnResidual`.
        camera: number of the camera.
        values: by argument, (..., b, n).
        var, ok: variance of each component, and where it was measured.
        shift: added to the residual; not zero in simulations only, like the next two.
        turn, moved: noise of the kinematics in the values: rotation about the RCM, rad, and translation, mm, in `arm`.
    """

    name: str
    residual: OwnResidual
    camera: int
    values: dict[str, Tensor]
    var: Float[Tensor, "m b n"]
    ok: Bool[Tensor, "m b n"]
    shift: Float[Tensor, "m b n"]
    turn: Float[Tensor, "3 b n"]
    moved: Float[Tensor, "3 b n"]

    def map(self, function: Callable[[Tensor], Tensor]) -> "OwnRows":
        """With a function applied to all tensors."""
        return OwnRows(
            self.name,
            self.residual,
            self.camera,
            {key: function(value) for key, value in self.values.items()},
            *(function(x) for x in (self.var, self.ok, self.shift, self.turn, self.moved)),
        )

    def among(self, cameras: int, rows: Tensor) -> Tensor:
        """Rows (..., m, b, n) between those of the other camera, which are zero: (..., m c, b, n)."""
        other = torch.zeros_like(rows)
        each = [rows if c == self.camera else other for c in range(cameras)]
        return torch.stack(each, dim=-3).flatten(-4, -3)


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
        end_kind, end_sureness: what a detector takes each for, and how sure it is; NaN where it does not say.
        end_second: 1 for those that are measured at the second place of the instrument (`State.end_gap`), else 0.
        head_xy, head_var, head_ok: head points.
        camera_R: `camera_R_camera_right` as given, batch last.
        camera_t: its translation.
        joint: displacement of the shaft per unit of joint offset, in `arm`; None where unknown.
        clock: displacement per second, and per unit of the clock's rate, in `arm`.
        setup: displacement per unit of each component of the set-up's perturbation (`State.setup`), in `arm`; None
            where the set-up cannot be an unknown.
        pose: of the instrument, scaled (model/compliance.py).
        own: measurements of the user's own.
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
    end_kind: Float[Tensor, "e b n"]
    end_sureness: Float[Tensor, "e b n"]
    end_second: Float[Tensor, "e b n"]
    head_xy: Float[Tensor, "2 h b n"]
    head_var: Float[Tensor, "h b n"]
    head_ok: Bool[Tensor, "h b n"]
    camera_R: Float[Tensor, "3 3 c b"]
    camera_t: Float[Tensor, "3 c b"]
    pose: Float[Tensor, "3 b n"]
    joint: Float[Tensor, "6 j b n"] | None = None
    clock: Float[Tensor, "6 2 b n"] | None = None
    setup: Float[Tensor, "6 6 b n"] | None = None
    own: tuple[OwnRows, ...] = ()
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
    def has_second_place(self) -> bool:
        """Whether any end is measured at another place than most."""
        return self.has_ends and bool((self.end_second > 0).any())

    @property
    def has_heads(self) -> bool:
        return self.head_xy.shape[1] > 0

    @property
    def own_components(self) -> int:
        return sum(len(rows.ok) for rows in self.own)

    @cached_property
    def row_kind(self) -> tuple[int, ...]:
        """LINE, END, HEAD or OWN of each row."""
        c = self.cameras
        lines, ends, heads = self.line_xy.shape[1] * c, c * self.has_ends, 2 * c * self.has_heads
        return (LINE,) * lines + (END,) * ends + (HEAD,) * heads + (OWN,) * (c * self.own_components)

    @cached_property
    def rows_ok(self) -> Bool[Tensor, "k b n"]:
        heads = self.head_ok.repeat(2, 1, 1) if self.has_heads else self.head_ok
        own = [rows.among(self.cameras, rows.ok) for rows in self.own]
        return torch.cat((self.line_ok.flatten(0, 1), self.end_ok, heads, *own))

    @cached_property
    def rows_seen(self) -> Int[Tensor, "c b n"]:
        """How many rows each camera has of a motion; rows take turns between the cameras."""
        return self.rows_ok.unflatten(0, (-1, self.cameras)).sum(0)

    @cached_property
    def rows_var(self) -> Float[Tensor, "k b n"]:
        heads = self.head_var.repeat(2, 1, 1) if self.has_heads else self.head_var
        own = [rows.among(self.cameras, rows.var) for rows in self.own]
        return torch.cat((self.line_var.flatten(0, 1), self.end_var, heads, *own))

    @cached_property
    def rows_y(self) -> Float[Tensor, "k b n"]:
        """How far down in the picture each row was measured, in focal lengths; 0 for the user's own."""
        heads = self.head_xy[1].repeat(2, 1, 1) if self.has_heads else self.head_ok.to(self.p.dtype)
        own = [rows.among(self.cameras, torch.zeros_like(rows.var)) for rows in self.own]
        return torch.cat((self.line_xy[1].flatten(0, 1), self.end_xy[1], heads, *own))

    def narrow(self, trials: slice, motions: slice) -> "MeasurementRows":
        """The part of these trials and motions."""
        if trials.indices(self.trials) == (0, self.trials, 1) and motions.indices(self.motions) == (0, self.motions, 1):
            return self
        return self._map(lambda x: x[..., trials, motions], lambda x: x[..., trials])

    def take_motions(self, index: Tensor) -> "MeasurementRows":
        """The part of the motions `index`, the same for every trial."""
        return self._map(lambda x: x[..., index], lambda x: x)

    def gather(self, trial: Tensor, motion: Tensor) -> "MeasurementRows":
        """Single motions (trial[i], motion[i]) as trials of one motion each."""
        return self._map(lambda x: x[..., trial, motion][..., None], lambda x: x[..., trial])

    def take_trials(self, index: Tensor) -> "MeasurementRows":
        """The trials `index`, in this order, repeated where it repeats them."""
        return self._map(lambda x: x.index_select(x.ndim - 2, index), lambda x: x.index_select(x.ndim - 1, index))

    def _map(self, of_motions: Callable[[Tensor], Tensor], of_trials: Callable[[Tensor], Tensor]) -> "MeasurementRows":
        """With a function applied to all tensors (..., b, n), another to those (..., b)."""
        changed: dict[str, Any] = {}
        for name, axes in axes_of(MeasurementRows).items():
            value = getattr(self, name)
            if value is not None:
                changed[name] = of_motions(value) if axes[-1] == "n" else of_trials(value)
        return replace(self, **changed, own=tuple(rows.map(of_motions) for rows in self.own))

    def repeat_trials(self, times: int) -> "MeasurementRows":
        """Every trial `times` times, neighbours together."""
        if times == 1:
            return self
        return self.take_trials(torch.arange(self.trials, device=self.p.device).repeat_interleave(times))

    def with_ends_of(self, other: "MeasurementRows") -> "MeasurementRows":
        """Only those shaft ends that the other rows, of the same motions, have too, and at the same places."""
        if not (self.has_ends and other.has_ends):
            return self.without_ends()
        return replace(self, end_ok=self.end_ok & other.end_ok, end_second=other.end_second)

    def put_ends(self, index: Tensor, part: "MeasurementRows") -> "MeasurementRows":
        """With what the trials `index` have of shaft ends replaced by that of others, of the same motions."""
        ok, second = (
            getattr(self, name).index_copy(1, index, getattr(part, name)) for name in ("end_ok", "end_second")
        )
        return replace(self, end_ok=ok, end_second=second)

    def without_unused_ends(self) -> "MeasurementRows":
        """Without ends at all where no trial has any."""
        return self if not self.has_ends or bool(self.end_ok.any()) else self.without_ends()

    def without_ends(self) -> "MeasurementRows":
        """Without any shaft end."""
        names = ("end_var", "end_ok", "end_kind", "end_sureness", "end_second")
        return replace(self, end_xy=self.end_xy[:, :0], **{name: getattr(self, name)[:0] for name in names})

    def keep(self, camera_ok: Bool[Tensor, "c b n"]) -> "MeasurementRows":
        """Measurements of other cameras and motions marked as not measured."""
        return replace(
            self,
            line_ok=self.line_ok & camera_ok,
            end_ok=self.end_ok & camera_ok if self.has_ends else self.end_ok,
            head_ok=self.head_ok & camera_ok if self.has_heads else self.head_ok,
            own=tuple(replace(rows, ok=rows.ok & camera_ok[rows.camera]) for rows in self.own),
        )
