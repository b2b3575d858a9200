"""Exact picture of a cylinder: contour planes, contact lines, axis, and where the shaft ends. float64 NumPy, any
leading batch.

Derivation: the tangent planes through the optical centre contain the axis direction v, so their unit normals are
n = a u + b (u x v) with u the unit vector to the axis point nearest to the centre, at distance D; tangency
n . (D u) = +-r gives a = +-r / D. Edge 0 is left of the axis, directed in the picture from the RCM to the tip,
edge 1 right of it (x right, y down).
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from data_synth.kinematics import Array


@dataclass(frozen=True)
class CylinderView:
    """A cylinder seen from the origin of its coordinates.

    Attributes:
        n_contour: (..., 2, 3) unit normals of the contour planes, edge 0 first.
        n_axis: (..., 3) unit normal of the plane of the axis, u x v.
        u_axis: (..., 3) unit vector to the nearest point of the axis.
        distance_mm: (...,) distance of the axis.
    """

    n_contour: Array
    n_axis: Array
    u_axis: Array
    distance_mm: Array


def view_cylinder(p_axis: Array, v_axis: Array, radius_mm: float) -> CylinderView:
    """View of the cylinder about the line through `p_axis` along unit `v_axis` (..., 3), mm."""
    foot = p_axis - np.einsum("...i,...i->...", p_axis, v_axis)[..., None] * v_axis
    distance = np.linalg.norm(foot, axis=-1)
    u = foot / distance[..., None]
    w = np.cross(u, v_axis)
    sine = (radius_mm / distance)[..., None]
    cosine = np.sqrt(1.0 - sine**2)
    n_contour = np.stack([cosine * w + sine * u, cosine * w - sine * u], axis=-2)
    return CylinderView(n_contour, w, u, distance)


def contact_points(axis_points: Array, view: CylinderView, radius_mm: float) -> Array:
    """Points (..., 2, 3) of the cylinder's surface on each contour, beside the axis points (..., 3)."""
    signs = np.array([-1.0, 1.0])[:, None]
    return axis_points[..., None, :] + signs * radius_mm * view.n_contour


def front_point(axis_points: Array, view: CylinderView, radius_mm: float) -> Array:
    """Points (..., 3) of the surface that face the camera, on the axis' line in the picture."""
    return axis_points - radius_mm * view.u_axis


def to_image(p: Array) -> Array:
    """Normalised image coordinates (..., 2) of points (..., 3); NaN behind the camera."""
    z = np.where(p[..., 2:] > 1e-6, p[..., 2:], np.nan)
    return p[..., :2] / z


def line_through(points: Array) -> Array:
    """Where the first and the last of image points (..., k, 2) are along the straight line nearest to all of them, the
    way a detector of lines measures a bent contour; (..., 2, 2)."""
    centre = points.mean(-2, keepdims=True)
    x, y = np.moveaxis(points - centre, -1, 0)
    angle = 0.5 * np.arctan2(2.0 * (x * y).sum(-1), (x * x - y * y).sum(-1))
    along = np.stack([np.cos(angle), np.sin(angle)], axis=-1)[..., None, :]
    at = ((points - centre)[..., [0, -1], :] * along).sum(-1, keepdims=True)
    return centre + at * along


def visible_interval(
    p_axis: Array,
    v_axis: Array,
    s_low: Array | float,
    s_high: Array | float,
    bounds: tuple[float, float, float, float],
    near_mm: float = 5.0,
) -> tuple[Array, Array]:
    """Part of the axis that is in the picture: coordinates s (...,), (...,); empty where the first is not below the
    second.

    Args:
        p_axis: (..., 3) axis point at s = 0, camera frame, mm.
        v_axis: (..., 3) unit direction.
        s_low: lowest coordinate to consider, mm.
        s_high: highest coordinate to consider, mm.
        bounds: x_min, y_min, x_max, y_max of the picture in normalised coordinates.
        near_mm: nothing nearer than this depth is seen.
    """
    x_min, y_min, x_max, y_max = bounds
    # Half-spaces q . (p + s v) >= c, one a row: left, right, top, bottom, near.
    q = np.array([[1, 0, -x_min], [-1, 0, x_max], [0, 1, -y_min], [0, -1, y_max], [0, 0, 1]], dtype=np.float64)
    at_zero = np.einsum("ki,...i->...k", q, p_axis) - np.array([0, 0, 0, 0, near_mm])
    slope = np.einsum("ki,...i->...k", q, v_axis)
    with np.errstate(divide="ignore", invalid="ignore"):
        crossing = -at_zero / slope
    low = np.where(slope > 0, crossing, -np.inf).max(-1)
    high = np.where(slope < 0, crossing, np.inf).min(-1)
    outside = ((slope == 0) & (at_zero < 0)).any(-1)
    low = np.maximum(low, s_low)
    return np.where(outside, np.inf, low), np.minimum(high, s_high)
