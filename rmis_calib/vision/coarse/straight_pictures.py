"""Small straight pictures of strips, across by along: from where the axis enters the picture to where it leaves."""

import torch
from jaxtyping import Float
from torch import Tensor

from rmis_calib.vision.coarse.strips import Strips
from rmis_calib.vision.image.canvas import Canvas
from rmis_calib.vision.image.sampling import sample_frames

ACROSS, ALONG = 24, 128
MARGIN = 1.0
"""Reach from the middle line, widths: half a width beyond either contour."""
CHANNELS = 6
_FLOOR = 0.06
"""Below this brightness, fraction of full scale, sensor noise is all there is."""


def chord(strips: Strips, canvas: Canvas) -> Float[Tensor, "b k 2"]:
    """Stations at which the middle line enters and leaves the canvas, px."""
    height, width = canvas.size
    low = strips.origin.new_tensor(canvas.origin)
    high = low + canvas.factor * strips.origin.new_tensor([width - 1.0, height - 1.0])
    along = torch.where(strips.along.abs() < 1e-6, 1e-6, strips.along)
    a, b = (low - strips.origin) / along, (high - strips.origin) / along
    return torch.stack([torch.minimum(a, b).amax(-1), torch.maximum(a, b).amin(-1)], -1)


def straighten_pictures(
    rgb: Float[Tensor, "n 3 h w"],
    seen: Float[Tensor, "n h w"],
    canvas: Canvas,
    strips: Strips,
    picture: Tensor,
) -> tuple[Float[Tensor, "m 6 across along"], Float[Tensor, "b k 2"]]:
    """One straight picture a strip, rows from left to right of the axis, columns along it; and the chord's stations.

    Channels: log brightness of red, green, blue, less the picture's mean; whether the place is in the field of view;
    the distance from the axis in half widths; how many columns a width is long (log, scaled), which tells a short thick
    shaft from a long thin one.

    Args:
        rgb: the small picture.
        seen: 1 in the field of view, else 0.
        canvas: where the small picture lies.
        strips: b * k = m of them.
        picture: (b, k) int64, which picture each strip lies in.
    """
    ends = chord(strips, canvas)
    share = torch.linspace(0, 1, ALONG, device=rgb.device)
    t = ends[..., :1] + (ends[..., 1:] - ends[..., :1]) * share  # (b, k, along)
    left, right = strips.contour(t).unbind(2)
    middle, width = 0.5 * (left + right), (left - right).clamp(min=canvas.factor)
    across = torch.linspace(MARGIN, -MARGIN, ACROSS, device=rgb.device)
    y = middle[:, :, None] + width[:, :, None] * across[:, None]  # (b, k, across, along)
    place = (strips.points(t[:, :, None].expand_as(y), y) - rgb.new_tensor(canvas.origin)) / canvas.factor
    height, breadth = canvas.size
    u, v = place.unbind(-1)
    u, v = torch.nan_to_num(u), torch.nan_to_num(v)
    inside = (u > -0.5) & (v > -0.5) & (u < breadth - 0.5) & (v < height - 0.5)
    colour = sample_frames(rgb.movedim(0, 1), picture, u, v).reshape(3, -1, ACROSS, ALONG)
    field = sample_frames(seen[None], picture, u, v).reshape(-1, ACROSS, ALONG)
    known = (inside.reshape(field.shape) & (field > 0.75)).to(rgb.dtype)
    columns = width.mean(-1) * (ALONG - 1) / (ends[..., 1] - ends[..., 0]).clamp(min=1.0)
    return channels(colour.movedim(0, 1), known, columns.flatten()), ends


def channels(
    colour: Float[Tensor, "m 3 across along"], known: Float[Tensor, "m across along"], columns: Float[Tensor, " m"]
) -> Float[Tensor, "m 6 across along"]:
    """The channels of straight pictures of given colours, in [0, 1]; the strips' widths are so many columns long."""
    bright = (colour + _FLOOR).log()
    seen = known[:, None]
    mean = (bright * seen).flatten(1).sum(1) / (3 * known.sum((1, 2))).clamp(min=1.0)
    bright = (bright - mean[:, None, None, None]) * seen
    across = 2 * torch.linspace(MARGIN, -MARGIN, ACROSS, device=colour.device).abs()[None, None, :, None]
    aspect = (0.5 * columns.clamp(0.5, 200.0).log2() - 1.5)[:, None, None, None]
    shape = (len(colour), 1, ACROSS, ALONG)
    return torch.cat([bright, seen, across.expand(shape), aspect.expand(shape)], 1)
