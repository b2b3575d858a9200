"""Image lines, the planes they span with the optical centre, and the contours of a cylinder.

All points are in normalised undistorted coordinates (x/z, y/z). There a line (l0, l1, l2) and the plane through the
optical centre with that normal are the same three numbers up to scale: l0 x + l1 y + l2 = 0.
"""

from dataclasses import dataclass

import torch
from jaxtyping import Bool, Float
from torch import Tensor

# Largest sine of a cylinder's half angle that is evaluated: at 1 the camera touches the surface and the derivative of
# the half angle is infinite. This one is 0.08 degrees away from that.
_MAX_SINE = 1 - 1e-6


@dataclass(frozen=True, eq=False)
class AxisPlane:
    """What the two contours of a cylinder say about its axis, in the camera frame."""

    camera_n_axis: Float[Tensor, "*batch 3"]
    """Unit normal of the plane through the optical centre and the axis."""
    camera_u: Float[Tensor, "*batch 3"]
    """Unit direction from the optical centre to the nearest point of the axis."""
    half_angle_rad: Float[Tensor, "*batch"]
    """Half the angle between the contour planes."""
    distance_mm: Float[Tensor, "*batch"]
    """From the optical centre to the axis; infinite where the contours coincide."""


def line_through_points(
    xy_a: Float[Tensor, "*#batch 2"], xy_b: Float[Tensor, "*#batch 2"]
) -> Float[Tensor, "*#batch 3"]:
    """Line through two points, scaled so that l0^2 + l1^2 = 1; (0, 0, 0) where the points coincide.

    Convention: with x right and y down, the line is positive right of the directed line from a to b.
    """
    line = _join(xy_a, xy_b)
    return line / _safe_norm(line[..., :2])


def plane_normal_from_points(
    xy_a: Float[Tensor, "*#batch 2"], xy_b: Float[Tensor, "*#batch 2"]
) -> Float[Tensor, "*#batch 3"]:
    """Unit normal of the plane through the optical centre and two image points; (0, 0, 0) where the points coincide.

    Convention: (xa, ya, 1) x (xb, yb, 1); positive right of the directed line from a to b.
    """
    normal = _join(xy_a, xy_b)
    return normal / _safe_norm(normal)


def point_line_distance(xy: Float[Tensor, "*#batch 2"], line: Float[Tensor, "*#batch 3"]) -> Float[Tensor, "*#batch"]:
    """Signed distance of points from lines scaled as by `line_through_points`, normalised units."""
    return (xy * line[..., :2]).sum(-1) + line[..., 2]


def axis_plane(
    camera_p_axis: Float[Tensor, "*#batch 3"], camera_v_axis: Float[Tensor, "*#batch 3"]
) -> Float[Tensor, "*#batch 3"]:
    """Unit normal m = p x v / |p x v| of the plane through the optical centre and an axis.

    It is the normal that `plane_normal_from_points` gives for two image points of the axis in the order of v, and
    (0, 0, 0) where the axis passes through the optical centre.

    Args:
        camera_p_axis: any point of the axis, mm.
        camera_v_axis: unit direction of the axis.
    """
    moment = torch.linalg.cross(*torch.broadcast_tensors(camera_p_axis, camera_v_axis))
    return moment / _safe_norm(moment)


def is_outside_cylinder(
    camera_p_axis: Float[Tensor, "*#batch 3"],
    camera_v_axis: Float[Tensor, "*#batch 3"],
    radius_mm: Float[Tensor, "*#batch"] | float,
) -> Bool[Tensor, "*#batch"]:
    """Whether the optical centre is outside the cylinder, so that it has contours."""
    moment = torch.linalg.cross(*torch.broadcast_tensors(camera_p_axis, camera_v_axis))
    return moment.norm(dim=-1) > radius_mm


def contour_planes(
    camera_p_axis: Float[Tensor, "*#batch 3"],
    camera_v_axis: Float[Tensor, "*#batch 3"],
    radius_mm: Float[Tensor, "*#batch"] | float,
) -> Float[Tensor, "*#batch 2 3"]:
    """Unit normals of the two planes through the optical centre that touch a cylinder.

    With M = p x v, D = |M|, m = M / D, u = v x m and sin(alpha) = r / D: cos(alpha) m + sin(alpha) u for edge 0 and
    cos(alpha) m - sin(alpha) u for edge 1.

    Convention: edge 0 is left of the axis as it is directed in the picture, along v (RCM to tip): the upper edge
    where v points right. Both normals have the sign of `plane_normal_from_points` for points in the order of v.
    Where the optical centre is inside the cylinder or touches it (`is_outside_cylinder` is false) there is no
    contour; the result is then that of alpha just below a right angle: finite, with no derivative with respect to r /
    D.

    Args:
        camera_p_axis: any point of the axis, mm.
        camera_v_axis: unit direction of the axis.
        radius_mm: radius of the cylinder.
    Source: derived in rmis_calib/solver/model/residuals.py.
    """
    p, v = torch.broadcast_tensors(camera_p_axis, camera_v_axis)
    moment = torch.linalg.cross(p, v)
    distance = _safe_norm(moment)
    m = moment / distance
    u = torch.linalg.cross(v.expand_as(m), m)
    radius = torch.as_tensor(radius_mm, dtype=m.dtype, device=m.device)[..., None]
    sine = (radius / distance).clamp(max=_MAX_SINE)
    cosine = (1 - sine * sine).sqrt()
    return torch.stack([cosine * m + sine * u, cosine * m - sine * u], dim=-2)


def axis_from_contours(
    contour_n: Float[Tensor, "*#batch 2 3"], radius_mm: Float[Tensor, "*#batch"] | float
) -> AxisPlane:
    """Axis plane, direction and distance of a cylinder from its two contour planes; inverse of `contour_planes`.

    Convention: the order and the signs of `contour_planes`. With the edges exchanged `camera_u` points away from the
    axis; with both normals negated `camera_n_axis` and `camera_u` are negated.

    Args:
        contour_n: unit normals of edge 0 and edge 1.
        radius_mm: radius of the cylinder.
    """
    total, difference = contour_n[..., 0, :] + contour_n[..., 1, :], contour_n[..., 0, :] - contour_n[..., 1, :]
    twice_cosine, twice_sine = _safe_norm(total), _safe_norm(difference)
    apart = (difference != 0).any(-1)
    half_angle = torch.where(apart, torch.atan2(twice_sine, twice_cosine)[..., 0], 0.0)
    distance = torch.where(apart, 2 * radius_mm / twice_sine[..., 0], torch.inf)
    return AxisPlane(total / twice_cosine, difference / twice_sine, half_angle, distance)


def _join(xy_a: Float[Tensor, "*#batch 2"], xy_b: Float[Tensor, "*#batch 2"]) -> Float[Tensor, "*#batch 3"]:
    # (xa, ya, 1) x (xb, yb, 1) with the difference of the points taken first: no cancellation where they are close.
    xa, ya = torch.broadcast_tensors(xy_a, xy_b)[0].unbind(-1)
    dx, dy = (xy_b - xy_a).unbind(-1)
    return torch.stack([-dy, dx, xa * dy - ya * dx], dim=-1)


def _safe_norm(v: Float[Tensor, "*batch n"]) -> Float[Tensor, "*batch 1"]:
    """Length, and 1 for the zero vector, so that dividing by it gives zero with a finite gradient."""
    squared = (v * v).sum(-1, keepdim=True)
    return torch.where(squared == 0, 1.0, squared).sqrt()
