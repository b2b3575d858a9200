"""Where a wrist of bright metal follows a shaft along a strip, for any leading batch."""

import torch
from jaxtyping import Bool, Float
from torch import Tensor

from rmis_calib.vision.image.run_length import first_on, last_on, longest_run

# Log brightness: metal is two to three times as bright as the shaft before it (0.7 to 1.1) on the rendered pictures,
# and half of that in the da Vinci and grasper frames; light along a shaft changes by less over a width.
_RISE = 0.3


def between_wrists(
    brightness: Float[Tensor, "*b s"],
    tint: Float[Tensor, "*b s"],
    beside: Float[Tensor, "*b 2 s"],
    on: Bool[Tensor, "*b s"],
    seen: Bool[Tensor, "*b s"],
    width: Float[Tensor, "*b"],
) -> tuple[Float[Tensor, "*b"], Float[Tensor, "*b"]]:
    """First and last station between which no wrist of bright metal lies; infinite on a side where none begins.

    Light along a shaft changes slowly; at a wrist the darker part of the inside becomes brighter at once, and stays so.

    Args:
        brightness: log brightness of the darker part of the inside.
        tint: of the same.
        beside: log brightness just outside of either contour.
        on: stations with contours.
        seen: stations in the field of view.
        width: width of the strip, in stations.
    """
    place = torch.arange(brightness.shape[-1], device=brightness.device, dtype=brightness.dtype)
    rise = _rise_ahead(brightness, on, 0.8 * width)
    # Towards the light, as from a vignette, both sides grow brighter as well.
    common = _rise_ahead(beside, on[..., None, :].expand_as(beside), 0.8 * width[..., None].expand(*width.shape, 2))
    rise, fall = rise - common.amin(-2).clamp(min=0.0), -rise + common.amax(-2).clamp(max=0.0)
    tinted = _rise_ahead(tint, seen, 1.2 * width).abs() > _RISE
    run = longest_run(on, 0.7 * width)
    reach = 0.5 * width + 3
    low = first_on(place, run) - first_on(place, seen) < reach
    high = last_on(place, seen) - last_on(place, run) < reach
    upwards = torch.where(low == high, rise.amax(-1) > fall.amax(-1), low)
    up, down = on & (rise > _RISE), on & (fall > _RISE)
    # Long medians are as high half a width around the step; short ones say where in this it is.
    step = _rise_ahead(brightness, on, 0.3 * width)
    end, begin = _first_peak(rise + step, up, False), _first_peak(fall - step, down, True)
    neutral_end, neutral_begin = (~tinted.gather(-1, at.long()[..., None])[..., 0] for at in (end, begin))
    return (
        torch.where(~upwards & down.any(-1) & neutral_begin, begin, -torch.inf),
        torch.where(upwards & up.any(-1) & neutral_end, end, torch.inf),
    )


def _rise_ahead(
    value: Float[Tensor, "*b s"], on: Bool[Tensor, "*b s"], reach: Float[Tensor, "*b"]
) -> Float[Tensor, "*b s"]:
    """For every station, how far the median over `reach` stations after it lies above that over those before it.

    Only stations in the mask count; 0 where either side has less than half of its own.
    """
    share = torch.arange(1, 8, device=value.device) / 7.0
    steps = (reach[..., None, None] * share).round().clamp(min=1).long()  # (*b, 1, 7)
    at = torch.arange(value.shape[-1], device=value.device)[:, None]
    known = torch.where(on, value, torch.nan)
    known = known[..., None, :].expand(*known.shape, known.shape[-1])

    def median(index: Tensor) -> tuple[Tensor, Tensor]:
        inside = (index >= 0) & (index < value.shape[-1])
        read = known.gather(-1, index.clamp(0, value.shape[-1] - 1).expand(*known.shape[:-1], 7))
        read = torch.where(inside, read, torch.nan)
        return read.nanmedian(-1).values, torch.isfinite(read).sum(-1) >= 5

    (ahead, known_ahead), (behind, known_behind) = median(at + steps), median(at - steps)
    return torch.where(known_ahead & known_behind, ahead - behind, 0.0)


def _first_peak(value: Float[Tensor, "*b s"], on: Bool[Tensor, "*b s"], from_high: bool) -> Float[Tensor, "*b"]:
    """Station of the largest value in the first run of the mask, or in the last one."""
    if from_high:
        return value.shape[-1] - 1 - _first_peak(value.flip(-1), on.flip(-1), False)
    label = on & ((~on).cumsum(-1) == torch.where(on, (~on).cumsum(-1), value.shape[-1]).amin(-1, keepdim=True))
    return torch.where(label, value, -torch.inf).argmax(-1).to(value.dtype)
