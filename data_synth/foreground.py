"""Draw tissue that hangs in front of the instruments. torch, float32."""

from __future__ import annotations

from dataclasses import dataclass

import torch
import torch.nn.functional as nnf
from torch import Tensor

from data_synth.draw import Brush, gather_pixels
from data_synth.instruments import dot, hit_capsule, unit, unit3
from data_synth.tissue import GLOSS_SHARPNESS, HALF_EXTENT_MM, Tissue, sample_texture

REFERENCE_MM = 95.0
"""Distance of the light at which the foreground has its nominal brightness."""
SAMPLE_COLUMNS = 1024
"""Scattered samples are laid out in rows of this many: OpenCV limits the width of a picture."""


@dataclass(frozen=True)
class LoopPoses:
    """A tube between two points (B, R, 3) in the camera; float32, mm.

    `sweep` holds it one sigma of the exposure earlier and later; None: the exposure takes no time.
    """

    a: Tensor
    b: Tensor
    radius: float
    sweep: tuple[LoopPoses, LoopPoses] | None = None

    def unbind(self) -> tuple[LoopPoses, ...]:
        """The same for every index of a further leading axis."""
        return tuple(LoopPoses(a, b, self.radius) for a, b in zip(self.a, self.b, strict=True))

    def between(self, weights: Tensor) -> LoopPoses:
        """Mixtures (B, R) of these poses (B, K) by weights (R, K): a motion so short that it is straight."""
        return LoopPoses(weights.float() @ self.a, weights.float() @ self.b, self.radius)

    def motion_px(self, focal_px: float) -> Tensor | None:
        """How far its middle moves in the picture over the exposure, 1 sigma, (B * R, 2)."""
        if self.sweep is None:
            return None
        early, late = (0.5 * (loop.a + loop.b) for loop in self.sweep)
        shift = late[..., :2] / late[..., 2:].clamp_min(1.0) - early[..., :2] / early[..., 2:].clamp_min(1.0)
        return (0.5 * focal_px * shift).flatten(0, 1)


def draw_loop(picture: Tensor, brush: Brush, loop: LoopPoses, tissue: Tissue) -> None:
    """Paint the tube over `picture` (B, H, W, 3), encoded values 0 to 1, in place, with the colours of the tissue."""
    motion_px = loop.motion_px(brush.rays.focal_px)
    flat, pixels = gather_pixels(brush, _outline(loop), motion_px)
    if not len(flat):
        return
    a, b = loop.a.flatten(0, 1).float(), loop.b.flatten(0, 1).float()
    inside, normal, point = hit_capsule(pixels, a, b, loop.radius, brush.blur_px, brush.rays.focal_px, motion_px)
    along = dot(point - pixels.of_pose(a), pixels.of_pose(unit3(b - a)))
    across = loop.radius * torch.asin(torch.clamp(normal[1], -1.0, 1.0))
    grid = torch.stack([along + 20.0, 1.3 * across - 35.0], dim=-1) / HALF_EXTENT_MM
    base = _sample_scattered(tissue.colour, grid)
    # The wet skin is not smooth: the slopes of the tissue's texture tilt the normal and break the highlight up.
    slope_x, slope_y, gloss = _sample_scattered(tissue.shape, grid).unbind(-1)
    normal = unit(torch.stack([normal[0] + 0.6 * slope_x, normal[1] + 0.6 * slope_y, normal[2]]))
    to_light = brush.camera_p_light.float()[:, None] - point
    distance = torch.sqrt(dot(to_light, to_light))
    to_light = to_light / distance
    facing = torch.clamp(dot(normal, to_light), min=0.0)
    mirror = dot(normal, unit(to_light - unit(point)))
    gain = torch.clamp((REFERENCE_MM / distance) ** (2.0 / brush.gamma), max=1.3)
    highlight = 0.7 * gloss * torch.exp(GLOSS_SHARPNESS * (mirror - 1.0))
    colour = gain[:, None] * (base * torch.sqrt(0.1 + 0.9 * facing)[:, None] + highlight[:, None])
    values = picture.view(-1, 3)
    values[flat] = torch.lerp(values[flat], torch.clamp(colour, max=1.0), inside[:, None])


def _outline(loop: LoopPoses) -> Tensor:
    """Four half-planes (B, R, 4, 3): the box about the two end spheres' pictures."""
    centres = torch.stack([loop.a, loop.b], dim=-2)
    depth = centres[..., 2:].clamp_min(1.1 * loop.radius)
    # A sphere of radius r at distance D spans at most r / sqrt(D^2 - r^2), stretched by its obliqueness.
    xy = centres[..., :2] / depth
    reach = loop.radius / torch.sqrt(depth**2 - loop.radius**2) * (1.0 + (xy**2).sum(-1, keepdim=True))
    low, high = (xy - reach).amin(-2), (xy + reach).amax(-2)
    one, zero = torch.ones_like(low[..., 0]), torch.zeros_like(low[..., 0])
    rows = [
        [one, zero, -low[..., 0]],
        [-one, zero, high[..., 0]],
        [zero, one, -low[..., 1]],
        [zero, -one, high[..., 1]],
    ]
    return torch.stack([torch.stack(row, dim=-1) for row in rows], dim=-2)


def _sample_scattered(texture: Tensor, grid: Tensor) -> Tensor:
    """Bilinear samples (M, 3) at scattered positions (M, 2)."""
    count = len(grid)
    padded = nnf.pad(grid, (0, 0, 0, -count % SAMPLE_COLUMNS))
    return sample_texture(texture, padded.view(1, -1, SAMPLE_COLUMNS, 2)).reshape(-1, 3)[:count]
