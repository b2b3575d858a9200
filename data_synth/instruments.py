"""Pictures of instruments by analytic ray casting: every edge is an exact error function of its distance in pixels. torch, float32.

How an edge is defined: colours are mixed in encoded values, so the geometric edge is where the *encoded* picture is half way
between its two sides. (Mixing linear light and encoding afterwards would move a dark-to-bright edge by a fraction of the blur.)
"""

from __future__ import annotations

from dataclasses import dataclass

import torch
from torch import Tensor

MARGIN_PX = 4.0
"""Pixels are drawn this far outside the instrument's outline."""
FACING_LIMIT = 0.35
"""The end of a cylinder is an exact edge where its surface faces the ray by more than this: over 94 % of its width."""
REFERENCE_MM = 100.0
"""Distance of the light at which reflectances are nominal."""


@dataclass(frozen=True)
class Pixels:
    """Gathered pixels, M of them: ray (M, 2) in normalised coordinates, its Jacobian (M, 4) by the pixel, and their picture (M,)."""

    xy: Tensor
    jacobian: Tensor
    pose: Tensor


@dataclass(frozen=True)
class Cylinders:
    """Finite coaxial cylinders, one for every pose (K, ...), in camera coordinates; mm.

    Attributes:
        frame: (K, 3, 3) rows u (towards the nearest axis point), w = u x v, v (along the axis, towards the tip).
        distance: (K,) of the axis from the camera.
        s_foot: (K,) axis coordinate of the nearest point.
        light: (K, 3) the light, in `frame`.
    """

    frame: Tensor
    distance: Tensor
    s_foot: Tensor
    light: Tensor


def make_cylinders(p_axis: Tensor, v_axis: Tensor, light: Tensor) -> Cylinders:
    """Cylinders about lines through p (K, 3) along unit v (K, 3), float64 in and float32 out; light (K, 3) in camera coordinates."""
    s_foot = -(p_axis * v_axis).sum(-1)
    foot = p_axis + s_foot[:, None] * v_axis
    distance = foot.norm(dim=-1)
    u = foot / distance[:, None]
    frame = torch.stack([u, torch.linalg.cross(u, v_axis), v_axis], dim=1)
    local = (frame @ light[..., None])[..., 0]
    return Cylinders(frame.float(), distance.float(), s_foot.float(), local.float())


def edge(signed_px: Tensor, blur_px: float) -> Tensor:
    """Coverage of a half-plane whose border is `signed_px` away (positive: inside), seen through the point spread."""
    return 0.5 + 0.5 * torch.erf(signed_px * (0.7071067811865476 / blur_px))


def _slope_px(gradient_x: Tensor, gradient_y: Tensor, jacobian: Tensor) -> Tensor:
    """Length of the gradient by the pixel, from that by the ray."""
    gu = gradient_x * jacobian[:, 0] + gradient_y * jacobian[:, 2]
    gv = gradient_x * jacobian[:, 1] + gradient_y * jacobian[:, 3]
    return torch.sqrt(gu * gu + gv * gv).clamp_min(1e-12)


@dataclass(frozen=True)
class Hit:
    """Where rays meet a cylinder (or come nearest to it); M pixels.

    Attributes:
        s: axis coordinate, mm.
        s_per_px: its change across the picture, mm per px.
        inside: coverage by the two contours.
        normal: (M, 2) unit normal along u and w.
        point: (M, 3) in the cylinder's frame.
        depth: distance along the optical axis, mm.
    """

    s: Tensor
    s_per_px: Tensor
    inside: Tensor
    normal: Tensor
    point: Tensor
    depth: Tensor


