"""Residuals of lines, contours, ends and head points, with their analytic Jacobians.

**Geometry**. In a camera's frame let p be the RCM, d the shaft's direction (RCM to tip), M = p x d,
D = |M| the distance of the axis from the optical centre, m = M/D, u = d x m the unit vector from the optical centre
to the axis' nearest point c = D u, and s0 = p.d, so that p = D u + s0 d. A plane through the optical centre that
touches a cylinder of radius r about the axis has the unit normal n with n.d = 0 and n.p = rho r, rho = +1 or -1 for the
two contours: n = cos(alpha) m + rho sin(alpha) u, sin(alpha) = r/D. The axis itself is rho = 0, n = m.

**Line row.** For a measured image point, X = (x, y, 1), f = n.X / |n_xy| is its signed distance from the predicted
line, and one unit of noise across the line is one unit of f. Move the shaft rigidly, so that a point of it at
coordinate s from the RCM moves by delta(s) = dp + s dd, and let r grow by dr. Differentiating n.d = 0 and n.p = rho r
gives dn = -(n.dd) d + e t with t = cos(alpha) u - rho sin(alpha) m, t.p = D cos(alpha), and e = (rho dr - n.dp + s0
n.dd) / (D cos(alpha)). With T = t.X the ray X touches the cylinder at s_X = X_d D cos(alpha) / T - s0 from the RCM, and
all terms collect into

    df = kappa (rho dr - n . delta(s_X)),      kappa = T / (D cos(alpha) |n_xy|):

the contour moves by what the touched point moves along the normal, seen at its depth. (|n_xy| multiplies f and is held:
its derivative is of second order at a small residual.)

**End row.** chi = X_d / X_u is the tangent of the angle in the axis plane between u and the measured end's ray, which
meets the axis at D chi - s0 from the RCM. The residual is chi - (s0 + s_e)/D, divided by |d chi / d g| for a step g
along the imaged axis, so that noise along the axis has unit effect. Moving the shaft by delta moves the ray's meeting
point by chi (u.delta) - d.delta along it:

    de = -(d - chi u) . delta(s_e) / (D |d chi / d g|),      and d e / d s_e = -1 / (D |d chi / d g|).

**Head row.** y - pi(q), q the head point, pi the pinhole: de = -J_pi(q) dq.

**One form for all rows.** A rigid motion of the shaft (rotation phi about the RCM, translation tau) moves a point at
the vector h from the RCM by tau + phi x h. So each row is w.(tau + phi x h) = w.tau + a.phi with a = h x w, h = s d for
lines and ends. From (w, a) follow
 - a change of the hand-eye transform, R <- exp(dphi) R, t <- t + dt: phi = dphi, tau = dphi x (p - t) + dt, so the
   columns are (p - t) x w + a and w; the stereo extrinsics, perturbed on the right like their noise, have p x w + a and
   w in the rows of the left camera;
 - noise of `arm_T_rcm`: isotropic, so its covariance of rows i, j is sigma_mm^2 w_i.w_j + sigma_rad^2 a_i.a_j in any
   frame;
 - joint offsets, clock and RCM offset: w.tau + a.phi of the displacement that they cause.
So every nuisance and every noise source costs scalar products only. `tests/solver/model/test_residuals.py` holds all
of this against `torch.func.jacrev`.
"""

from dataclasses import dataclass, replace

import torch
import torch.autograd.forward_ad as forward_ad
from jaxtyping import Float
from torch import Tensor

from rmis_calib.errors import InputError
from rmis_calib.geometry.cameras import corrected_point
from rmis_calib.solver.model.batched_linalg import batch_last, cross, dot, rotate, rotate_trials
from rmis_calib.solver.model.forward_mode import load_forward_mode
from rmis_calib.solver.model.linearised_rows import LinearisedRows
from rmis_calib.solver.model.measurement_rows import MeasurementRows
from rmis_calib.solver.model.own_rows import own_rows, shaft_poses, with_own_rows
from rmis_calib.solver.model.predicted_shaft import Shaft, camera_poses, matters, predict_shaft, shaft_at
from rmis_calib.solver.model.state import State

