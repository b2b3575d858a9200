"""Bilinear reading of pictures at many points, for a batch at once."""

import torch
from jaxtyping import Bool, Float
from torch import Tensor
from torch.nn.functional import grid_sample


def sample(images: Float[Tensor, "b c h w"], uv: Float[Tensor, "b *points 2"]) -> Float[Tensor, "b *points c"]:
    """Values of each picture at pixel coordinates; outside points read the border, so check `inside` as well.

    Convention: pixel (0, 0) is the centre of the top-left pixel.
    """
    height, width = images.shape[-2:]
    scale = uv.new_tensor([2.0 / max(width - 1, 1), 2.0 / max(height - 1, 1)])
    flat = torch.nan_to_num(uv, nan=-1.0).reshape(uv.shape[0], 1, -1, 2) * scale - 1.0
    values = grid_sample(images, flat.to(images.dtype), mode="bilinear", padding_mode="border", align_corners=True)
    return values[:, :, 0].mT.reshape(*uv.shape[:-1], images.shape[1])


def inside(
    uv: Float[Tensor, "*points 2"], image_size: tuple[int, int], margin_px: float = 0.0
) -> Bool[Tensor, "*points"]:
    """Whether points lie in the picture, at least `margin_px` from the centres of its outermost pixels."""
    height, width = image_size
    u, v = uv.unbind(-1)
    return (u >= margin_px) & (v >= margin_px) & (u <= width - 1 - margin_px) & (v <= height - 1 - margin_px)
