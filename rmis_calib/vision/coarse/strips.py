"""Strips between two nearly parallel lines: the candidates for a shaft, and what the small picture says for them.

A strip has its own frame: station t along it, lateral y to the *left* of its direction (the picture's x
points right and y down). Contours are y = offset + slope * t. All lengths are full-resolution ideal pixels.
"""

from dataclasses import dataclass, fields, replace

import torch
from jaxtyping import Bool, Float, Int64
from torch import Tensor

from rmis_calib.vision.coarse.hough import HoughLines
from rmis_calib.vision.image.canvas import Canvas
from rmis_calib.vision.image.sampling import sample_frames
from rmis_calib.vision.settings import DetectorSettings


@dataclass(frozen=True, eq=False)
class SmallPicture:
    """The small picture of a batch, and how to read it at full-resolution ideal pixels."""

    layers: Float[Tensor, "3 b h w"]
    """Unlikeness to a shaft; 1 inside the field of view, else 0; log brightness. The views of a picture follow one
    another as frames of their own."""
    views: int
    """How many: the dark one, or the dark and the lit one."""
    canvas: Canvas
    width_px: int
    """Width of the raw picture."""

    @property
    def factor(self) -> int:
        """Full-resolution pixels a small one."""
        return self.canvas.factor

    @property
    def half_diagonal_px(self) -> float:
        """Reach of a line from the middle, full-resolution px."""
        return self.canvas.half_diagonal_px

    def lit(self, strips: "Strips") -> Bool[Tensor, "b k"]:
        """Which strips are seen in the lit view."""
        return strips.frame % self.views > 0

    def read(
        self, strips: "Strips", t: Float[Tensor, "b k *#points"], y: Float[Tensor, "b k *#points"]
    ) -> tuple[Float[Tensor, "b k *points"], Bool[Tensor, "b k *points"], Float[Tensor, "b k *points"]]:
        """Unlikeness at (station, lateral) pairs, whether they lie in the field of view, and log brightness."""
        place = self._place(strips, t, y)
        unlike, field, tone = sample_frames(self.layers, strips.frame, *place)
        return unlike, self._seen(field, *place), tone

    def read_contrast(
        self, strips: "Strips", t: Float[Tensor, "b k *#points"], y: Float[Tensor, "b k *#points"]
    ) -> tuple[Float[Tensor, "b k *points"], Bool[Tensor, "b k *points"]]:
        """The first two of `read`."""
        place = self._place(strips, t, y)
        unlike, field = sample_frames(self.layers[:2], strips.frame, *place)
        return unlike, self._seen(field, *place)

    def read_brightness(
        self, strips: "Strips", t: Float[Tensor, "b k *#points"], y: Float[Tensor, "b k *#points"]
    ) -> Float[Tensor, "b k *points"]:
        """The last of `read`."""
        return sample_frames(self.layers[2:], strips.frame, *self._place(strips, t, y))[0]

    def _place(
        self, strips: "Strips", t: Float[Tensor, "b k *#points"], y: Float[Tensor, "b k *#points"]
    ) -> tuple[Float[Tensor, "b k *points"], Float[Tensor, "b k *points"]]:
        """Small pixel coordinates of (station, lateral) pairs."""
        shape = (*strips.frame.shape, *[1] * (max(t.ndim, y.ndim) - 2))
        first = (strips.origin - strips.origin.new_tensor(self.canvas.origin)) / self.factor
        axes = (first, strips.along / self.factor, strips.left / self.factor)
        u, v = (
            torch.addcmul(torch.addcmul(origin, t, along), y, left)
            for origin, along, left in zip(
                *([value.reshape(shape) for value in axis.unbind(-1)] for axis in axes), strict=True
            )
        )
        return u, v

    def _seen(
        self, field: Float[Tensor, "b k *points"], u: Float[Tensor, "b k *points"], v: Float[Tensor, "b k *points"]
    ) -> Bool[Tensor, "b k *points"]:
        """Whether places lie in the field of view, and in the picture."""
        height, width = self.canvas.size
        near_u = (u - 0.5 * (width - 1)).abs_() <= 0.5 * width
        near_v = (v - 0.5 * (height - 1)).abs_() <= 0.5 * height
        return (field > 0.75).logical_and_(near_u).logical_and_(near_v)


