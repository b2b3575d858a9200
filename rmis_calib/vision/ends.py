"""Where the dark shaft stops along its axis: the boundary with the wrist, read on the middle third of the width."""

from dataclasses import dataclass

import torch
from jaxtyping import Bool, Float
from torch import Tensor

from rmis_calib.vision.edges import step_estimator
from rmis_calib.vision.lens import Lens
from rmis_calib.vision.sampling import inside, sample
from rmis_calib.vision.strips import Strips

_ROWS = 7
_HALF = 40
_FIT = 6
_BLUR_STEPS = 1.3
"""Blur assumed when the end is located, in profile steps; a wrong blur costs precision, not truth: the step is odd."""


@dataclass(frozen=True, eq=False)
class ShaftEnd:
    """Station of the boundary on the middle line, full-resolution ideal px."""

    t: Float[Tensor, "b k"]
    sigma_px: Float[Tensor, "b k"]
    valid: Bool[Tensor, "b k"]


def locate(
    image: Float[Tensor, "b 3 h w"],
    lens: Lens,
    strips: Strips,
    coarse_t: Float[Tensor, "b k"],
    width: Float[Tensor, "b k"],
    floor_px: float,
) -> ShaftEnd:
    """First strong change of colour met when walking along the shaft towards the tip, near the coarse end.

    The boundary is an arc of an ellipse in the picture; over the middle third of the width it strays from its place on
    the axis by less than two per cent of its own depth.
    """
    step = (0.9 * width / _HALF).clamp(0.5, 3.0)
    offsets = torch.arange(-_HALF, _HALF + 1, device=width.device, dtype=width.dtype)
    t = coarse_t[..., None] + offsets * step[..., None]  # (b, k, n)
    contour = strips.contour(t)
    rows = torch.linspace(-1 / 6, 1 / 6, _ROWS, device=t.device)
    y = contour.mean(2)[:, :, None] + (contour[:, :, 0] - contour[:, :, 1])[:, :, None] * rows[:, None]
    raw = lens.to_raw(strips.points(t[:, :, None].expand_as(y), y))  # (b, k, rows, n, 2)
    seen = inside(raw, (image.shape[-2], image.shape[-1])).all(2)
    colours = sample(image, raw)
    profile = _separate(colours, seen)
    index, rise, found = _first_rise(profile.mean(2), seen)
    shift, agreement = _refine(profile, index)
    place = index.to(t.dtype) - _HALF + shift
    sigma = (agreement * step).clamp(min=floor_px)
    sharp = (agreement < 3.0) & (rise > 0.02) & (shift.abs() < 3.0)
    return ShaftEnd(coarse_t + place * step, sigma, found & sharp & strips.valid)


def _separate(colours: Float[Tensor, "b k r n 3"], seen: Bool[Tensor, "b k n"]) -> Float[Tensor, "b k r n"]:
    """Colours along the direction that leads from the shaft (first third) to what follows (last half)."""
    mean = torch.where(seen[..., None], colours.mean(2), torch.nan)
    third = mean.shape[2] // 3
    before = mean[:, :, :third].nanmedian(2).values
    direction = torch.nan_to_num(mean[:, :, third:] - before[:, :, None])
    size = direction.norm(dim=-1, keepdim=True)
    main = (direction * size).sum(2)
    main = main / main.norm(dim=-1, keepdim=True).clamp(min=1e-6)
    return torch.einsum("bkrnc,bkc->bkrn", colours, main)


def _first_rise(
    profile: Float[Tensor, "b k n"], seen: Bool[Tensor, "b k n"]
) -> tuple[Tensor, Float[Tensor, "b k"], Bool[Tensor, "b k"]]:
    """Index where the profile first climbs half-way from the shaft's level to the level that follows; that climb."""
    known = torch.where(seen, profile, torch.nan)
    third = profile.shape[-1] // 3
    base = torch.nan_to_num(known[..., :third].nanmedian(-1).values)
    top = torch.nan_to_num(known[..., third:].nanquantile(0.8, dim=-1))
    above = seen & (profile > (0.5 * (base + top))[..., None])
    held = above[..., 2:] & above[..., 1:-1] & above[..., :-2]
    index = held.to(torch.int8).argmax(-1).clamp(_FIT + 1, profile.shape[-1] - _FIT - 2)
    return index, top - base, held.any(-1) & (seen.sum(-1) > 2 * third)


def _refine(profile: Float[Tensor, "b k r n"], index: Tensor) -> tuple[Float[Tensor, "b k"], Float[Tensor, "b k"]]:
    """Mean place of the step over the rows, in samples from `index`, and its standard deviation."""
    offsets = torch.arange(-_FIT, _FIT + 1, device=profile.device, dtype=profile.dtype)
    solve = step_estimator(offsets, offsets.new_tensor(_BLUR_STEPS))
    shift = torch.zeros(*index.shape, profile.shape[2], device=profile.device, dtype=profile.dtype)
    for _ in range(3):
        at = index[..., None, None] + shift[..., None] + offsets
        low = at.floor().clamp(0, profile.shape[-1] - 2)
        share = at - low
        low = low.long()
        window = profile.gather(-1, low) * (1 - share) + profile.gather(-1, low + 1) * share
        fit = torch.einsum("nd,bkrd->bkrn", solve, window)
        shift = (shift - (fit[..., 2] / fit[..., 1].clamp(min=1e-3)).clamp(-1.5, 1.5)).clamp(-4.0, 4.0)
    centre = shift.median(-1).values
    spread = 1.4826 * (shift - centre[..., None]).abs().median(-1).values
    return centre, spread * (1.57 / _ROWS) ** 0.5
