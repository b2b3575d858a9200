"""Pictures of instruments by analytic ray casting: every edge is an exact error function of its distance in pixels.
torch, float32.

How an edge is defined: colours are mixed in encoded values, so the geometric edge is where the *encoded* picture is
half way
between its two sides. (Mixing linear light and encoding afterwards would move a dark-to-bright edge by a fraction of
the blur.)
"""

from __future__ import annotations

from dataclasses import dataclass

import torch
from torch import Tensor

FACING_LIMIT = 0.35
"""The end of a cylinder is an exact edge where its surface faces the ray by more than this: over 94 % of its width."""


@dataclass(frozen=True)
class Pixels:
    """Gathered pixels, M of them: ray (2, M) in normalised coordinates, its Jacobian (4, M) by the pixel, and their
    picture (M,).

    Components come first here and in everything that is computed of gathered pixels: each is one run of memory.
    """

    xy: Tensor
    jacobian: Tensor
    pose: Tensor

    def pick(self, index: Tensor) -> Pixels:
        """Some of them."""
        return Pixels(self.xy[:, index], self.jacobian[:, index], self.pose[index])

    def of_pose(self, values: Tensor) -> Tensor:
        """Values (K, ...) of poses at the pixels, (..., M)."""
        return values.movedim(0, -1).contiguous()[..., self.pose]


@dataclass(frozen=True)
class Cylinders:
    """Finite coaxial cylinders, one for every pose (K, ...), in camera coordinates; mm.

    Attributes:
        frame: (K, 3, 3) rows u (towards the nearest axis point), w = u x v, v (along the axis, towards the tip).
        distance: (K,) of the axis from the camera.
        s_foot: (K,) axis coordinate of the nearest point.
        light: (K, 3) the light, in `frame`.
        sweep: the same cylinders one sigma of the exposure earlier and later; None: they do not move.
    """

    frame: Tensor
    distance: Tensor
    s_foot: Tensor
    light: Tensor
    sweep: tuple[Cylinders, Cylinders] | None = None

    def contour_planes(self, radius: float) -> tuple[Tensor, Tensor]:
        """Unit normals (K, 3) of the planes of both contours, positive inside."""
        sine = (radius / self.distance)[:, None]
        cosine = torch.sqrt(1.0 - sine * sine)
        u, w = sine * self.frame[:, 0], cosine * self.frame[:, 1]
        return u + w, u - w


def make_cylinders(p_axis: Tensor, v_axis: Tensor, light: Tensor) -> Cylinders:
    """Cylinders about lines through p (K, 3) along unit v (K, 3), float64 in and float32 out; light (K, 3) in camera
    coordinates."""
    s_foot = -(p_axis * v_axis).sum(-1)
    foot = p_axis + s_foot[:, None] * v_axis
    distance = foot.norm(dim=-1)
    u = foot / distance[:, None]
    frame = torch.stack([u, torch.linalg.cross(u, v_axis), v_axis], dim=1)
    local = (frame @ light[..., None])[..., 0]
    return Cylinders(frame.float(), distance.float(), s_foot.float(), local.float())


def dot3(a: Tensor, b: Tensor) -> Tensor:
    """Scalar products (...) of vectors (..., 3). Written out: torch's reductions over three values take ten times as
    long."""
    return a[..., 0] * b[..., 0] + a[..., 1] * b[..., 1] + a[..., 2] * b[..., 2]


def unit3(a: Tensor) -> Tensor:
    """Vectors (..., 3) of unit length."""
    return a * torch.rsqrt(dot3(a, a).clamp_min(1e-20))[..., None]


def dot(a: Tensor, b: Tensor) -> Tensor:
    """Scalar products (M,) of vectors (3, M)."""
    return torch.addcmul(torch.addcmul(a[0] * b[0], a[1], b[1]), a[2], b[2])


def unit(a: Tensor) -> Tensor:
    """Vectors (3, M) of unit length."""
    return a * torch.rsqrt(dot(a, a).clamp_min(1e-20))


def edge(signed_px: Tensor, blur_px: float | Tensor) -> Tensor:
    """Coverage of a half-plane whose border is `signed_px` away (positive: inside), seen through the point spread."""
    return 0.5 + 0.5 * torch.erf(signed_px * (0.7071067811865476 / blur_px))


def smeared(blur_px: float, shift_px: Tensor) -> Tensor:
    """Point spread (M,) of an edge that moves by `shift_px` (1 sigma over the exposure) across itself."""
    return torch.sqrt(blur_px * blur_px + shift_px * shift_px)


def _slope_px(gradient_x: Tensor, gradient_y: Tensor, jacobian: Tensor) -> Tensor:
    """Length of the gradient by the pixel, from that by the ray."""
    gu = torch.addcmul(gradient_x * jacobian[0], gradient_y, jacobian[2])
    gv = torch.addcmul(gradient_x * jacobian[1], gradient_y, jacobian[3])
    return torch.hypot(gu, gv).clamp_min(1e-12)