@dataclass(frozen=True, eq=False)
class Strips:
    """k candidate strips a frame, or some strips of all frames as one list, (1, m)."""

    frame: Int64[Tensor, "b k"]
    origin: Float[Tensor, "b k 2"]
    """Point of the middle line nearest to the centre of the picture."""
    along: Float[Tensor, "b k 2"]
    """Unit direction of growing t."""
    offset: Float[Tensor, "b k 2"]
    """Lateral place of [left, right] contour at t = 0."""
    slope: Float[Tensor, "b k 2"]
    """Slope of [left, right] contour."""
    valid: Bool[Tensor, "b k"]

    @property
    def left(self) -> Float[Tensor, "b k 2"]:
        """Unit lateral direction."""
        return torch.stack([self.along[..., 1], -self.along[..., 0]], -1)

    def contour(self, t: Float[Tensor, "b k s"]) -> Float[Tensor, "b k 2 s"]:
        """Lateral place of [left, right] contour at stations."""
        return self.offset[..., None] + self.slope[..., None] * t[..., None, :]

    def points(self, t: Float[Tensor, "b k *s"], y: Float[Tensor, "b k *s"]) -> Float[Tensor, "b k *s 2"]:
        """Ideal pixels of (station, lateral) pairs."""
        shape = (*t.shape[:2], *[1] * (t.ndim - 2), 2)
        return (
            self.origin.reshape(shape)
            + t[..., None] * self.along.reshape(shape)
            + y[..., None] * self.left.reshape(shape)
        )

    def pick(self, index: Tensor) -> "Strips":
        """The strips with these indices, (b, k') int64."""
        wide = index[..., None].expand(*index.shape, 2)
        return Strips(
            frame=self.frame.gather(1, index),
            origin=self.origin.gather(1, wide),
            along=self.along.gather(1, wide),
            offset=self.offset.gather(1, wide),
            slope=self.slope.gather(1, wide),
            valid=self.valid.gather(1, index),
        )

    def listed(self, keep: Bool[Tensor, "b k"]) -> "Strips":
        """The kept strips of all frames as one list, (1, m)."""
        return Strips(**{field.name: getattr(self, field.name)[keep][None] for field in fields(self)})

    def reverse(self, where: Bool[Tensor, "b k"]) -> "Strips":
        """The same strips walked the other way round where asked: left and right change places."""
        flip = where[..., None]
        return replace(
            self,
            along=torch.where(flip, -self.along, self.along),
            offset=torch.where(flip, -self.offset.flip(-1), self.offset),
            slope=torch.where(flip, self.slope.flip(-1), self.slope),
        )


def between(lines: Float[Tensor, "b 2 3"], canvas: Canvas) -> Strips:
    """The strip between two lines of each picture: the left one and the right one of a direction.

    Args:
        lines: a u + b v + c = 0 in ideal pixels, positive to the right of that direction.
        canvas: whose middle the stations count from.
    """
    lines = lines / lines[..., :2].norm(dim=-1, keepdim=True)
    normal = torch.nn.functional.normalize(lines[..., :2].sum(1), dim=-1)  # to the right
    along = torch.stack([normal[..., 1], -normal[..., 0]], -1)
    centre = lines.new_tensor(canvas.centre)
    across = -(lines[..., :2] * normal[:, None]).sum(-1)
    offset = -((lines[..., :2] * centre).sum(-1) + lines[..., 2]) / across
    slope = -(lines[..., :2] * along[:, None]).sum(-1) / across
    middle = offset.mean(-1, keepdim=True)
    frame = torch.arange(len(lines), device=lines.device)[:, None]
    valid = torch.isfinite(offset).all(-1, keepdim=True) & (offset[:, :1] > offset[:, 1:])
    return Strips(
        frame=frame,
        origin=(centre - middle * normal)[:, None],
        along=along[:, None],
        offset=torch.nan_to_num(offset - middle)[:, None],
        slope=torch.nan_to_num(slope)[:, None],
        valid=valid,
    )


def listed_between(lines: Float[Tensor, "b k 2 3"], canvas: Canvas) -> tuple[Strips, Bool[Tensor, "b k"]]:
    """As `between`, of several pairs of lines a picture: those that enclose a strip as one list, and which these are.

    The list holds one at least, as an empty one has no medians: where none encloses a strip, one without a place.
    """
    count, most = lines.shape[:2]
    each = between(lines.flatten(0, 1), canvas)
    frame = torch.arange(count, device=lines.device).repeat_interleave(most)[:, None]
    keep = each.valid.reshape(count, most).clone()
    keep[0, 0] |= ~keep.any()
    known = replace(each, frame=frame, origin=torch.nan_to_num(each.origin), along=torch.nan_to_num(each.along))
    return known.listed(keep.reshape(-1, 1)), keep


def pair(lines: HoughLines, picture: SmallPicture, settings: DetectorSettings, count: int) -> Strips:
    """Up to `count` most voted pairs of lines that could be the contours of one cylinder.

    They face away from each other, converge little, and enclose a plausible width near the middle of the picture.
    """
    first, second = torch.triu_indices(lines.rho.shape[1], lines.rho.shape[1], 1, device=lines.rho.device)
    n_a, n_b = lines.normal[:, first], lines.normal[:, second]
    rho_a, rho_b = lines.rho[:, first], lines.rho[:, second]
    left = n_a - n_b
    left = left / left.norm(dim=-1, keepdim=True).clamp(min=1e-6)
    along = torch.stack([-left[..., 1], left[..., 0]], -1)
    cos_a, cos_b = (n_a * left).sum(-1), -(n_b * left).sum(-1)
    slope = torch.stack([-(n_a * along).sum(-1) / cos_a, (n_b * along).sum(-1) / cos_b], -1)
    offset = torch.stack([rho_a / cos_a, -rho_b / cos_b], -1)
    width = (offset[..., 0] - offset[..., 1]) * 1.0
    facing = (n_a * n_b).sum(-1) < -torch.cos(torch.deg2rad(width.new_tensor(settings.max_convergence_deg)))
    size = float(picture.width_px)
    fits = (width > settings.min_width_fraction * size) & (width < settings.max_width_fraction * size)
    score = torch.minimum(lines.votes[:, first], lines.votes[:, second]) * (facing & fits)
    best = score.topk(min(count, score.shape[1]), dim=1)
    centre = width.new_tensor(picture.canvas.centre)
    middle = offset.mean(-1, keepdim=True)
    frame = torch.arange(score.shape[0], device=score.device)[:, None].expand_as(score)
    strips = Strips(frame, centre + middle * left, along, offset - middle, slope, score > 0)
    return strips.pick(best.indices[:, : max(1, int(strips.valid.sum(1).max()))])