MAX_SINE = 0.99
"""Clamp of r/D. A shaft nearer than that would touch the lens; only trial steps get there."""
MIN_COSINE = 1e-6
"""Smallest T and X_u divided by: a ray along the axis meets it nowhere."""


def residual_rows(measured: MeasurementRows, state: State) -> Float[Tensor, "k b n"]:
    """Residuals alone."""
    if measured.clock is not None and matters(state.readout):
        return linearise(measured, state)[0].r
    shaft = predict_shaft(measured, state)
    own = [rows.among(measured.cameras, own_rows(rows, *shaft_poses(rows, measured, state))) for rows in measured.own]
    return torch.where(measured.rows_ok, torch.cat((_rows(measured, state, shaft), *own)), 0.0)


def _rows(measured: MeasurementRows, state: State, shaft: Shaft) -> Float[Tensor, "k b n"]:
    """Residuals of what is built in, of a shaft wherever it is; its radius, end and edges are those of the state."""
    parts = [_line_geometry(measured, state, shaft).f.flatten(0, 1)]
    if measured.has_ends:
        parts.append(_end_geometry(measured, state, shaft)[0])
    if measured.has_heads:
        parts.append(_head_geometry(measured, state, shaft)[0].flatten(0, 1))
    return torch.cat(parts)


def linearise(measured: MeasurementRows, state: State) -> tuple[LinearisedRows, Shaft]:
    """Residuals with their effects of a rigid motion of the shaft.

    n, m and u all lie across d, so d x n = cos(alpha) u - rho sin(alpha) m and d x u = -m: w and a of lines and ends
    are combinations of the axes m, u and d, which alone are turned into `camera_right`.
    """
    shaft = predict_shaft(measured, state)
    built_in = _linearise_by_autograd if measured.autograd else _linearise_analytically
    linear = built_in(measured, state, shaft)
    linear = with_own_rows(linear, measured, state, shaft) if measured.own else linear
    if measured.clock is not None and matters(state.readout):
        linear = replace(linear, r=linear.r + state.readout[:, None] * read_later(linear, measured, state))
    return linear, shaft


def displaced_rows(linear: LinearisedRows, R: Tensor, displacement: Float[Tensor, "6 b n"]) -> Float[Tensor, "k b n"]:
    """Effect on every row of a displacement (rotation, translation; in `arm`) of the shaft.

    Args:
        R: `camera_right_R_arm`, batch last.
    """
    turn, shift = rotate(R, displacement[:3]), rotate(R, displacement[3:])
    return dot(linear.a, turn[:, None]) + dot(linear.w, shift[:, None])


def read_later(linear: LinearisedRows, measured: MeasurementRows, state: State) -> Float[Tensor, "k b n"]:
    """Effect of a second from a row to the one that is a focal length farther down: there the shaft is where it moves
    to by then."""
    if measured.clock is None:
        raise InputError(where="readout", expected="derivatives of the kinematics by the clock", found="none")
    R = batch_last(state.R, 2)[..., None]
    return displaced_rows(linear, R, measured.clock[:, 0]) * measured.rows_y


