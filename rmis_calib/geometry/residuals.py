"""What a measurement says about `camera_T_arm`: one differentiable function an equation, for any leading batch.

Every function is plain torch: gradients pass to every tensor, forward and backward, and leading axes broadcast. The
image is normalised and undistorted (x/z, y/z); lengths are mm. The shaft is given in `arm`: its pivot `arm_p_rcm` and
its unit direction `arm_v`, RCM to tip. The same equations, component first and with analytic derivatives, are what the
solver runs (solver/model/residuals.py, which derives them); the tests hold one against the other.

    residual = lambda q, t: rc.residuals.head(quat_to_matrix(q)[..., None, :, :], t[..., None, :], arm_p_head, xy)
"""

import torch
from jaxtyping import Float
from torch import Tensor

_SMALLEST = 1e-12


def axis_plane(xy: Float[Tensor, "*batch 2 2"]) -> Float[Tensor, "*batch 3"]:
    """Unit normal of the plane through the optical centre and an imaged line (paper, section "Shaft detection").

    Args:
        xy: two points of the line.
    """
    rays = torch.cat((xy, torch.ones_like(xy[..., :1])), dim=-1)
    return torch.nn.functional.normalize(torch.linalg.cross(rays[..., 0, :], rays[..., 1, :]), dim=-1)


def axis_rotation(
    camera_R_arm: Float[Tensor, "*#batch 3 3"], arm_v: Float[Tensor, "*#batch 3"], n: Float[Tensor, "*#batch 3"]
) -> Float[Tensor, "..."]:
    """n.(R v): sine of the angle between the shaft's direction and its plane (paper, Eqs. 6, 9 and 14).

    Args:
        n: unit normal of the plane, in the camera (`axis_plane`). For the left camera turn it into `camera_right` first
            (Eq. 8), or give `camera_left_R_arm`.
    """
    return (n * _turned(camera_R_arm, arm_v)).sum(-1)


def axis_translation(
    camera_R_arm: Float[Tensor, "*#batch 3 3"],
    camera_t_arm: Float[Tensor, "*#batch 3"],
    arm_p_rcm: Float[Tensor, "*#batch 3"],
    n: Float[Tensor, "*#batch 3"],
) -> Float[Tensor, "..."]:
    """n.(R p + t): distance of the RCM from the plane of the imaged axis, mm (paper, Eqs. 20 to 23)."""
    return (n * (_turned(camera_R_arm, arm_p_rcm) + camera_t_arm)).sum(-1)


def contour(
    camera_R_arm: Float[Tensor, "*#batch 3 3"],
    camera_t_arm: Float[Tensor, "*#batch 3"],
    arm_p_rcm: Float[Tensor, "*#batch 3"],
    arm_v: Float[Tensor, "*#batch 3"],
    radius_mm: Float[Tensor, "*#batch"] | float,
    xy: Float[Tensor, "*#batch 2"],
    side: float,
) -> Float[Tensor, "..."]:
    """Signed distance of an image point from the predicted contour of the shaft, normalised units (DESIGN.md, 4).

    With p, d the RCM and the direction in the camera, M = p x d, m = M/|M|, u = d x m and sin(alpha) = r/|M|, the plane
    that touches the cylinder has the normal n = cos(alpha) m + side sin(alpha) u, and the residual is n.X / |n_xy|.

    Args:
        side: +1 for the contour left of the axis, directed RCM to tip in the picture (edge 0), -1 for the other, 0 for
            the axis itself.
    """
    m, u, distance = _axis_frame(camera_R_arm, camera_t_arm, arm_p_rcm, arm_v)[:3]
    sine = side * radius_mm / distance
    n = (1.0 - sine.square()).sqrt()[..., None] * m + sine[..., None] * u
    return ((n[..., :2] * xy).sum(-1) + n[..., 2]) / torch.linalg.vector_norm(n[..., :2], dim=-1).clamp_min(_SMALLEST)


def end(
    camera_R_arm: Float[Tensor, "*#batch 3 3"],
    camera_t_arm: Float[Tensor, "*#batch 3"],
    arm_p_rcm: Float[Tensor, "*#batch 3"],
    arm_v: Float[Tensor, "*#batch 3"],
    s_end_mm: Float[Tensor, "*#batch"] | float,
    xy: Float[Tensor, "*#batch 2"],
) -> Float[Tensor, "..."]:
    """Distance along the imaged axis of a measured shaft end from the predicted one, normalised units (DESIGN.md, 4).

    chi = X_d / X_u is the tangent of the angle, in the plane of the axis, between the point of the axis nearest to the
    camera and the measured ray; (s0 + s_end) / |M| is its prediction. Their difference is divided by its change for a
    step along the imaged axis.

    Args:
        s_end_mm: coordinate of the end along the axis, from the RCM.
    """
    m, u, distance, d, s0 = _axis_frame(camera_R_arm, camera_t_arm, arm_p_rcm, arm_v)
    rays = torch.cat((xy, torch.ones_like(xy[..., :1])), dim=-1)
    X_u, X_d = (u * rays).sum(-1), (d * rays).sum(-1)
    chi = X_d / X_u
    step = d[..., :2] - chi[..., None] * u[..., :2]
    across = step[..., 1] * m[..., 0] - step[..., 0] * m[..., 1]
    m_xy = torch.linalg.vector_norm(m[..., :2], dim=-1).clamp_min(_SMALLEST)
    slope = (across / m_xy).abs().clamp_min(_SMALLEST) / X_u.abs()
    return (chi - (s0 + s_end_mm) / distance) / slope


def head(
    camera_R_arm: Float[Tensor, "*#batch 3 3"],
    camera_t_arm: Float[Tensor, "*#batch 3"],
    arm_p_head: Float[Tensor, "*#batch 3"],
    xy: Float[Tensor, "*#batch 2"],
) -> Float[Tensor, "... 2"]:
    """Measured minus projected image of a point of the instrument's head, normalised units (pinhole)."""
    q = _turned(camera_R_arm, arm_p_head) + camera_t_arm
    return xy - q[..., :2] / q[..., 2:]


def _turned(R: Float[Tensor, "*#batch 3 3"], v: Float[Tensor, "*#batch 3"]) -> Float[Tensor, "... 3"]:
    return (R @ v[..., None])[..., 0]


def _axis_frame(
    R: Float[Tensor, "*#batch 3 3"],
    t: Float[Tensor, "*#batch 3"],
    arm_p_rcm: Float[Tensor, "*#batch 3"],
    arm_v: Float[Tensor, "*#batch 3"],
) -> tuple[Tensor, Tensor, Tensor, Tensor, Tensor]:
    """m, u (unit vectors across the axis), distance of the axis from the optical centre, d and s0 = p.d."""
    p, d = _turned(R, arm_p_rcm) + t, _turned(R, arm_v)
    M = torch.linalg.cross(p, d)
    distance = torch.linalg.vector_norm(M, dim=-1)
    m = M / distance[..., None]
    return m, torch.linalg.cross(d, m), distance, d, (p * d).sum(-1)