def hit_cylinder(pixels: Pixels, cylinders: Cylinders, radius: float, blur_px: float) -> Hit:
    """Meet the rays of the pixels with the cylinders of their poses."""
    frame = cylinders.frame[pixels.pose]  # (M, 3, 3)
    distance = cylinders.distance[pixels.pose]
    x, y = pixels.xy[:, 0], pixels.xy[:, 1]
    du, dw, dv = (frame[:, i, 0] * x + frame[:, i, 1] * y + frame[:, i, 2] for i in range(3))
    across = du * du + dw * dw
    # |d_perp|^2 r^2 - (dw D)^2: the discriminant without the cancellation of the textbook form.
    root = torch.sqrt(torch.clamp(across * radius**2 - (dw * distance) ** 2, min=0.0))
    t = (du * distance - root) / across
    nu, nw = t * du - distance, t * dw
    length = torch.sqrt(nu * nu + nw * nw).clamp_min(1e-6)
    nu, nw = nu / length, nw / length
    s = cylinders.s_foot[pixels.pose] + t * dv
    # Towards the limb s runs ever faster across the picture and its slope no longer tells a distance: held from there on.
    facing = torch.clamp(nu * du + nw * dw, max=-FACING_LIMIT)
    slide = -dv / facing  # implicit derivative of the hit along the surface
    gx, gy = (t * (slide * (nu * frame[:, 0, i] + nw * frame[:, 1, i]) + frame[:, 2, i]) for i in range(2))
    sine = radius / distance
    cosine = torch.sqrt(1.0 - sine * sine)
    inside = -1.0
    for sign in (1.0, -1.0):
        nx, ny = (sign * cosine * frame[:, 1, i] + sine * frame[:, 0, i] for i in range(2))
        value = sign * cosine * dw + sine * du
        inside = inside + edge(value / _slope_px(nx, ny, pixels.jacobian), blur_px)
    in_front = (t > 0).float()
    depth = t
    point = torch.stack([t * du, t * dw, t * dv], dim=-1)
    inside = torch.clamp(inside, min=0.0) * in_front
    return Hit(s, _slope_px(gx, gy, pixels.jacobian), inside, torch.stack([nu, nw], dim=-1), point, depth)


@dataclass(frozen=True)
class Surface:
    """How a surface answers to light: linear reflectance, and a highlight of given strength and sharpness."""

    reflectance: tuple[float, float, float]
    highlight: float
    sharpness: float


DARK_GREY = Surface((0.022, 0.023, 0.026), 0.10, 14.0)
METAL = Surface((0.42, 0.42, 0.43), 0.75, 22.0)


def light_cylinder(hit: Hit, light: Tensor, surface: Surface, gamma: float) -> Tensor:
    """Encoded colour (M, 3) of the hit points under a point light (M, 3), both in the cylinder's frame."""
    to_light = light - hit.point
    distance = to_light.norm(dim=-1)
    to_camera = -hit.point / hit.point.norm(dim=-1, keepdim=True)
    to_light = to_light / distance[:, None]
    half = to_light + to_camera
    half = half / half.norm(dim=-1, keepdim=True)
    nu, nw = hit.normal[:, 0], hit.normal[:, 1]
    diffuse = torch.clamp(nu * to_light[:, 0] + nw * to_light[:, 1], min=0.0)
    mirror = torch.clamp(nu * half[:, 0] + nw * half[:, 1], min=0.0)
    gain = (REFERENCE_MM / distance) ** 2
    highlight = surface.highlight * mirror**surface.sharpness
    reflectance = torch.tensor(surface.reflectance, device=diffuse.device)
    # The square of the cosine fades in proportion to the distance from the limb; the cosine itself would fade like its root,
    # within a pixel, and so move the visible edge (measured: 0.03 px against 0.005 px).
    linear = ((0.45 + 0.55 * diffuse * diffuse)[:, None] * reflectance + highlight[:, None]) * gain[:, None]
    return torch.clamp(linear, 1e-4, 1.0) ** (1.0 / gamma)


def hit_capsule(
    pixels: Pixels, a: Tensor, b: Tensor, radius: float, blur_px: float, focal_px: float
) -> tuple[Tensor, Tensor, Tensor]:
    """Coverage (M,), unit normal (M, 3) and point (M, 3) of round-ended rods from a to b (K, 3), in camera coordinates.

    The outline of a sphere-swept segment is where the ray comes as near to the segment as the radius: exact.
    """
    a, b = a[pixels.pose], b[pixels.pose]
    d = torch.cat([pixels.xy, torch.ones_like(pixels.xy[:, :1])], dim=-1)
    d = d / d.norm(dim=-1, keepdim=True)
    e = b - a
    de, da, ea = (d * e).sum(-1), (d * a).sum(-1), (e * a).sum(-1)
    ee = (e * e).sum(-1)
    h = torch.clamp((da * de - ea) / (ee - de * de).clamp_min(1e-6), 0.0, 1.0)
    nearest = a + h[:, None] * e
    along = (d * nearest).sum(-1)
    offset = along[:, None] * d - nearest  # from the segment to the ray
    gap = offset.norm(dim=-1)
    inside = edge((radius - gap) / along.clamp_min(1.0) * focal_px, blur_px)
    lift = torch.sqrt(torch.clamp(1.0 - (gap / radius) ** 2, min=0.0))
    normal = offset / gap.clamp_min(radius)[:, None] - lift[:, None] * d
    return inside, normal, nearest + radius * normal
