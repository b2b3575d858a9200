"""Draw one articulated instrument into a batch of pictures: shaft, metal wrist, two jaws. torch, float32."""

from __future__ import annotations

from dataclasses import dataclass

import torch
from torch import Tensor

from data_synth.instruments import (
    DARK_GREY,
    MARGIN_PX,
    METAL,
    Cylinders,
    Pixels,
    Surface,
    edge,
    hit_capsule,
    hit_cylinder,
    light_cylinder,
    make_cylinders,
)

JAW_LENGTH_MM = 9.0
JAW_RADIUS_MM = 1.3
JAW_OPENING_RAD = 0.30
"""Half the angle between the jaws."""


@dataclass(frozen=True)
class RayMap:
    """What every pixel of a camera sees: rays (H, W, 2), their Jacobian (H * W, 4), and the mean focal length, px."""

    xy: Tensor
    jacobian: Tensor
    focal_px: float


@dataclass(frozen=True)
class InstrumentPoses:
    """An instrument in one camera for K poses, float64, mm: axis point at s = 0 and direction, side of the jaws (K, 3); ends (K,)."""

    p_axis: Tensor
    v_axis: Tensor
    side: Tensor
    s_end: Tensor
    s_head: Tensor
    radius: float


def _outline(poses: InstrumentPoses) -> Tensor:
    """Three half-planes (K, 3, 3) in normalised coordinates, unit in (x, y), positive inside, that hold the whole instrument."""
    reach = JAW_LENGTH_MM * torch.sin(torch.tensor(JAW_OPENING_RAD)) + JAW_RADIUS_MM
    cylinders = make_cylinders(poses.p_axis, poses.v_axis, torch.zeros_like(poses.p_axis))
    wide = torch.clamp(torch.clamp(reach, min=poses.radius) / cylinders.distance, max=0.95)[:, None]
    u, w = cylinders.frame[:, 0], cylinders.frame[:, 1]
    cosine = torch.sqrt(1.0 - wide * wide)
    tip = poses.p_axis + (poses.s_head + JAW_LENGTH_MM + JAW_RADIUS_MM)[:, None] * poses.v_axis
    before = poses.p_axis + (poses.s_end - 15.0)[:, None] * poses.v_axis
    tip_xy, before_xy = tip[:, :2] / tip[:, 2:], before[:, :2] / before[:, 2:]
    back = torch.nn.functional.normalize(before_xy - tip_xy, dim=-1)
    cap = torch.cat([back, -(back * tip_xy).sum(-1, keepdim=True)], dim=-1).float()
    # Seen nearly along its axis an instrument has no direction in the picture: then the cap holds everything.
    clear = ((before_xy - tip_xy).norm(dim=-1, keepdim=True) > 0.05) & (before[:, 2:] > 5.0) & (tip[:, 2:] > 5.0)
    cap = torch.where(clear, cap, cap.new_tensor([0.0, 0.0, 1.0]))
    planes = torch.stack([cosine * w + wide * u, wide * u - cosine * w, cap], dim=1)
    return planes / planes[..., :2].norm(dim=-1, keepdim=True).clamp_min(1e-6)


def _gather(rays: RayMap, poses: InstrumentPoses, batch: int) -> tuple[Tensor, Pixels]:
    """Flat indices (M,) into (B, H, W), and the pixels, that the instrument can touch."""
    height, width = rays.xy.shape[:2]
    rows = len(poses.s_end) // batch  # 1, or a pose for every group of rows
    group = torch.arange(height, device=rays.xy.device) * rows // height
    planes = _outline(poses).unflatten(0, (batch, rows))[:, group]  # (B, H, 3, 3)
    margin = MARGIN_PX / rays.focal_px
    mask = torch.ones((batch, height, width), dtype=torch.bool, device=rays.xy.device)
    for i in range(3):
        plane = planes[:, :, i, :, None]
        mask &= (
            torch.addcmul(plane[:, :, 2] + plane[:, :, 0] * rays.xy[..., 0], plane[:, :, 1], rays.xy[..., 1]) > -margin
        )
    flat = mask.flatten().nonzero()[:, 0]
    inside = flat % (height * width)
    pose = (
        torch.div(flat, height * width, rounding_mode="floor") * rows
        + group[torch.div(inside, width, rounding_mode="floor")]
    )
    return flat, Pixels(rays.xy.flatten(0, 1)[inside], rays.jacobian[inside], pose)


def draw_instrument(
    picture: Tensor,
    rays: RayMap,
    poses: InstrumentPoses,
    camera_p_light: Tensor,
    wrist_ratio: float,
    blur_px: float,
    gamma: float,
) -> None:
    """Paint the instrument over `picture` (B, H, W, 3), encoded values 0 to 1, in place."""
    batch = len(picture)
    flat, pixels = _gather(rays, poses, batch)
    if not len(flat):
        return
    values = picture.view(-1, 3)
    colour = values[flat]
    colour = _jaws(colour, pixels, rays, poses, camera_p_light, blur_px, gamma)
    cylinders = make_cylinders(poses.p_axis, poses.v_axis, camera_p_light.to(poses.p_axis).expand_as(poses.p_axis))
    s_end, s_head = poses.s_end.float(), poses.s_head.float()
    wrist_from, everywhere = s_end - 1.0, torch.full_like(s_end, -1e4)
    for ratio, surface, s_from, s_to in (
        (wrist_ratio, METAL, wrist_from, s_head),
        (1.0, DARK_GREY, everywhere, s_end),
    ):
        colour = _cylinder(colour, pixels, cylinders, ratio * poses.radius, surface, s_from, s_to, blur_px, gamma)
    values[flat] = colour


def _cylinder(
    colour: Tensor,
    pixels: Pixels,
    cylinders: Cylinders,
    radius: float,
    surface: Surface,
    s_from: Tensor,
    s_to: Tensor,
    blur_px: float,
    gamma: float,
) -> Tensor:
    """Paint a cylinder between axis coordinates (K,) over colours (M, 3)."""
    hit = hit_cylinder(pixels, cylinders, radius, blur_px)
    before = edge((s_to[pixels.pose] - hit.s) / hit.s_per_px, blur_px)
    after = edge((hit.s - s_from[pixels.pose]) / hit.s_per_px, blur_px)
    cover = (hit.inside * before * after)[:, None]
    painted = light_cylinder(hit, cylinders.light[pixels.pose], surface, gamma)
    return torch.lerp(colour, painted, cover)


def _jaws(
    colour: Tensor,
    pixels: Pixels,
    rays: RayMap,
    poses: InstrumentPoses,
    camera_p_light: Tensor,
    blur_px: float,
    gamma: float,
) -> Tensor:
    """Paint the two jaws, rods that open about the head point, over colours (M, 3)."""
    head = poses.p_axis + poses.s_head[:, None] * poses.v_axis
    for sign in (-1.0, 1.0):
        angle = torch.tensor(sign * JAW_OPENING_RAD)
        tip = head + JAW_LENGTH_MM * (torch.cos(angle) * poses.v_axis + torch.sin(angle) * poses.side)
        inside, normal, point = hit_capsule(pixels, head.float(), tip.float(), JAW_RADIUS_MM, blur_px, rays.focal_px)
        to_light = torch.nn.functional.normalize(camera_p_light.float() - point, dim=-1)
        facing = torch.clamp((normal * to_light).sum(-1), min=0.0)
        linear = 0.05 + 0.35 * facing + 0.6 * facing**24
        colour = torch.lerp(
            colour, (torch.clamp(linear, max=1.0) ** (1.0 / gamma))[:, None].expand(-1, 3), inside[:, None]
        )
    return colour
