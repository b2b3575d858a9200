"""Where the dark shaft stops along its axis: the boundary with the wrist, read on the middle third of the width."""

from dataclasses import dataclass

import torch
from jaxtyping import Bool, Float
from torch import Tensor

from rmis_calib.vision.coarse.strips import Strips
from rmis_calib.vision.fine.subpixel import step_estimator
from rmis_calib.vision.image.sampling import FullPicture

_ROWS = 11
_REACH = 0.5
"""Rows lie within this share of the half width: beyond, the rim bends away and the shading of the limb begins."""
_HALF = 40
_FIT = 7


@dataclass(frozen=True, eq=False)
class ShaftEnd:
    """Station of the boundary on the middle line, full-resolution ideal px."""

    t: Float[Tensor, "b k"]
    sigma_px: Float[Tensor, "b k"]
    valid: Bool[Tensor, "b k"]


def locate(
    picture: FullPicture,
    strips: Strips,
    coarse_t: Float[Tensor, "b k"],
    width: Float[Tensor, "b k"],
    blur_px: Float[Tensor, "b k"],
    floor_px: float,
) -> ShaftEnd:
    """First strong change of colour met when walking along the shaft towards the tip, near the coarse end.

    The boundary is an arc of an ellipse in the picture: its place is measured on rows across the middle half of the
    width, and read on the axis from a parabola through them.
    """
    step = (0.9 * width / _HALF).clamp(0.5, 3.0)
    offsets = torch.arange(-_HALF, _HALF + 1, device=width.device, dtype=width.dtype)
    t = coarse_t[..., None] + offsets * step[..., None]  # (b, k, n)
    contour = strips.contour(t)
    rows = torch.linspace(-0.5 * _REACH, 0.5 * _REACH, _ROWS, device=t.device)
    y = contour.mean(2)[:, :, None] + (contour[:, :, 0] - contour[:, :, 1])[:, :, None] * rows[:, None]
    colours, seen = picture.read(strips.points(t[:, :, None].expand_as(y), y))
    seen = seen.all(2)
    profile = _separate(colours.movedim(0, -1), seen)
    index, rise, found = _first_rise(_darker_rows(profile), seen)
    shift, agreement = _refine(profile, index, (blur_px / step).clamp(0.5, 3.0))
    place = index.to(t.dtype) - _HALF + shift
    sigma = (agreement * step).clamp(min=floor_px)
    sharp = (agreement < 3.0) & (rise > 0.02) & (shift.abs() < 6.0)
    return ShaftEnd(coarse_t + place * step, sigma, found & sharp & strips.valid)


def _darker_rows(values: Float[Tensor, "b k r ..."]) -> Float[Tensor, "b k ..."]:
    """The third lowest over the rows: a glare stripe may be as bright as the wrist, but leaves some rows dark."""
    return values.kthvalue(3, dim=2).values


def _separate(colours: Float[Tensor, "b k r n 3"], seen: Bool[Tensor, "b k n"]) -> Float[Tensor, "b k r n"]:
    """Colours along the direction that leads from the shaft (first third) to what follows (last half)."""
    mean = torch.where(seen[..., None], _darker_rows(colours), torch.nan)
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


def _refine(
    profile: Float[Tensor, "b k r n"], index: Tensor, blur_steps: Float[Tensor, "b k"]
) -> tuple[Float[Tensor, "b k"], Float[Tensor, "b k"]]:
    """Place of the step on the axis, in samples from `index`, and its standard deviation."""
    offsets = torch.arange(-_FIT, _FIT + 1, device=profile.device, dtype=profile.dtype)
    solve = step_estimator(offsets, blur_steps)
    shift = _steepest_near(profile, index)
    for _ in range(3):
        at = index[..., None, None] + shift[..., None] + offsets
        low = at.floor().clamp(0, profile.shape[-1] - 2)
        share = at - low
        low = low.long()
        window = profile.gather(-1, low) * (1 - share) + profile.gather(-1, low + 1) * share
        fit = torch.einsum("bknd,bkrd->bkrn", solve, window)
        shift = (shift - (fit[..., 2] / fit[..., 1].clamp(min=1e-3)).clamp(-1.5, 1.5)).clamp(-12.0, 12.0)
    height = fit[..., 1]
    plain = height > 0.4 * height.amax(-1, keepdim=True)
    return _on_axis(shift, plain.to(shift.dtype))


def _steepest_near(profile: Float[Tensor, "b k r n"], index: Tensor) -> Float[Tensor, "b k r"]:
    """Offset from `index` of the steepest rise of each row, within ten samples: the rim may cross the axis aslant."""
    offsets = torch.arange(-12, 13, device=profile.device)
    at = (index[..., None, None] + offsets).clamp(0, profile.shape[-1] - 1).expand(*profile.shape[:3], -1)
    window = profile.gather(-1, at)
    slope = window.unfold(-1, 5, 1) @ profile.new_tensor([-1.0, -2.0, 0.0, 2.0, 1.0])
    near = torch.exp(-0.5 * (torch.arange(-10, 11, device=profile.device) / 5.0) ** 2)
    return (slope * near).argmax(-1).to(profile.dtype) - 10


def _on_axis(
    shift: Float[Tensor, "b k r"], trust: Float[Tensor, "b k r"]
) -> tuple[Float[Tensor, "b k"], Float[Tensor, "b k"]]:
    """Value at the middle row of a robust parabola through the rows, and its standard deviation."""
    row = torch.linspace(-1, 1, _ROWS, device=shift.device, dtype=shift.dtype)
    columns = torch.stack([torch.ones_like(row), row, row * row], -1)
    weight = trust
    for _ in range(6):
        weighted = columns * weight[..., None]
        inverse = torch.linalg.inv(weighted.mT @ columns + 1e-6 * torch.eye(3, device=shift.device))
        solution = (inverse @ (weighted.mT @ shift[..., None]))[..., 0]
        residual = shift - solution @ columns.mT
        size = torch.where(trust > 0, residual.abs(), torch.nan).nanmedian(-1, keepdim=True).values
        scale = (1.4826 * torch.nan_to_num(size)).clamp(min=1e-3)
        weight = trust * 1.3 / (residual / scale).abs().clamp(min=1.3)
    return solution[..., 0], scale[..., 0] * inverse[..., 0, 0].clamp(min=0.0).sqrt()
