"""Bilinear reading of pictures at many points, for a batch at once."""

import math
from dataclasses import dataclass

import torch
from jaxtyping import Bool, Float, Int64
from torch import Tensor
from torch.nn.functional import grid_sample

from rmis_calib.vision.image.pixel_mapping import Lens


def sample(
    layers: Float[Tensor, " c h w"], u: Float[Tensor, " *points"], v: Float[Tensor, " *points"]
) -> Float[Tensor, " c *points"]:
    """Values of each layer at pixel coordinates, bilinearly; points outside read the border.

    Convention: pixel (0, 0) is the centre of the top-left pixel.
    """
    height, width = layers.shape[-2:]
    place = torch.stack([u * (2.0 / max(width - 1, 1)) - 1.0, v * (2.0 / max(height - 1, 1)) - 1.0], -1)
    place = place.reshape(1, 1, -1, 2)
    values = grid_sample(layers[None], place, mode="bilinear", padding_mode="border", align_corners=True)
    return values.reshape(layers.shape[0], *u.shape)


def sample_frames(
    layers: Float[Tensor, "c n h w"],
    frame: Int64[Tensor, "b k"],
    u: Float[Tensor, "b k *points"],
    v: Float[Tensor, "b k *points"],
) -> Float[Tensor, "c b k *points"]:
    """As `sample`, from several pictures in one call.

    Each picture is read with coordinates of its own, so that its values depend on it alone: rows of one tall picture
    would be rounded with its height, by 0.01 px in 256 pictures of 720 rows.

    Args:
        layers: of n pictures.
        frame: which of them each row of points lies in: row i of n in picture i, or a list (b is not n) in any order.
        u, v: pixel coordinates.
    """
    n, *size = layers.shape[1:]
    place = u.new_empty(*u.shape, 2)  # a third of the time of `stack`
    for axis, (at, length) in enumerate(((u, size[1]), (v, size[0]))):
        torch.sub(at * (2.0 / max(length - 1, 1)), 1.0, out=place[..., axis])
    place = place.reshape(frame.numel(), math.prod(u.shape[2:]), 2)
    slot, width = (None, frame.shape[1]) if frame.shape[0] == n else _slots(frame.reshape(-1), n)
    if slot is not None:
        place = place.new_zeros(n * width, *place.shape[1:]).index_copy_(0, slot, place)
    place = place.reshape(n, width, place.shape[1], 2)
    read = grid_sample(layers.movedim(0, 1), place, mode="bilinear", padding_mode="border", align_corners=True)
    read = read.movedim(1, 0).flatten(1, 2)
    return (read if slot is None else read.index_select(1, slot)).reshape(len(layers), *u.shape)


def _slots(frame: Int64[Tensor, " m"], n: int) -> tuple[Int64[Tensor, " m"], int]:
    """Places of a list's members in a table with one row a picture, and how wide the table is."""
    before = (frame[:, None] == torch.arange(n, device=frame.device)).cumsum(0)
    width = max(1, int(before[-1:].sum(0).max()))
    return frame * width + before.gather(1, frame[:, None])[:, 0] - 1, width


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
    """(n, 3, h, w), uint8 or single precision in [0, 1]; channels last in memory, as videos are decoded."""
    frame: Tensor
    """(b, k) int64: frame of each strip."""
    lens: Lens

    def read(
        self, ideal: Float[Tensor, "b k *points 2"]
    ) -> tuple[Float[Tensor, "3 b k *points"], Bool[Tensor, "b k *points"]]:
        """Colours in [0, 1] at ideal pixels, bilinearly, and whether they lie in the picture."""
        raw = self.lens.to_raw(ideal)
        return self._gather(raw[..., 0], raw[..., 1]), inside(raw, (self.images.shape[-2], self.images.shape[-1]))

    def read_across(
        self, middle: Float[Tensor, "b k e p 2"], outward: Float[Tensor, "b k e 2"], offsets: Float[Tensor, "b k e d"]
    ) -> tuple[Float[Tensor, "3 b k e p d"], Bool[Tensor, "b k e p"]]:
        """Colours along short profiles, and whether all of each lies in the picture.

        The lens is asked at three places of a profile, and a parabola gives the others: over twenty pixels that is
        good to a thousandth of a pixel for the strongest lens of the presets (k1 = -0.35), and no work otherwise.

        Args:
            middle: ideal pixels.
            outward: unit direction of the profiles.
            offsets: places along them from `middle`, px, rising, symmetric.
        """
        reach = offsets[..., -1:, None, None]
        sides = middle.new_tensor([-1.0, 0.0, 1.0])[:, None]
        knots = self.lens.to_raw(middle[:, :, :, :, None] + reach * sides * outward[:, :, :, None, None])
        z = offsets / offsets[..., -1:]
        parabola = torch.stack([0.5 * z * (z - 1), 1 - z * z, 0.5 * z * (z + 1)], -2)  # (b, k, e, 3, d)
        u, v = (knots[..., i] @ parabola for i in (0, 1))
        return self._gather(u, v), inside(knots, (self.images.shape[-2], self.images.shape[-1])).all(-1)

    def _gather(self, u: Float[Tensor, "b k *points"], v: Float[Tensor, "b k *points"]) -> Tensor:
        """Colours (3, b, k, *points) at raw pixels.

        Gathers from the picture's own bytes: turning it into floating point first costs more than all that is read.
        A pixel and its right neighbour are six consecutive values, and rows of six are fetched four times as fast as
        single values.
        """
        height, width = self.images.shape[-2:]
        shape = u.shape
        # A strip that no contour supports may have no place: it reads the corner and is not inside.
        u, v = (torch.nan_to_num(at).clamp_(0, length - 1.001).reshape(-1) for at, length in ((u, width), (v, height)))
        column, row = u.floor(), v.floor()
        first_row = (self.frame * height).reshape(-1).repeat_interleave(u.numel() // self.frame.numel())
        at = row.to(torch.int64).add_(first_row).mul_(width).add_(column.to(torch.int64))
        pixels = self.images.permute(0, 2, 3, 1).reshape(-1)
        pairs = pixels.as_strided((pixels.numel() // 3 - 1, 6), (3, 1))
        du, dv = u.sub_(column), v.sub_(row)
        rows = []
        for shift in (0, width):
            pair = pairs.index_select(0, at + shift).T.to(torch.float32, memory_format=torch.contiguous_format)
            rows.append(torch.lerp(pair[:3], pair[3:], du))
        colours = torch.lerp(rows[0], rows[1], dv)
        if self.images.dtype == torch.uint8:
            colours *= 1.0 / 255.0
        return colours.reshape(3, *shape)
