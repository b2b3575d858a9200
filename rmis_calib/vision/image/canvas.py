"""The small picture on which shafts are searched for: area-averaged, and laid out in ideal pixels.

Straight contours are straight on it whatever the lens does, so nothing after it knows about distortion until the
contours are measured at full resolution.
"""

import math
from dataclasses import dataclass

import torch
from jaxtyping import Bool, Float
from torch import Tensor
from torch.nn.functional import grid_sample, interpolate

from rmis_calib.vision.image.pixel_mapping import Lens

_STRAIGHT = 0.2
"""Displacement by the lens, small px at the picture's rim, that the search need not undo."""


@dataclass(frozen=True, eq=False)
class Canvas:
    """Where the small pixels lie. Small pixel (i, j) is the ideal full-resolution pixel `origin + factor * (i, j)`."""

    factor: int
    """Full-resolution pixels a small one."""
    origin: tuple[float, float]
    """Ideal pixel of the first small pixel."""
    size: tuple[int, int]
    """(height, width), small px."""
    grid: Float[Tensor, "1 h w 2"] | None
    """Place of each small pixel on the shrunken raw picture, in grid_sample's coordinates; None without distortion."""
    covered: Bool[Tensor, "h w"] | None
    """Small pixels whose raw place is in the picture; None: all."""

    @property
    def centre(self) -> tuple[float, float]:
        """AxisProfile of the canvas, ideal full-resolution px."""
        height, width = self.size
        return self.origin[0] + 0.5 * self.factor * (width - 1), self.origin[1] + 0.5 * self.factor * (height - 1)

    @property
    def half_diagonal_px(self) -> float:
        """From the middle to a corner, full-resolution px."""
        return 0.5 * self.factor * math.hypot(*self.size)

    def lay_out(self, small: Float[Tensor, "b c h w"]) -> Float[Tensor, "b c h2 w2"]:
        """The shrunken raw picture in ideal pixels."""
        if self.grid is None:
            return small
        grid = self.grid.expand(small.shape[0], -1, -1, -1)
        return grid_sample(small, grid, mode="bilinear", padding_mode="border", align_corners=True)


def plan_canvas(image_size: tuple[int, int], factor: int, lens: Lens, device: torch.device) -> Canvas:
    """Canvas that holds every pixel of the raw picture, at most half as large again."""
    small = (image_size[0] // factor, image_size[1] // factor)
    first = 0.5 * (factor - 1)
    if not lens.distorts:
        return Canvas(factor, (first, first), small, None, None)
    reach = [first + factor * (n - 1) for n in (small[1], small[0])]
    edge = torch.linspace(0, 1, 33, dtype=torch.float64, device=device)
    u, v = first + edge * (reach[0] - first), first + edge * (reach[1] - first)
    low, high = torch.full_like(edge, first), torch.ones_like(edge)
    rim = torch.cat(
        [torch.stack(pair, -1) for pair in ((u, low), (u, reach[1] * high), (low, v), (reach[0] * high, v))]
    )
    ideal = lens.to_ideal(rim)
    if bool(((ideal - rim).abs() < _STRAIGHT * factor).all()):
        return Canvas(factor, (first, first), small, None, None)
    ideal = ideal[torch.isfinite(ideal).all(-1)]
    middle = ideal.new_tensor([0.5 * (first + r) for r in reach])
    span = 0.75 * ideal.new_tensor([r - first for r in reach])
    low_corner = torch.maximum(ideal.amin(0), middle - span)
    size = ((torch.minimum(ideal.amax(0), middle + span) - low_corner) / factor).ceil().long() + 1
    width, height = int(size[0]), int(size[1])
    row, column = torch.meshgrid(
        torch.arange(height, dtype=torch.float64, device=device),
        torch.arange(width, dtype=torch.float64, device=device),
        indexing="ij",
    )
    points = low_corner + factor * torch.stack([column, row], -1)
    raw = lens.to_raw(points)
    place = (raw - first) / factor
    scale = place.new_tensor([2.0 / (small[1] - 1), 2.0 / (small[0] - 1)])
    grid = (place * scale - 1.0).to(torch.float32)
    covered = (grid.abs() <= 1.0).all(-1) & lens.is_regular(points)
    origin = (float(low_corner[0]), float(low_corner[1]))
    return Canvas(factor, origin, (height, width), grid[None], covered)


def shrink(images: Tensor, factor: int) -> Float[Tensor, "b c h w"]:
    """Smaller by a factor, to a whole byte, as single precision in [0, 1]; the remainder at right and below is cut.

    Each small pixel is a triangle-weighted mean over twice the side of its block, so that every row of an interlaced
    picture counts alike and nothing is skipped. On bytes in the CPU's memory torch has a fast path (a third of the time
    of a mean over blocks); rounding to whole bytes is below the noise of what they average.

    Args:
        images: (b, c, H, W), uint8 or floating point in [0, 1].
        factor: side of a block, px.
    """
    size = (images.shape[-2] // factor, images.shape[-1] // factor)
    cut = images[..., : size[0] * factor, : size[1] * factor]
    if cut.dtype != torch.uint8:
        cut = (cut * 255).round().clamp(0, 255).to(torch.uint8)
    if cut.device.type != "cpu":
        cut = cut.to(torch.float32)
    if factor > 1:
        cut = interpolate(cut, size=size, mode="bilinear", antialias=True)
    small = cut.to(torch.float32, memory_format=torch.contiguous_format)
    return (small if cut.dtype == torch.uint8 else small.round_()).mul_(1.0 / 255.0)