def _linearise_analytically(measured: MeasurementRows, state: State, shaft: Shaft) -> LinearisedRows:
    """What is built in, by the formulas at the top of this file."""
    camera_R, _ = camera_poses(measured, state)
    m, u, d = _into_right(camera_R, torch.stack((shaft.m, shaft.u, shaft.d), dim=1)).unsqueeze(2).unbind(1)
    lines, c = measured.line_xy.shape[1], measured.cameras
    ends = c * measured.has_ends
    shape = (lines * c + ends + 2 * c * measured.has_heads, *shaft.D.shape[1:])
    r, radius, end = (shaft.D.new_zeros(shape) for _ in range(3))
    w, a = (shaft.D.new_empty((3, *shape)) for _ in range(2))
    seen, ok = _line_geometry(measured, state, shaft), measured.line_ok
    part = slice(0, lines * c)
    kappa, kappa_s = torch.where(ok, seen.kappa, 0.0), torch.where(ok, seen.kappa_s, 0.0)
    r[part] = torch.where(ok, seen.f, 0.0).flatten(0, 1)
    radius[part] = (kappa * measured.line_rho).flatten(0, 1)
    for out, along_m, along_u in (
        (w, -kappa * seen.cosine, -kappa * seen.sine),
        (a, kappa_s * seen.sine, -kappa_s * seen.cosine),
    ):
        out = out[:, part].unflatten(1, (lines, c))
        _write(out, along_m, m, along_u, u)
    if measured.has_ends:
        part = slice(lines * c, lines * c + ends)
        e, chi, s_end, gain = _end_geometry(measured, state, shaft)
        gain = torch.where(measured.end_ok, gain, 0.0)
        r[part], end[part] = torch.where(measured.end_ok, e, 0.0), -gain
        _write(w[:, part], -gain, d[:, 0], gain * chi, u[:, 0])
        a[:, part] = -gain * chi * s_end * m[:, 0]
    if measured.has_heads:
        part = slice(lines * c + ends, None)
        e, w_head = _head_geometry(measured, state, shaft)
        both = torch.cat((w_head, cross(shaft.head[:, None].expand_as(w_head), w_head)), dim=1)
        both = torch.where(measured.head_ok, _into_right(camera_R, both), 0.0)
        r[part] = torch.where(measured.head_ok, e, 0.0).flatten(0, 1)
        w[:, part], a[:, part] = both[:, :2].flatten(1, 2), both[:, 2:].flatten(1, 2)
    return LinearisedRows(r=r, w=w, a=a, radius=radius, end=end)


def _write(out: Tensor, x: Tensor, a: Tensor, y: Tensor, b: Tensor) -> None:
    """Writes x a + y b into `out`; without a temporary, unless autograd looks on."""
    if x.requires_grad:
        out.copy_(torch.addcmul(x * a, y, b))
    else:
        torch.mul(x, a, out=out).addcmul_(y, b)


def _linearise_by_autograd(measured: MeasurementRows, state: State, shaft: Shaft) -> LinearisedRows:
    """The same effects from forward-mode autograd, in one pass.

    Each row depends on its own motion alone, so a step of all shafts at once gives a column of all rows. The eight
    steps (three of a translation, three of a rotation, radius, end) stand side by side as trials.
    """
    load_forward_mode()
    steps, b = 8, measured.trials
    index = torch.arange(b, device=shaft.D.device).repeat(steps)
    many, at, camera_R = measured.take_trials(index), state.take(index), camera_poses(measured, state)[0][index]
    p, d, head = (vectors[:, :, index] for vectors in (shaft.p, shaft.d, shaft.head))
    tangent = torch.eye(steps, dtype=p.dtype, device=p.device).repeat_interleave(b, dim=1)

    def rows(step: Float[Tensor, "8 b"]) -> Float[Tensor, "k b n"]:
        tau, phi = rotate_trials(camera_R, step[:3, :, None]), rotate_trials(camera_R, step[3:6, :, None])
        moved = shaft_at(p + tau, d + cross(phi, d), head + cross(phi, head))
        return _rows(many, replace(at, radius=at.radius + step[6], end_offset=at.end_offset + step[7]), moved)

    with torch.inference_mode(False), torch.no_grad(), forward_ad.dual_level():
        effect = forward_ad.unpack_dual(rows(forward_ad.make_dual(torch.zeros_like(tangent), tangent))).tangent
        if effect is None:
            raise InputError(where="residuals", expected="rows that depend on the shaft", found="none")
        effect = torch.where(many.rows_ok[: len(effect)], effect, 0.0).unflatten(1, (steps, b)).transpose(0, 1)
    r = _rows(measured, state, shaft)
    r = torch.where(measured.rows_ok[: len(r)], r, 0.0)
    return LinearisedRows(r, effect[:3], effect[3:6], effect[6], effect[7])


