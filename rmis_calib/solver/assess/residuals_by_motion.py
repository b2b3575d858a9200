"""Residuals of a solution: root mean square, per camera and motion, of each kind of measurement."""

from dataclasses import dataclass

import torch
from jaxtyping import Float
from torch import Tensor

from rmis_calib.solver.assess.observability import SHOWN_MOTIONS
from rmis_calib.solver.model.measurement_rows import END, HEAD, LINE, MeasurementRows
from rmis_calib.solver.model.residuals import residual_rows
from rmis_calib.solver.model.state import State
from rmis_calib.solver.tensors import spans


@dataclass(frozen=True)
class ResidualsByMotion:
    """Root mean square residuals per camera and motion of each kind; NaN where not measured. Those of the user's own
    measurements by name, of their camera."""

    lines: Float[Tensor, "b c n"]
    ends: Float[Tensor, "b c n"]
    heads: Float[Tensor, "b c n"]
    own: dict[str, Float[Tensor, "b n"]]


def residuals_by_motion(measured: MeasurementRows, state: State) -> ResidualsByMotion:
    """Residuals of all motions, a long recording in parts."""
    step = 8 * SHOWN_MOTIONS // measured.trials
    parts = [_residuals_of(measured.narrow(slice(None), part), state) for part in spans(measured.motions, step)]
    lines, ends, heads, *own = (torch.cat(each, dim=-1) for each in zip(*parts, strict=True))
    names = [(rows.name, rows.camera) for rows in measured.own]
    by_name = {name: value[:, camera] for (name, camera), value in zip(names, own, strict=True)}
    return ResidualsByMotion(lines, ends, heads, by_name)


def _residuals_of(measured: MeasurementRows, state: State) -> list[Float[Tensor, "b c n"]]:
    """Lines, ends, heads and each of the user's own, of motions that fit into memory at once; rows take turns between
    the cameras."""
    squares, ok, c = residual_rows(measured, state).square_(), measured.rows_ok, measured.cameras
    widths = [measured.row_kind.count(kind) for kind in (LINE, END, HEAD)] + [c * len(rows.ok) for rows in measured.own]
    out, start = [], 0
    for width in widths:
        part = slice(start, start + width)
        total, count = (x[part].unflatten(0, (-1, c)).sum(0) for x in (squares, ok))
        out.append(torch.where(count > 0, (total / count.clamp_min(1)).sqrt(), torch.nan).transpose(0, 1))
        start = part.stop
    return out
