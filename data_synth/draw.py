"""Draw instruments and foreground tissue into a batch of pictures, and the shadows they throw. torch, float32."""

from __future__ import annotations

from dataclasses import dataclass, replace

import torch
from torch import Tensor

from data_synth.instruments import (
    Cylinders,
    Hit,
    Pixels,
    dot,
    dot3,
    edge,
    hit_capsule,
    hit_cylinder,
    make_cylinders,
    smeared,
    unit,
    unit3,
)
from data_synth.materials import Finish, Surface, light_cylinder

GATHER_PX = 4
"""Pixels of a row that are taken or left together."""
MARGIN_PX = 4.0
"""Pixels are drawn this many blurs (and at least pixels) outside the outline."""
JAW_LENGTH_MM = 9.0
JAW_RADIUS_MM = 1.3
JAW_OPENING_RAD = 0.30
"""Half the angle between the jaws."""
CLEVIS_RATIO = 0.74
"""Radius of the clevis over that of the shaft."""
COVERED_MM = 3.0
"""So far before its end the shaft certainly covers what is in it, blur and all."""
PENUMBRA_MM = 1.6
"""Half-width of a shadow's soft border."""


@dataclass(frozen=True)
class RayMap:
    """What every pixel of a camera sees: rays (2, H, W), their Jacobian (4, H, W), and the mean focal length, px.

    `read_at` (H,) says when a row is read, 0 to 1 from the first to the last row of the whole picture; `longest_step`
    is the largest distance between rays of neighbours in a row.
    """

    xy: Tensor
    jacobian: Tensor
    focal_px: float
    read_at: Tensor
    longest_step: float

    def field(self, parity: int) -> RayMap:
        """Every second row, from row `parity` on."""
        xy, jacobian = (part[:, parity::2].contiguous() for part in (self.xy, self.jacobian))
        return RayMap(xy, jacobian, self.focal_px, self.read_at[parity::2], self.longest_step)


@dataclass(frozen=True)
class InstrumentPoses:
    """An instrument in one camera: axis point at s = 0, direction, side of the jaws (B, R, 3); coordinates of ends (B,
    R); float64, mm.

    R is 1, or the number of groups of rows that are read at different times. `sweep` holds the same instrument one
    sigma of the exposure earlier and later; None: the exposure takes no time.
    """

    p_axis: Tensor
    v_axis: Tensor
    side: Tensor
    s_end: Tensor
    s_head: Tensor
    radius: float
    wrist_ratio: float
    sweep: tuple[InstrumentPoses, InstrumentPoses] | None = None

    def unbind(self) -> tuple[InstrumentPoses, ...]:
        """The same for every index of a further leading axis."""
        parts = zip(self.p_axis, self.v_axis, self.side, self.s_end, self.s_head, strict=True)
        return tuple(replace(self, p_axis=p, v_axis=v, side=d, s_end=e, s_head=h) for p, v, d, e, h in parts)

    def between(self, weights: Tensor) -> InstrumentPoses:
        """Mixtures (B, R) of these poses (B, K) by weights (R, K): a motion so short that it is straight."""
        return replace(
            self,
            p_axis=weights @ self.p_axis,
            v_axis=weights @ self.v_axis,
            side=weights @ self.side,
            s_end=self.s_end @ weights.T,
            s_head=self.s_head @ weights.T,
        )

    def cylinders(self, camera_p_light: Tensor) -> Cylinders:
        """The axes of all poses as cylinders."""
        p, v = self.p_axis.flatten(0, 1), self.v_axis.flatten(0, 1)
        cylinders = make_cylinders(p, v, camera_p_light.expand_as(p))
        if self.sweep is None:
            return cylinders
        early, late = (poses.cylinders(camera_p_light) for poses in self.sweep)
        return replace(cylinders, sweep=(early, late))

    def motion_px(self, focal_px: float) -> Tensor | None:
        """How far the head point moves in the picture over the exposure, 1 sigma, (B * R, 2)."""
        if self.sweep is None:
            return None
        early, late = (_image(pose.p_axis + pose.s_head[..., None] * pose.v_axis) for pose in self.sweep)
        return (0.5 * focal_px * (late - early)).flatten(0, 1).float()


@dataclass(frozen=True)
class Brush:
    """What all drawing shares: rays of the camera, the light in its frame (3,), the point spread and the encoding."""

    rays: RayMap
    camera_p_light: Tensor
    blur_px: float
    gamma: float


