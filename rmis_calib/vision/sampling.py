"""Bilinear reading of pictures at many points, for a batch at once."""

from dataclasses import dataclass

import torch
from jaxtyping import Bool, Float
from torch import Tensor
from torch.nn.functional import grid_sample

from rmis_calib.vision.lens import Lens


def sample(images: Float[Tensor, "b c h w"], uv: Float[Tensor, "b *points 2"]) -> Float[Tensor, "b *points c"]:
    """Values of each picture at pixel coordinates; outside points read the border, so check `inside` as well.

    Convention: pixel (0, 0) is the centre of the top-left pixel.
    """
    height, width = images.shape[-2:]
    scale = uv.new_tensor([2.0 / max(width - 1, 1), 2.0 / max(height - 1, 1)])
    flat = uv.reshape(uv.shape[0], 1, -1, 2) * scale - 1.0
    values = grid_sample(images, flat.to(images.dtype), mode="bilinear", padding_mode="border", align_corners=True)
    return values[:, :, 0].mT.reshape(*uv.shape[:-1], images.shape[1])


def inside(
    uv: Float[Tensor, "*points 2"], image_size: tuple[int, int], margin_px: float = 0.0
) -> Bool[Tensor, "*points"]:
    """Whether points lie in the picture, at least `margin_px` from the centres of its outermost pixels."""
    height, width = image_size
    u, v = uv.unbind(-1)
    return (u >= margin_px) & (v >= margin_px) & (u <= width - 1 - margin_px) & (v <= height - 1 - margin_px)


@dataclass(frozen=True, eq=False)
class FullPicture:
    """Pictures at full resolution, as they came, and which of them each strip lies in."""

    images: Tensor
    """(n, 3, h, w), contiguous, uint8 or single precision in [0, 1]."""
    frame: Tensor
    """(b, k) int64: frame of each strip."""
    lens: Lens

    def read(
        self, ideal: Float[Tensor, "b k *points 2"]
    ) -> tuple[Float[Tensor, "b k *points 3"], Bool[Tensor, "b k *points"]]:
        """Colours in [0, 1] at ideal pixels, bilinearly, and whether they lie in the picture.

        Gathers from the picture's own bytes: turning it into floating point first costs more than all that is read.
        """
        height, width = self.images.shape[-2:]
        raw = self.lens.to_raw(ideal)
        # A strip that no contour supports may have no place: it reads the corner and is not inside.
        safe = torch.nan_to_num(raw)
        u, v = safe[..., 0].clamp(0, width - 1.001), safe[..., 1].clamp(0, height - 1.001)
        column, row = u.to(torch.int64), v.to(torch.int64)
        du, dv = (u - column)[..., None], (v - row)[..., None]
        frame = self.frame.reshape(*self.frame.shape, *[1] * (u.ndim - 2))
        first = (frame * 3 * height + row) * width + column
        channels = torch.arange(3, device=first.device) * (height * width)
        at = first[..., None] + channels
        flat = self.images.view(-1)
        value = [flat.take(at + shift).to(raw.dtype) for shift in (0, 1, width, width + 1)]
        upper = value[0] + (value[1] - value[0]) * du
        lower = value[2] + (value[3] - value[2]) * du
        colours = upper + (lower - upper) * dv
        if self.images.dtype == torch.uint8:
            colours = colours * (1.0 / 255.0)
        return colours, inside(raw, (height, width))
