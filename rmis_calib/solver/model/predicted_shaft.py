"""The shaft that a state predicts: what the offsets do to it in `arm`, and where each camera sees it."""

from dataclasses import dataclass

import torch
from jaxtyping import Float
from torch import Tensor

from rmis_calib.solver.model.batched_linalg import cross, dot, rotate_trials, unit
from rmis_calib.solver.model.compliance import FUNCTIONS, basis
from rmis_calib.solver.model.measurement_rows import MeasurementRows
from rmis_calib.solver.model.state import State


@dataclass(frozen=True)
class Shaft:
    """Predicted shaft in every camera's frame, component first: p, d, m, u (3, c, b, n), D and s0 (c, b, n)."""

    p: Float[Tensor, "3 c b n"]
    d: Float[Tensor, "3 c b n"]
    m: Float[Tensor, "3 c b n"]
    u: Float[Tensor, "3 c b n"]
    D: Float[Tensor, "c b n"]
    s0: Float[Tensor, "c b n"]
    head: Float[Tensor, "3 c b n"]


def camera_poses(measured: MeasurementRows, state: State) -> tuple[Float[Tensor, "b c 3 3"], Float[Tensor, "b c 3"]]:
    """`camera_T_camera_right` of the state."""
    R, t = measured.camera_R.permute(3, 2, 0, 1), measured.camera_t.permute(2, 1, 0)
    if measured.cameras == 2:
        R, t = torch.stack((R[:, 0], state.stereo_R), dim=1), torch.stack((t[:, 0], state.stereo_t), dim=1)
    return R, t


def rcm_axes(
    R: Float[Tensor, "3 3 ..."], v: Float[Tensor, "3 ..."]
) -> tuple[Float[Tensor, "3 ..."], Float[Tensor, "3 ..."]]:
    """Two unit directions across the shaft, fixed to `rcm`, in `arm`: the axis of `rcm` that follows the one nearest to
    the shaft (x, y, z, x) made perpendicular to it, and the shaft times that.

    The offset is one constant only while the choice stays the same: while the shaft keeps within 45 degrees of one
    axis. (To compare the two axes that lie across the shaft instead changes the choice from motion to motion.)

    Args:
        R: `arm_R_rcm`.
        v: direction of the shaft, in `arm`.
    """
    along = torch.stack([dot(R[:, i], v).abs() for i in range(3)])
    nearest = along.argmax(0)
    axis = torch.where(nearest == 2, R[:, 0], torch.where(nearest == 0, R[:, 1], R[:, 2]))
    e1 = unit(axis - dot(axis, v) * v)
    return e1, cross(v, e1)


def predict_shaft(measured: MeasurementRows, state: State) -> Shaft:
    """The shaft in the frame of each camera."""
    arm_p, arm_v, arm_head, _ = corrected_shaft(measured, state)
    camera_R, camera_t = camera_poses(measured, state)
    R = camera_R @ state.R[:, None]
    t = (camera_R @ state.t[:, None, :, None])[..., 0] + camera_t
    p = rotate_trials(R, arm_p) + t.permute(2, 1, 0)[..., None]
    d = rotate_trials(R, arm_v)
    return shaft_at(p, d, rotate_trials(R, arm_head) if measured.has_heads else d)


def shaft_at(p: Float[Tensor, "3 c b n"], d: Float[Tensor, "3 c b n"], head: Float[Tensor, "3 c b n"]) -> Shaft:
    M = cross(p, d)
    D = dot(M, M).sqrt().clamp_min(1e-9)
    s0 = dot(p, d)
    return Shaft(p=p, d=d, m=M / D, u=torch.addcmul(p, s0, d, value=-1.0) / D, D=D, s0=s0, head=head)


def corrected_shaft(measured: MeasurementRows, state: State) -> tuple[Tensor, Tensor, Tensor, Tensor]:
    """RCM, direction and head vector in `arm` with the estimated offsets applied, to first order in the rotation; and
    that rotation."""
    p, v, head = measured.p, measured.v, measured.head
    if matters(state.rcm_offset):
        e1, e2 = rcm_axes(measured.R, measured.v)
        p = p + state.rcm_offset[:, 0, None] * e1 + state.rcm_offset[:, 1, None] * e2
    displacement = None
    if measured.joint is not None and matters(state.joint_offset):
        displacement = (measured.joint * state.joint_offset.T[:, :, None]).sum(1)
    if measured.clock is not None and matters(state.clock):
        moved = (measured.clock * state.clock.T[:, :, None]).sum(1)
        displacement = moved if displacement is None else displacement + moved
    if measured.setup is not None and matters(state.setup):
        moved = (measured.setup * state.setup.T[:, :, None]).sum(1)
        displacement = moved if displacement is None else displacement + moved
    if matters(state.compliance):
        moved = _given_way(measured, state)
        displacement = moved if displacement is None else displacement + moved
    if displacement is not None:
        p = p + displacement[3:]
        v = unit(v + cross(displacement[:3], v))
        head = head + cross(displacement[:3], head)
    return p, v, head, torch.zeros_like(p) if displacement is None else displacement[:3]


def _given_way(measured: MeasurementRows, state: State) -> Float[Tensor, "6 b n"]:
    """Displacement of the shaft by what the arm gives way, in `arm`."""
    coefficient = state.compliance.unflatten(-1, (-1, FUNCTIONS)).permute(1, 2, 0)[..., None]  # (component, f, b, 1)
    turn1, turn2, shift1, shift2, along = (coefficient * basis(measured.pose)).sum(1)
    e1, e2 = rcm_axes(measured.R, measured.v)
    return torch.cat((turn1 * e1 + turn2 * e2, shift1 * e1 + shift2 * e2 + along * measured.v))


def matters(offset: Tensor) -> bool:
    """Whether an offset has an effect, or a derivative. On an accelerator it counts without being looked at: to ask
    waits for everything that is queued, which takes longer than to add zero."""
    return offset.requires_grad or offset.device.type != "cpu" or bool(offset.any())
