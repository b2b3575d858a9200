"""Where a wrist of bright metal follows a shaft along a strip, for any leading batch."""

import torch
from jaxtyping import Bool, Float
from torch import Tensor
from torch.nn.functional import pad

from rmis_calib.vision.coarse.borders import reached_borders
from rmis_calib.vision.image.run_length import longest_run, lowest

# Log brightness: metal is two to three times as bright as the shaft before it (0.7 to 1.1) on the rendered pictures,
# and half of that in the da Vinci and grasper frames; light along a shaft changes by less over a width.
_RISE = 0.3
# Stations read on either side of each.
_READ = 7


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
    # Long medians are as high half a width around the step; short ones (the last) say where in this it is.
    values = torch.stack([brightness, *beside.unbind(-2), tint, brightness], -2)
    masks = torch.stack([on, on, on, seen, on], -2)
    reach = width[..., None] * width.new_tensor([0.8, 0.8, 0.8, 1.2, 0.3])
    rise, left, right, tinted, step = _rise_ahead(values, masks, reach).unbind(-2)
    # Towards the light, as from a vignette, both sides grow brighter as well.
    rise, fall = rise - torch.minimum(left, right).clamp(min=0.0), -rise + torch.maximum(left, right).clamp(max=0.0)
    tinted = tinted.abs() > _RISE
    run = longest_run(on, 0.7 * width)
    low, high = reached_borders(place, run, seen, width)
    upwards = torch.where(low == high, rise.amax(-1) > fall.amax(-1), low)
    up, down = on & (rise > _RISE), on & (fall > _RISE)
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
    share = torch.arange(1, _READ + 1, device=value.device) / _READ
    steps = (reach[..., None] * share).round().clamp(min=1).long()  # (*b, 7)
    steps = torch.cat([steps, -steps], -1)[..., None]
    count = value.shape[-1]
    known = pad(torch.where(on, value, torch.inf), (1, 1), value=torch.inf)
    at = (torch.arange(1, count + 1, device=value.device) + steps).clamp(0, count + 1)
    read = known.gather(-1, at.flatten(-2)).unflatten(-1, (2, _READ, count))
    ahead, behind = _known_median(read.movedim(-2, 0)).unbind(-2)
    return torch.where(torch.isfinite(ahead) & torch.isfinite(behind), ahead - behind, 0.0)


def _known_median(values: Float[Tensor, "7 *b s"]) -> Float[Tensor, "*b s"]:
    """The lower median of the finite ones of seven; infinite where less than five are."""
    *_, third, fourth, fifth = lowest(values, 5)
    return torch.where(torch.isfinite(fifth), torch.where(torch.isfinite(values.amax(0)), fourth, third), torch.inf)


def _first_peak(value: Float[Tensor, "*b s"], on: Bool[Tensor, "*b s"], from_high: bool) -> Float[Tensor, "*b"]:
    """Station of the largest value in the first run of the mask, or in the last one."""
    if from_high:
        return value.shape[-1] - 1 - _first_peak(value.flip(-1), on.flip(-1), False)
    label = on & ((~on).cumsum(-1) == torch.where(on, (~on).cumsum(-1), value.shape[-1]).amin(-1, keepdim=True))
    return torch.where(label, value, -torch.inf).argmax(-1).to(value.dtype)