def _into_right(camera_R: Float[Tensor, "b c 3 3"], v: Float[Tensor, "3 m c b n"]) -> Float[Tensor, "3 m c b n"]:
    """Vectors of each camera's frame turned into `camera_right`."""
    back = camera_R.permute(1, 0, 3, 2).expand(v.shape[1], -1, -1, -1, -1).flatten(0, 2)
    return torch.matmul(back, v.flatten(1, 3).transpose(0, 1)).transpose(0, 1).unflatten(1, v.shape[1:4])


@dataclass(frozen=True)
class LineGeometry:
    """Residuals f of the line rows and what their derivatives consist of; all but `n_image` are (l, c, b, n).

    Attributes:
        f: signed distance of the measured point from the predicted line.
        sine, cosine: rho sin(alpha) and cos(alpha).
        kappa: effect of the touched point's motion along the normal; kappa_s: times its coordinate from the RCM.
        n_image: the predicted line's direction across itself, unit, in the image (2, l, c, b, n).
    """

    f: Float[Tensor, "l c b n"]
    sine: Float[Tensor, "l c b n"]
    cosine: Float[Tensor, "l c b n"]
    kappa: Float[Tensor, "l c b n"]
    kappa_s: Float[Tensor, "l c b n"]
    n_image: Float[Tensor, "2 l c b n"]


def _line_geometry(measured: MeasurementRows, state: State, shaft: Shaft, radius: Tensor | float = 0.0) -> LineGeometry:
    x, y = corrected_points(measured.line_xy, state).unbind()
    sine = (measured.line_rho * (state.radius[:, None] / shaft.D)).clamp(-MAX_SINE, MAX_SINE)
    cosine = (1.0 - sine.square()).sqrt()
    n_image = torch.addcmul(cosine * shaft.m[:2, None], sine, shaft.u[:2, None])
    n_xy = _held(measured, n_image.square().sum(0).sqrt().clamp_min(1e-12))
    X_m, X_u, X_d = (_along(axis, x, y) for axis in (shaft.m, shaft.u, shaft.d))
    f = torch.addcmul(cosine * X_m, sine, X_u) / n_xy
    if matters(state.edge_bias):
        f = f + state.edge_bias.permute(1, 2, 0)[..., None]
    kappa = torch.addcmul(cosine * X_u, sine, X_m, value=-1.0) / (shaft.D * cosine * n_xy)
    return LineGeometry(f, sine, cosine, kappa, X_d / n_xy - kappa * shaft.s0, n_image / n_xy)


def corrected_points(xy: Float[Tensor, "2 *k c b n"], state: State) -> Float[Tensor, "2 *k c b n"]:
    """Image points once each camera's intrinsics are corrected by the state's (`cameras.corrected_point`)."""
    if not matters(state.intrinsics):
        return xy
    changes = state.intrinsics.permute(2, 1, 0)[..., None].unbind()  # four of (c, b, 1)
    return torch.stack(corrected_point(*xy.unbind(), *changes))