def gather_pixels(brush: Brush, planes: Tensor, motion_px: Tensor | None = None) -> tuple[Tensor, Pixels]:
    """Flat indices (M,) into (B, H, W), and the pixels, on the positive side of all planes (B, R, P, 3) or a margin
    outside.

    The planes' (x, y) parts are unit: values are distances in normalised coordinates. `motion_px` (K, 2) over the
    exposure widens the margin.
    """
    height, width = brush.rays.xy.shape[1:]
    batch, rows, count = planes.shape[:3]
    group = (brush.rays.read_at * rows).long().clamp(max=rows - 1)
    blur_px = brush.blur_px if motion_px is None else float(smeared(brush.blur_px, motion_px.norm(dim=-1)).max())
    margin = MARGIN_PX * max(1.0, blur_px) / brush.rays.focal_px
    # One pixel decides for its neighbours in the row; the margin holds for the furthest of them.
    blocks = -(-width // GATHER_PX)
    middle = (torch.arange(blocks, device=planes.device) * GATHER_PX + GATHER_PX // 2).clamp(max=width - 1)
    x, y = brush.rays.xy[..., middle]
    margin += (GATHER_PX // 2) * brush.rays.longest_step
    mask = torch.ones((batch, height, blocks), dtype=torch.bool, device=planes.device)
    for i in range(count):
        plane = planes[:, group, i, :, None].float()
        mask &= torch.addcmul(plane[:, :, 2] + plane[:, :, 0] * x, plane[:, :, 1], y) > -margin
    mask = mask.repeat_interleave(GATHER_PX, dim=2)[..., :width]
    image, row, column = mask.nonzero(as_tuple=True)
    inside = row * width + column
    flat = image * (height * width) + inside
    pose = image * rows + group[row]
    return flat, Pixels(brush.rays.xy.flatten(1)[:, inside], brush.rays.jacobian.flatten(1)[:, inside], pose)


def _outline(poses: InstrumentPoses) -> Tensor:
    """Three half-planes (B, R, 3, 3), unit in (x, y), positive inside, that hold the whole instrument."""
    reach = JAW_LENGTH_MM * torch.sin(torch.tensor(JAW_OPENING_RAD)) + JAW_RADIUS_MM
    p, v = poses.p_axis, poses.v_axis
    cylinders = make_cylinders(p.flatten(0, 1), v.flatten(0, 1), torch.zeros_like(p.flatten(0, 1)))
    wide = torch.clamp(torch.clamp(reach, min=poses.radius) / cylinders.distance, max=0.95)[:, None]
    u, w = cylinders.frame[:, 0], cylinders.frame[:, 1]
    cosine = torch.sqrt(1.0 - wide * wide)
    tip = (p + (poses.s_head + JAW_LENGTH_MM + JAW_RADIUS_MM)[..., None] * v).flatten(0, 1)
    before = (p + (poses.s_end - 15.0)[..., None] * v).flatten(0, 1)
    tip_xy, before_xy = tip[:, :2] / tip[:, 2:], before[:, :2] / before[:, 2:]
    back = torch.nn.functional.normalize(before_xy - tip_xy, dim=-1)
    cap = torch.cat([back, -(back * tip_xy).sum(-1, keepdim=True)], dim=-1).float()
    # Seen nearly along its axis an instrument has no direction in the picture: then the cap holds everything.
    clear = ((before_xy - tip_xy).norm(dim=-1, keepdim=True) > 0.05) & (before[:, 2:] > 5.0) & (tip[:, 2:] > 5.0)
    cap = torch.where(clear, cap, cap.new_tensor([0.0, 0.0, 1.0]))
    planes = torch.stack([cosine * w + wide * u, wide * u - cosine * w, cap], dim=1)
    planes = planes / planes[..., :2].norm(dim=-1, keepdim=True).clamp_min(1e-6)
    return planes.unflatten(0, p.shape[:2])


def draw_instrument(picture: Tensor, brush: Brush, poses: InstrumentPoses, finish: Finish) -> None:
    """Paint the instrument over `picture` (B, H, W, 3), encoded values 0 to 1, in place."""
    motion_px = poses.motion_px(brush.rays.focal_px)
    flat, pixels = gather_pixels(brush, _outline(poses), motion_px)
    if not len(flat):
        return
    values = picture.view(-1, 3)
    p, v = poses.p_axis.flatten(0, 1), poses.v_axis.flatten(0, 1)
    s_end, s_head = poses.s_end.flatten(), poses.s_head.flatten()
    cylinders = poses.cylinders(brush.camera_p_light)
    slide_px = None if motion_px is None else _slide_px(poses, motion_px)
    shaft = _Part(poses.radius, finish.shaft, torch.full_like(s_end, -1e4).float(), s_end.float())
    hit = hit_cylinder(pixels, cylinders, shaft.radius, brush.blur_px)
    # Wrist and jaws can only show where the shaft has ended or nearly so: a quarter of the pixels.
    tip = (hit.s > (shaft.s_to - COVERED_MM)[pixels.pose]).nonzero()[:, 0]
    near = pixels.pick(tip)
    colour = values[flat]
    head = p + s_head[:, None] * v
    beyond = _jaws(colour[tip], brush, near, head, v, poses.side.flatten(0, 1), motion_px)
    s_sleeve = s_end + 0.55 * (s_head - s_end)
    for ratio, surface, s_from, s_to in (
        (CLEVIS_RATIO, finish.clevis, s_sleeve - 1.0, s_head + 1.0),
        (poses.wrist_ratio, finish.sleeve, s_end - 1.0, s_sleeve),
    ):
        part = _Part(ratio * poses.radius, surface, s_from.float(), s_to.float())
        part_hit = hit_cylinder(near, cylinders, part.radius, brush.blur_px)
        beyond = _paint(beyond, brush, near, part_hit, cylinders.light, part, slide_px)
    colour[tip] = beyond
    colour = _paint(colour, brush, pixels, hit, cylinders.light, shaft, slide_px)
    for band in finish.bands:
        s_from, s_to = (s_end.float() + s for s in (band.s_from_mm, band.s_to_mm))
        part = _Part(band.ratio * poses.radius, band.surface, s_from, s_to)
        band_hit = hit_cylinder(pixels, cylinders, part.radius, brush.blur_px)
        colour = _paint(colour, brush, pixels, band_hit, cylinders.light, part, slide_px)
    values[flat] = colour


def _image(p: Tensor) -> Tensor:
    """Normalised coordinates (..., 2) of points (..., 3)."""
    return p[..., :2] / p[..., 2:].clamp_min(1.0)


def _slide_px(poses: InstrumentPoses, motion_px: Tensor) -> Tensor:
    """How far the head moves along the axis in the picture over the exposure, 1 sigma, (K,)."""
    tip = _image(poses.p_axis + poses.s_head[..., None] * poses.v_axis)
    before = _image(poses.p_axis + (poses.s_head - 10.0)[..., None] * poses.v_axis)
    along = torch.nn.functional.normalize(tip - before, dim=-1).flatten(0, 1)
    return (along * motion_px).sum(-1).float()


@dataclass(frozen=True)
class _Part:
    """A piece of an instrument between axis coordinates (K,), mm."""

    radius: float
    surface: Surface
    s_from: Tensor
    s_to: Tensor


def _paint(
    colour: Tensor, brush: Brush, pixels: Pixels, hit: Hit, light: Tensor, part: _Part, slide_px: Tensor | None
) -> Tensor:
    """Paint a part where rays hit it over colours (M, 3); light (K, 3) in the cylinders' frames; its ends move by
    `slide_px` (K,) over the exposure."""
    blur = brush.blur_px if slide_px is None else smeared(brush.blur_px, slide_px)[pixels.pose]
    before = edge((part.s_to[pixels.pose] - hit.s) / hit.s_per_px, blur)
    after = edge((hit.s - part.s_from[pixels.pose]) / hit.s_per_px, blur)
    cover = (hit.inside * before * after)[:, None]
    return torch.lerp(colour, light_cylinder(hit, pixels.of_pose(light), part.surface, brush.gamma), cover)


def _jaws(
    colour: Tensor,
    brush: Brush,
    pixels: Pixels,
    head: Tensor,
    v_axis: Tensor,
    side: Tensor,
    motion_px: Tensor | None,
) -> Tensor:
    """Paint the two jaws, rods that open about the head point, over colours (M, 3)."""
    for sign in (-1.0, 1.0):
        angle = torch.tensor(sign * JAW_OPENING_RAD)
        tip = head + JAW_LENGTH_MM * (torch.cos(angle) * v_axis + torch.sin(angle) * side)
        inside, normal, point = hit_capsule(
            pixels, head.float(), tip.float(), JAW_RADIUS_MM, brush.blur_px, brush.rays.focal_px, motion_px
        )
        facing = torch.clamp(dot(normal, unit(brush.camera_p_light.float()[:, None] - point)), min=0.0)
        linear = torch.clamp(0.04 + 0.30 * facing + 0.6 * facing**24, max=1.0)
        colour = torch.lerp(colour, (linear ** (1.0 / brush.gamma))[:, None].expand(-1, 3), inside[:, None])
    return colour


def shadow(points: Tensor, camera_p_light: Tensor, poses: InstrumentPoses) -> Tensor:
    """How much (B, h, w), 0 to 1, of the light to camera-frame points (B, h, w, 3) the instrument takes away.

    The ray from the light comes as near to the instrument's axis as `gap`; borders are soft over the penumbra.
    """
    p, v = poses.p_axis[:, :, None].float(), poses.v_axis[:, :, None].float()  # (B, R, 1, 3)
    light = camera_p_light.float()
    d = unit3(points - light)
    w = light - p
    dv, wv, wd = dot3(d, v), dot3(w, v), dot3(w, d)
    s = (wv - wd * dv) / (1.0 - dv * dv).clamp_min(1e-4)
    s = torch.minimum(s, (poses.s_head + 0.7 * JAW_LENGTH_MM).float()[:, :, None])
    nearest = p + s[..., None] * v - light
    along = dot3(nearest, d)
    gap = torch.sqrt((dot3(nearest, nearest) - along * along).clamp_min(0.0))
    return torch.sigmoid(2.0 * (poses.radius - gap) / PENUMBRA_MM) * (along > 0)
