"""Where the dark shaft stops along its axis: the boundary with the wrist, read on the middle third of the width."""

from dataclasses import dataclass

import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor

from rmis_calib.vision.coarse.strip_network import StripVerdict
from rmis_calib.vision.coarse.strips import Strips
from rmis_calib.vision.coarse.trace import Trace
from rmis_calib.vision.detections import EndKind
from rmis_calib.vision.fine.subpixel import step_estimator
from rmis_calib.vision.image.run_length import third_lowest
from rmis_calib.vision.image.sampling import FullPicture

_ROWS = 11
_REACH = 0.5
"""Rows lie within this share of the half width: beyond, the rim bends away and the shading of the limb begins."""
_HALF = 40
_DARKEST = 3, 11
"""Ranks of the samples before the end, by brightness, whose mean is the shaft's colour."""
_FIT = 7


@dataclass(frozen=True, eq=False)
class ShaftEnd:
    """Station of the boundary on the middle line, full-resolution ideal px."""

    t: Float[Tensor, "b k"]
    sigma_px: Float[Tensor, "b k"]
    valid: Bool[Tensor, "b k"]


# Share of the width over which the end may lie where the network does not say: at a wrist the tone changes at once.
_TRACED_REACH = 0.25
# The network's own error, columns and share of the width.
_COLUMNS, _WIDTH_SHARE = 1.0, 0.04
# Least probability of the place that the network gives for it to be believed rather than the trace.
_BELIEVED = 0.35


@dataclass(frozen=True, eq=False)
class ExpectedEnd:
    """What is known of the end before it is measured."""

    t: Float[Tensor, "1 m"]
    """Station, px."""
    reach_px: Float[Tensor, "1 m"]
    """1 sigma of that."""
    kind: Int[Tensor, "1 m"]
    """`EndKind`."""
    sureness: Float[Tensor, "1 m"]
    in_view: Bool[Tensor, "1 m"]


def expect(verdict: StripVerdict, trace: Trace) -> ExpectedEnd:
    """Where the end should be: as the network sees it, or where it does not know, where the trace's own tone ends."""
    at, kind, share = (value[None] for value in verdict.best_end())
    border, hidden = verdict.border[None], verdict.hidden[None]
    believed = (share > _BELIEVED) & (share > torch.maximum(border, hidden)) & (verdict.shaft[None] > 0)
    outside = torch.maximum(border, hidden) > 0.5
    unseen = torch.where(hidden > border, int(EndKind.HIDDEN), int(EndKind.BORDER))
    unknown = torch.where(outside, unseen, int(EndKind.UNKNOWN))
    column = verdict.column_px[None]
    reach = torch.maximum(_COLUMNS * column, _WIDTH_SHARE * trace.width)
    return ExpectedEnd(
        t=torch.where(believed, at, trace.end),
        reach_px=torch.where(believed, reach, _TRACED_REACH * trace.width),
        kind=torch.where(believed, kind, unknown),
        sureness=torch.where(believed, share, torch.where(outside, torch.maximum(border, hidden), 0.0)),
        in_view=believed | (~outside & ~trace.end_at_border),
    )


def locate(
    picture: FullPicture,
    strips: Strips,
    coarse_t: Float[Tensor, "b k"],
    reach_px: Float[Tensor, "b k"],
    width: Float[Tensor, "b k"],
    blur_px: Float[Tensor, "b k"],
    floor_px: float,
) -> ShaftEnd:
    """The change of colour along the shaft near the coarse end: a strong one, and a near one.

    The boundary is an arc of an ellipse in the picture: its place is measured on rows across the middle half of the
    width, and read on the axis from a parabola through them.

    Args:
        picture: at full resolution.
        strips: through the measured contours, walked towards the tip.
        coarse_t: where the end is, about.
        reach_px: 1 sigma of that.
        width: of the shaft.
        blur_px: of its contours.
        floor_px: least uncertainty.
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
    index, rise, found = _near_rise(_darker_rows(profile), seen, reach_px / step)
    shift, agreement = _refine(profile, index, (blur_px / step).clamp(0.5, 3.0))
    place = index.to(t.dtype) - _HALF + shift
    sigma = (agreement * step).clamp(min=floor_px)
    sharp = (agreement < 3.0) & (rise > 0.02) & (shift.abs() < 6.0)
    return ShaftEnd(coarse_t + place * step, sigma, found & sharp & strips.valid)


def _darker_rows(values: Float[Tensor, "b k r ..."]) -> Float[Tensor, "b k ..."]:
    """The third lowest over the rows: a glare stripe may be as bright as the wrist, but leaves some rows dark."""
    return third_lowest(values)


def _separate(colours: Float[Tensor, "b k r n 3"], seen: Bool[Tensor, "b k n"]) -> Float[Tensor, "b k r n"]:
    """Colours along the direction that leads from the shaft, the darkest of the first half, to what follows.

    A ball or a stain may take up most of what lies before the end.
    """
    mean = torch.where(seen[..., None], _darker_rows(colours), torch.nan)
    half, third = mean.shape[2] // 2, mean.shape[2] // 3
    first = mean[:, :, :half]
    tone = torch.where(seen[:, :, :half], first.sum(-1), torch.inf)
    darkest = tone.argsort(dim=-1, stable=True)[..., _DARKEST[0] : _DARKEST[1], None].expand(-1, -1, -1, 3)
    before = first.gather(2, darkest).nanmean(2)
    direction = torch.nan_to_num(mean[:, :, third:] - before[:, :, None])
    size = direction.norm(dim=-1, keepdim=True)
    main = (direction * size).sum(2)
    main = main / main.norm(dim=-1, keepdim=True).clamp(min=1e-6)
    return torch.einsum("bkrnc,bkc->bkrn", colours, main)


def _near_rise(
    profile: Float[Tensor, "b k n"], seen: Bool[Tensor, "b k n"], reach: Float[Tensor, "b k"]
) -> tuple[Tensor, Float[Tensor, "b k"], Bool[Tensor, "b k"]]:
    """Index of the steepest rise, steps farther off than `reach` samples from the middle counting less; its height."""
    # Each sample against the one four before it, from two to either side.
    slope = torch.zeros_like(profile)
    slope[..., 2:-2] = profile[..., 4:] - profile[..., :-4]
    offsets = torch.arange(-_HALF, _HALF + 1, device=profile.device)
    weight = torch.exp(-0.5 * (offsets / reach[..., None].clamp(min=2.0)).square())
    best = torch.where(seen, slope * weight, 0.0).argmax(-1, keepdim=True)
    index = best[..., 0].clamp(_FIT + 1, profile.shape[-1] - _FIT - 2)
    return index, slope.gather(-1, best)[..., 0], seen.sum(-1) > 2 * (profile.shape[-1] // 3)


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