def intrinsic_effects(measured: MeasurementRows, state: State, shaft: Shaft) -> Float[Tensor, "q k b n"]:
    """Effects of each camera's four corrections on every row, camera by camera."""
    rows = [(_line_geometry(measured, state, shaft).n_image, measured.line_xy)]
    if measured.has_ends:
        _, chi, _, gain = _end_geometry(measured, state, shaft)
        X_u = _along(shaft.u, *corrected_points(measured.end_xy, state).unbind())
        X_u = torch.where(X_u.abs() < MIN_COSINE, MIN_COSINE, X_u)
        # d e / d xy = (d chi / d xy) / slope, with chi = X_d / X_u and 1 / slope = gain D
        across = (shaft.d[:2] - chi * shaft.u[:2]) * (gain * shaft.D / X_u)
        rows.append((across[:, None], measured.end_xy[:, None]))
    if measured.has_heads:
        eye = torch.eye(2, dtype=shaft.D.dtype, device=shaft.D.device)[..., None, None, None]
        rows.append((eye.expand(2, 2, *shaft.D.shape), measured.head_xy[:, None].expand(2, 2, *shaft.D.shape)))
    effects = []
    for normal, xy in rows:
        x, y = xy.unbind()
        r2 = x * x + y * y
        along = normal[0] * x + normal[1] * y
        effects.append(torch.stack((along, normal[0].expand_as(x), normal[1].expand_as(x), along * r2)))
    if measured.own:
        effects.append(effects[0].new_zeros((4, measured.own_components, *effects[0].shape[2:])))
    effect = torch.cat(effects, dim=1)  # (4, rows a camera, c, b, n)
    cameras = torch.eye(measured.cameras, dtype=effect.dtype, device=effect.device)
    by_camera = effect[None] * cameras[:, None, None, :, None, None]  # (c', 4, rows a camera, c, b, n)
    return torch.where(measured.rows_ok, by_camera.flatten(2, 3).flatten(0, 1), 0.0)


def _along(axis: Float[Tensor, "3 c b n"], x: Float[Tensor, "*l c b n"], y: Float[Tensor, "*l c b n"]) -> Tensor:
    """Component of the rays (x, y, 1) along an axis."""
    first, second, third = axis.unbind()
    return torch.addcmul(torch.addcmul(third, first, x), second, y)


def _held(measured: MeasurementRows, value: Tensor) -> Tensor:
    """The value without its derivative, which is of second order at a small residual (see the top of this file)."""
    return value if measured.exact else value.detach()


def _end_geometry(measured: MeasurementRows, state: State, shaft: Shaft) -> tuple[Tensor, Tensor, Tensor, Tensor]:
    """e, chi, s_e and d e / d s_e without its sign, all (c, b, n)."""
    x, y = corrected_points(measured.end_xy, state).unbind()
    u, d, m = shaft.u, shaft.d, shaft.m
    X_u, X_d = _along(u, x, y), _along(d, x, y)
    X_u = torch.where(X_u.abs() < MIN_COSINE, MIN_COSINE, X_u)
    chi = X_d / X_u
    image_m = m[:2]
    m_xy = image_m.square().sum(0).sqrt().clamp_min(1e-12)
    step = d[:2] - chi * u[:2]
    across = torch.addcmul(step[1] * image_m[0], step[0], image_m[1], value=-1.0)
    slope = _held(measured, (across / m_xy).abs().clamp_min(1e-12) / X_u.abs())
    s_end = predicted_s_end(measured, state).expand_as(chi)
    gain = (shaft.D * slope).reciprocal()
    if measured.autograd:  # the same value; its derivative is that of the predicted end, seen from a held direction
        return -dot(_held(measured, d - chi * u), shaft.p + s_end * d) * _held(measured, gain), chi, s_end, gain
    return (chi - (shaft.s0 + s_end) / shaft.D) / slope, chi, s_end, gain


def predicted_s_end(measured: MeasurementRows, state: State) -> Float[Tensor, "e b n"]:
    """Coordinate along the axis of the place at which each end is measured, mm."""
    first = measured.s_end + state.end_offset[:, None]
    return first + measured.end_second * state.end_gap[:, None] if matters(state.end_gap) else first[None]


def _head_geometry(measured: MeasurementRows, state: State, shaft: Shaft) -> tuple[Tensor, Tensor]:
    """e (2, c, b, n) and w (3, 2, c, b, n)."""
    q = shaft.p + shaft.head
    depth = torch.where(q[2].abs() < MIN_COSINE, MIN_COSINE, q[2])
    x, y, zero = q[0] / depth, q[1] / depth, torch.zeros_like(depth)
    seen = corrected_points(measured.head_xy, state)
    e = torch.stack((seen[0] - x, seen[1] - y))
    w = torch.stack(
        (torch.stack((-1.0 / depth, zero)), torch.stack((zero, -1.0 / depth)), torch.stack((x / depth, y / depth)))
    )
    return e, w
