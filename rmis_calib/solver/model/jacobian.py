"""Columns of the Jacobian: what a unit of each parameter does to the residuals."""

import torch
from jaxtyping import Float
from torch import Tensor

from rmis_calib.errors import InputError
from rmis_calib.solver.model.batched_linalg import add_cross_, batch_last, cross, dot, rotate
from rmis_calib.solver.model.compliance import TURNS, basis
from rmis_calib.solver.model.linearised_rows import LinearisedRows
from rmis_calib.solver.model.measurement_rows import END, LINE, MeasurementRows
from rmis_calib.solver.model.parameters import GIVEN_WAY, ParameterLayout
from rmis_calib.solver.model.predicted_shaft import Shaft, rcm_axes
from rmis_calib.solver.model.residuals import displaced_rows, intrinsic_effects, read_later
from rmis_calib.solver.model.state import State


def columns(
    layout: ParameterLayout,
    linear: LinearisedRows,
    shaft: Shaft,
    measured: MeasurementRows,
    state: State,
    out: Float[Tensor, "k p b n"] | None = None,
) -> Float[Tensor, "k p b n"]:
    """Jacobian of the residuals, in the order of the layout's blocks (residuals.py derives it).

    Args:
        out: where to write it; not where autograd looks on.
    """
    if linear.r.requires_grad:
        blocks = [columns_of(name, linear, shaft, measured, state) for name in layout.blocks]
        return torch.cat(blocks).transpose(0, 1)
    if out is None:
        out = linear.r.new_empty((linear.r.shape[0], layout.size, *linear.r.shape[1:]))
    by_parameter = out.transpose(0, 1)  # (p, k, b, n)
    right_p = shaft.p[:, 0]

    def turned(target: Tensor, lever: Tensor, w: Tensor, a: Tensor) -> None:
        add_cross_(target.copy_(a), lever, w)

    turned(by_parameter[layout.blocks["rotation"]], right_p - state.t.T[..., None], linear.w, linear.a)
    by_parameter[layout.blocks["translation"]] = linear.w
    for name in ("stereo_rotation", "stereo_translation"):
        if name in layout.blocks:  # rows alternate between the cameras: the left one's are every second
            target = by_parameter[layout.blocks[name]].zero_()[:, 1::2]
            if name == "stereo_rotation":
                turned(target, right_p, linear.w[:, 1::2], linear.a[:, 1::2])
            else:
                target.copy_(linear.w[:, 1::2])
    for name, part in layout.blocks.items():
        if name not in ("rotation", "translation", "stereo_rotation", "stereo_translation"):
            by_parameter[part] = columns_of(name, linear, shaft, measured, state)
    return out


def columns_of(
    name: str, linear: LinearisedRows, shaft: Shaft, measured: MeasurementRows, state: State
) -> Float[Tensor, "q k b n"]:
    """Columns of one block, without writing in place."""
    right_p = shaft.p[:, :1]
    if name == "rotation":
        return linear.a + cross(right_p - state.t.T[:, None, :, None], linear.w)
    if name == "translation":
        return linear.w
    if name in ("stereo_rotation", "stereo_translation"):
        left = torch.arange(linear.r.shape[0], device=linear.r.device)[:, None, None] % 2 == 1
        return torch.where(left, linear.a + cross(right_p, linear.w) if name == "stereo_rotation" else linear.w, 0.0)
    if name == "radius":
        return linear.radius[None]
    if name == "end_offset":
        return linear.end[None]
    if name == "end_gap":
        return _at_second_place(measured, linear.end)[None]
    if name == "intrinsics":
        return intrinsic_effects(measured, state, shaft)
    if name == "edge_bias":
        return _shifts(measured, linear.r).transpose(0, 1)
    return _displaced(name, linear, measured, state)


def _displaced(name: str, linear: LinearisedRows, measured: MeasurementRows, state: State) -> Float[Tensor, "q k b n"]:
    """Columns of the unknowns that move the shaft in `arm`."""
    R = batch_last(state.R, 2)[..., None]
    if name == "rcm_offset":
        return torch.stack([dot(linear.w, rotate(R, e)[:, None]) for e in rcm_axes(measured.R, measured.v)])
    if measured.joint is not None and name == "joint_offset":
        return torch.stack([displaced_rows(linear, R, motion) for motion in measured.joint.unbind(1)])
    if name == "readout":
        return read_later(linear, measured, state)[None]
    if name in ("compliance", GIVEN_WAY):
        axes = [rotate(R, e)[:, None] for e in (*rcm_axes(measured.R, measured.v), measured.v)]
        turns, shifts = [dot(linear.a, e) for e in axes[:TURNS]], [dot(linear.w, e) for e in axes]
        effects = torch.stack((*turns, *shifts))
        return effects if name == GIVEN_WAY else (effects[:, None] * basis(measured.pose)[:, None]).flatten(0, 1)
    if measured.setup is not None and name == "setup":
        return torch.stack([displaced_rows(linear, R, motion) for motion in measured.setup.unbind(1)])
    if measured.clock is not None and name in ("clock", "clock_rate"):
        return displaced_rows(linear, R, measured.clock[:, int(name == "clock_rate")])[None]
    raise InputError(where=name, expected="derivatives of the kinematics", found="none")


def _at_second_place(measured: MeasurementRows, end: Float[Tensor, "k b n"]) -> Float[Tensor, "k b n"]:
    """The effect of a longer shaft on the ends at the second place alone."""
    rows = [index for index, kind in enumerate(measured.row_kind) if kind == END]
    second = torch.zeros_like(end)
    second[rows] = measured.end_second
    return end * second


def _shifts(measured: MeasurementRows, like: Float[Tensor, "k b n"]) -> Float[Tensor, "k s b n"]:
    """A unit shift of each line row where it was measured; line rows come first."""
    count = measured.row_kind.count(LINE)
    unit = torch.eye(like.shape[0], count, dtype=like.dtype, device=like.device)
    return unit[:, :, None, None] * measured.rows_ok[:, None]