@dataclass(frozen=True)
class Hit:
    """Where rays meet a cylinder (or come nearest to it); M pixels.

    Attributes:
        s: axis coordinate, mm.
        s_per_px: its change across the picture, mm per px.
        inside: coverage by the two contours.
        normal: (2, M) unit normal along u and w.
        point: (3, M) in the cylinder's frame.
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
    frame = pixels.of_pose(cylinders.frame)  # (3, 3, M)
    distance = cylinders.distance[pixels.pose]
    x, y = pixels.xy
    du, dw, dv = (torch.addcmul(torch.addcmul(row[2], row[0], x), row[1], y) for row in frame)
    across = du * du + dw * dw
    # |d_perp|^2 r^2 - (dw D)^2: the discriminant without the cancellation of the textbook form.
    root = torch.sqrt(torch.clamp(across * radius**2 - (dw * distance) ** 2, min=0.0))
    t = (du * distance - root) / across
    nu, nw = t * du - distance, t * dw
    length = torch.sqrt(nu * nu + nw * nw).clamp_min(1e-6)
    nu, nw = nu / length, nw / length
    s = cylinders.s_foot[pixels.pose] + t * dv
    # Towards the limb s runs ever faster across the picture and its slope no longer tells a distance: held from there
    # on.
    facing = torch.clamp(nu * du + nw * dw, max=-FACING_LIMIT)
    slide = -dv / facing  # implicit derivative of the hit along the surface
    gx, gy = (t * (slide * (nu * frame[0, i] + nw * frame[1, i]) + frame[2, i]) for i in range(2))
    inside = _between_contours(pixels, cylinders, radius, blur_px)
    in_front = (t > 0).float()
    depth = t
    point = torch.stack([t * du, t * dw, t * dv])
    inside = torch.clamp(inside, min=0.0) * in_front
    return Hit(s, _slope_px(gx, gy, pixels.jacobian), inside, torch.stack([nu, nw]), point, depth)


def _between_contours(pixels: Pixels, cylinders: Cylinders, radius: float, blur_px: float) -> Tensor:
    """Coverage (M,) by both contours: the sum of both edges, less one."""
    sides = []
    swept = [c.contour_planes(radius) for c in cylinders.sweep or ()]
    for side, plane in enumerate(cylinders.contour_planes(radius)):
        value, slope_px = _plane_at(pixels, plane)
        blur = blur_px
        if swept:
            shift, _ = _plane_at(pixels, 0.5 * (swept[1][side] - swept[0][side]))
            blur = smeared(blur_px, shift / slope_px)
        sides.append(edge(value / slope_px, blur))
    return sides[0] + sides[1] - 1.0


def _plane_at(pixels: Pixels, plane: Tensor) -> tuple[Tensor, Tensor]:
    """Values (M,) of planes (K, 3) on the rays, and how much they change by the pixel."""
    nx, ny, nz = pixels.of_pose(plane)
    value = torch.addcmul(torch.addcmul(nz, nx, pixels.xy[0]), ny, pixels.xy[1])
    return value, _slope_px(nx, ny, pixels.jacobian)


def hit_capsule(
    pixels: Pixels,
    a: Tensor,
    b: Tensor,
    radius: float,
    blur_px: float,
    focal_px: float,
    motion_px: Tensor | None = None,
) -> tuple[Tensor, Tensor, Tensor]:
    """Coverage (M,), unit normal (3, M) and point (3, M) of round-ended rods from a to b (K, 3), in camera coordinates.

    The outline of a sphere-swept segment is where the ray comes as near to the segment as the radius: exact.
    `motion_px` (K, 2) is how far the rods move in the picture over the exposure, 1 sigma.
    """
    a, e = pixels.of_pose(a), pixels.of_pose(b - a)
    d = unit(torch.cat([pixels.xy, torch.ones_like(pixels.xy[:1])]))
    de, da, ea, ee = dot(d, e), dot(d, a), dot(e, a), dot(e, e)
    h = torch.clamp((da * de - ea) / (ee - de * de).clamp_min(1e-6), 0.0, 1.0)
    nearest = torch.addcmul(a, h, e)
    along = dot(d, nearest)
    offset = along * d - nearest  # from the segment to the ray
    gap = torch.sqrt(dot(offset, offset))
    lift = torch.sqrt(torch.clamp(1.0 - (gap / radius) ** 2, min=0.0))
    normal = offset / gap.clamp_min(radius) - lift * d
    blur = blur_px
    if motion_px is not None:
        motion = pixels.of_pose(motion_px)
        blur = smeared(blur_px, normal[0] * motion[0] + normal[1] * motion[1])
    inside = edge((radius - gap) / along.clamp_min(1.0) * focal_px, blur)
    return inside, normal, nearest + radius * normal
