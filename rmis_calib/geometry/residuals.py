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

from rmis_calib.geometry.lines import axis_plane, contour_planes, point_line_distance

_SMALLEST = 1e-12


def axis_rotation(
    camera_R_arm: Float[Tensor, "*#batch 3 3"], arm_v: Float[Tensor, "*#batch 3"], n: Float[Tensor, "*#batch 3"]
) -> Float[Tensor, "..."]:
    """n.(R v): sine of the angle between the shaft's direction and its plane (paper, Eqs. 6, 9 and 14).

    Args:
        n: unit normal of the plane, in the camera (`plane_normal_from_points`). For the left camera turn it into
            `camera_right` first (Eq. 8), or give `camera_left_R_arm`.
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
    """Signed distance of an image point from the predicted contour of the shaft, normalised units.

    The contour is the line in which `contour_planes` meets the picture.

    Args:
        side: +1 for the contour left of the axis, directed RCM to tip in the picture (edge 0), -1 for the other, 0 for
            the axis itself.
    """
    p, d = _turned(camera_R_arm, arm_p_rcm) + camera_t_arm, _turned(camera_R_arm, arm_v)
    n = axis_plane(p, d) if side == 0 else contour_planes(p, d, radius_mm)[..., 0 if side > 0 else 1, :]
    across = torch.linalg.vector_norm(n[..., :2], dim=-1, keepdim=True).clamp_min(_SMALLEST)
    return point_line_distance(xy, n / across)


def end(
    camera_R_arm: Float[Tensor, "*#batch 3 3"],
    camera_t_arm: Float[Tensor, "*#batch 3"],
    arm_p_rcm: Float[Tensor, "*#batch 3"],
    arm_v: Float[Tensor, "*#batch 3"],
    s_end_mm: Float[Tensor, "*#batch"] | float,
    xy: Float[Tensor, "*#batch 2"],
) -> Float[Tensor, "..."]:
    """Distance along the imaged axis of a measured shaft end from the predicted one, normalised units.

    chi = X_d / X_u is the tangent of the angle, in the plane of the axis, between the point of the axis nearest to the
    camera and the measured ray; (s0 + s_end) / |M| is its prediction. Their difference is divided by its change for a
    step along the imaged axis.

    Args:
        s_end_mm: coordinate of the end along the axis, from the RCM.
    """
    p, d = _turned(camera_R_arm, arm_p_rcm) + camera_t_arm, _turned(camera_R_arm, arm_v)
    moment = torch.linalg.cross(p, d)
    distance = torch.linalg.vector_norm(moment, dim=-1)
    m = moment / distance[..., None]
    u = torch.linalg.cross(d, m)
    rays = torch.cat((xy, torch.ones_like(xy[..., :1])), dim=-1)
    X_u, X_d = (u * rays).sum(-1), (d * rays).sum(-1)
    chi = X_d / X_u
    step = d[..., :2] - chi[..., None] * u[..., :2]
    across = step[..., 1] * m[..., 0] - step[..., 0] * m[..., 1]
    m_xy = torch.linalg.vector_norm(m[..., :2], dim=-1).clamp_min(_SMALLEST)
    slope = (across / m_xy).abs().clamp_min(_SMALLEST) / X_u.abs()
    return (chi - ((p * d).sum(-1) + s_end_mm) / distance) / slope


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
