"""Reads the small picture along strips: where both contours are, station by station, and what lies between them."""

from dataclasses import dataclass

import torch
from jaxtyping import Bool, Float
from torch import Tensor

from rmis_calib.vision.coarse.appearance import weighted_tint
from rmis_calib.vision.coarse.strips import SmallPicture, Strips
from rmis_calib.vision.image.run_length import third_lowest

_OFFSETS = 9
_STATIONS = 160


@dataclass(frozen=True, eq=False)
class ContourProfiles:
    """Both contours of strips, at stations: [left, right]."""

    lateral: Float[Tensor, "b k 2 s"]
    """Lateral place, px."""
    rise: Float[Tensor, "b k 2 s"]
    """Outward rise of the shaft contrast across it."""
    outer: Float[Tensor, "b k 2 s"]
    """Unlikeness just outside."""
    brightness: Float[Tensor, "b k 2 s"]
    """Log brightness just outside."""
    seen: Bool[Tensor, "b k 2 s"]
    """Whether it is in the field of view."""


def follow(picture: SmallPicture, strips: Strips, stations: Float[Tensor, "b k s"]) -> ContourProfiles:
    """The strongest outward rise near each predicted contour."""
    predicted = strips.contour(stations)  # (b, k, 2, s)
    width = (predicted[:, :, :1] - predicted[:, :, 1:]).clamp(min=1.0)
    unit = float(picture.factor)
    near = (0.07 * width).clamp(min=1.5 * unit) * stations.new_tensor([1.0, -1.0])[:, None]  # outwards
    reach = (0.2 * width).clamp(min=2.0 * unit)
    share = torch.linspace(-1, 1, _OFFSETS, device=stations.device)[:, None, None]
    lateral = predicted[:, :, None] + reach[:, :, None] * share  # (b, k, o, 2, s)
    both = torch.stack([lateral + near[:, :, None], lateral - near[:, :, None]], 2)
    value, seen = picture.read_contrast(strips, stations[:, :, None, None, None], both)
    seen = seen[:, :, 0] & seen[:, :, 1]
    rise = (value[:, :, 0] - value[:, :, 1]) * seen.to(value.dtype)
    best = (rise * torch.exp(-0.5 * (1.2 * share) ** 2)).max(2, keepdim=True).indices  # argmax is ten times as slow
    place, step, outer = (layer.gather(2, best)[:, :, 0] for layer in (lateral, rise, value[:, :, 0]))
    beside = picture.read_brightness(strips, stations[:, :, None], place + near)
    return ContourProfiles(place, step, outer, beside, seen[:, :, _OFFSETS // 2])


@dataclass(frozen=True, eq=False)
class AxisProfile:
    """What lies between the contours, at stations."""

    inner: Float[Tensor, "b k s"]
    """Unlikeness of the darker part of the inside."""
    far: Float[Tensor, "b k s"]
    """The lower shaft contrast of both sides, most of a width away."""
    brightness: Float[Tensor, "b k s"]
    """Log brightness of the darker part."""
    tint: Float[Tensor, "b k s"]
    """Tint of the less tinted part, as it enters the dark view."""
    seen: Bool[Tensor, "b k s"]
    """Whether the middle is in the field of view."""


def read_middle(
    picture: SmallPicture, strips: Strips, stations: Float[Tensor, "b k s"], sides: ContourProfiles
) -> AxisProfile:
    """Tone of the inside, and of both sides most of a width away from the middle line."""
    left, right = sides.lateral.unbind(2)
    across = left.new_tensor([-0.35, -0.233, -0.117, 0.0, 0.117, 0.233, 0.35, -0.85, 0.85])[:, None]
    y = 0.5 * (left + right)[:, :, None] + (left - right)[:, :, None] * across
    value, seen, tone = picture.read(strips, stations[:, :, None], y)
    # The third darkest of seven: a glare stripe may cover half of the width and more.
    tint = weighted_tint(value, tone, picture.lit(strips))
    inner, brightness, tint = (third_lowest(layer[:, :, :7]) for layer in (value, tone, tint))
    far = torch.where(seen[:, :, 7:], value[:, :, 7:], torch.inf).amin(2)
    return AxisProfile(inner, far, brightness, tint, seen[:, :, 3])


@dataclass(frozen=True, eq=False)
class StripProfiles:
    """All that is read of strips, from end to end of the canvas."""

    t: Float[Tensor, " s"]
    """Stations, px."""
    sides: ContourProfiles
    middle: AxisProfile
    lit: Bool[Tensor, "b k"]
    """Which strips are seen in the lit view."""
    span: Float[Tensor, "b k s"]
    """Distance of the contours, px."""
    step: Float[Tensor, "b k s"]
    """Rise across the weaker contour in view; infinite where none is."""
    outer: Float[Tensor, "b k s"]
    """Unlikeness outside of the contour in view that has less of it; infinite where none is."""

    @property
    def spacing(self) -> float:
        """From station to station, px."""
        return float(self.t[1] - self.t[0])

    @property
    def seen(self) -> Bool[Tensor, "b k s"]:
        """Whether the middle is in the field of view."""
        return self.middle.seen

    @property
    def brighter(self) -> Float[Tensor, "b k s"]:
        """How much brighter the inside is than both sides, log brightness."""
        return self.middle.brightness - self.sides.brightness.mean(2)


def read_profiles(picture: SmallPicture, strips: Strips) -> StripProfiles:
    """Both contours and what lies between them, at stations."""
    t = torch.linspace(-1, 1, _STATIONS, device=strips.offset.device) * picture.half_diagonal_px
    stations = t.expand(*strips.valid.shape, _STATIONS)
    sides = follow(picture, strips, stations)
    return StripProfiles(
        t=t,
        sides=sides,
        middle=read_middle(picture, strips, stations, sides),
        lit=picture.lit(strips),
        span=sides.lateral[:, :, 0] - sides.lateral[:, :, 1],
        step=torch.where(sides.seen, sides.rise, torch.inf).amin(2),
        outer=torch.where(sides.seen, sides.outer, torch.inf).amin(2),
    )
