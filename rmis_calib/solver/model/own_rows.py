"""Rows of the user's own measurements: residuals, and their effects by forward-mode autograd."""

import torch
import torch.autograd.forward_ad as forward_ad
from jaxtyping import Float
from torch import Tensor

from rmis_calib.errors import InputError
from rmis_calib.geometry.rotations import rotvec_to_matrix
from rmis_calib.solver.model.forward_mode import load_forward_mode
from rmis_calib.solver.model.linearised_rows import LinearisedRows
from rmis_calib.solver.model.measurement_rows import MeasurementRows, OwnRows
from rmis_calib.solver.model.predicted_shaft import Shaft, camera_poses, corrected_shaft
from rmis_calib.solver.model.state import State


def with_own_rows(linear: LinearisedRows, measured: MeasurementRows, state: State, shaft: Shaft) -> LinearisedRows:
    """The rows with those of the user's own measurements, whose effects come from forward-mode autograd: six steps of
    the shaft side by side, three of a translation and three of a rotation about the RCM, in `camera_right`."""
    camera_R, _ = camera_poses(measured, state)
    parts = {name: [getattr(linear, name)] for name in ("r", "w", "a", "radius", "end")}
    on_graph = torch.is_grad_enabled() and not torch.is_inference_mode_enabled()
    load_forward_mode()
    for rows in measured.own:
        R, t = shaft_poses(rows, measured, state)
        axes = camera_R[:, rows.camera].permute(2, 0, 1)  # those of `camera_right`, (3, b, 3)
        axes = axes[:, :, None].expand(3, *t.shape)
        p = shaft.p[:, rows.camera].permute(1, 2, 0)
        dR = torch.cat((R.new_zeros((3, *R.shape)), torch.linalg.cross(axes[..., None], R.expand(3, *R.shape), dim=-2)))
        dt = torch.cat((axes, torch.linalg.cross(axes, (t - p).expand(3, *t.shape), dim=-1)))
        values = {key: value.movedim((-2, -1), (0, 1)) for key, value in rows.values.items()}
        with torch.inference_mode(False), torch.set_grad_enabled(on_graph), forward_ad.dual_level():
            many_R = forward_ad.make_dual(R.expand(6, *R.shape).clone(), dR.clone())
            many_t = forward_ad.make_dual(t.expand(6, *t.shape).clone(), dt.clone())
            value, effect = forward_ad.unpack_dual(rows.residual(many_R, many_t, **values))
        if effect is None:
            raise InputError(where="own measurement", expected="a residual that depends on the transform", found="none")
        r = value[0].movedim(-1, 0) + rows.shift
        effect = torch.where(rows.ok, effect.movedim(-1, 1), 0.0)
        zero = torch.zeros_like(r)
        found = {"r": torch.where(rows.ok, r, 0.0), "w": effect[:3], "a": effect[3:], "radius": zero, "end": zero}
        for name, value in found.items():
            parts[name].append(rows.among(measured.cameras, value))
    return LinearisedRows(**{name: torch.cat(part, dim=-3) for name, part in parts.items()})


def own_rows(rows: OwnRows, R: Float[Tensor, "b n 3 3"], t: Float[Tensor, "b n 3"]) -> Float[Tensor, "m b n"]:
    """Residuals of one measurement of the user's own, from `shaft_poses`."""
    values = {key: value.movedim((-2, -1), (0, 1)) for key, value in rows.values.items()}
    return rows.residual(R, t, **values).movedim(-1, 0) + rows.shift


def shaft_poses(
    rows: OwnRows, measured: MeasurementRows, state: State
) -> tuple[Float[Tensor, "b n 3 3"], Float[Tensor, "b n 3"]]:
    """`camera_T_arm` for every motion, by which what `arm` tells of the instrument comes to be where the offsets move
    it: x -> p' + exp(phi) (x - p), for a displacement of the shaft that takes the RCM from p to p'."""
    p, _, _, phi = corrected_shaft(measured, state)
    camera_R, camera_t = (x[:, rows.camera] for x in camera_poses(measured, state))
    R = camera_R @ state.R
    t = (camera_R @ state.t[..., None])[..., 0] + camera_t
    before, after, turn, first = (x.permute(1, 2, 0) for x in (measured.p - rows.moved, p, phi, rows.turn))
    turned = rotvec_to_matrix(turn) @ rotvec_to_matrix(first)
    shift = after - (turned @ before[..., None])[..., 0]
    return R[:, None] @ turned, (R[:, None] @ shift[..., None])[..., 0] + t[:, None]
