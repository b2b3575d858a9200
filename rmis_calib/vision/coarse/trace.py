"""Follow both contours of the best strips, station by station on the small picture, and find what is shaft.

The search for strips assumes straight lines; here each contour may wander by a fifth of the shaft's width, so that a
lens whose distortion nobody measured, or a bent shaft, does not lose the far end.
"""

from dataclasses import dataclass, replace

import torch
from jaxtyping import Bool, Float
from torch import Tensor

from rmis_calib.vision.coarse.borders import enter, through_the_dark, ways
from rmis_calib.vision.coarse.contour_profiles import StripProfiles, read_profiles
from rmis_calib.vision.coarse.scoring import MAX_BRIGHTER
from rmis_calib.vision.coarse.shaft_tone import (
    carries_end,
    covered,
    evenness,
    keeps_tone_beyond,
    measure_tone,
    own_tone,
)
from rmis_calib.vision.coarse.strips import SmallPicture, Strips
from rmis_calib.vision.coarse.wrists import between_wrists
from rmis_calib.vision.image.line_fit import fit_lines
from rmis_calib.vision.image.run_length import (
    first_on,
    last_on,
    longest_run,
    masked_median,
    run_lengths,
    smooth_over,
)
from rmis_calib.vision.settings import DetectorSettings

# Share of the width by which a small contour point that is not astray may lie off its line.
_TOLERANCE = 0.02


@dataclass(frozen=True, eq=False)
class Trace:
    """Strips turned to run towards the tip, and where their contours were seen."""

    strips: Strips
    t: Float[Tensor, " s"]
    """Stations, px, rising towards the tip."""
    main: Bool[Tensor, "b k s"]
    """The longest unbroken stretch of `on`."""
    on: Bool[Tensor, "b k s"]
    """At least one contour is seen, no seen one is missing, and the inside has the shaft's own tone."""
    sides: Bool[Tensor, "b k 2 s"]
    """`on`, and this contour is in the field of view."""
    lateral: Float[Tensor, "b k 2 s"]
    """Lateral place of [left, right] contour, px, smooth along the shaft."""
    start: Float[Tensor, "b k"]
    """First station of the shaft, px."""
    end: Float[Tensor, "b k"]
    """Last station of the last stretch long enough to carry the shaft's end, px."""
    start_at_border: Bool[Tensor, "b k"]
    end_at_border: Bool[Tensor, "b k"]
    """Whether the shaft leaves the field of view at its start and at its end."""
    closed: Bool[Tensor, "b k"]
    """Between its start and the border something brighter shows: it does not come from there, or is covered."""
    width: Float[Tensor, "b k"]
    """Median width, px."""
    length: Float[Tensor, "b k"]
    """Supported length, px."""
    contrast: Float[Tensor, "b k"]
    """Median over the shaft of the weaker contour's step, log brightness and tint."""
    tint: Float[Tensor, "b k"]
    """Median over the shaft of the inside's tint, as it enters the dark view."""
    evenness: Float[Tensor, "b k"]
    """`shaft_tone.evenness`."""
    surround: Float[Tensor, "b k"]
    """How far the surroundings lie above the shaft's own tone."""


@dataclass(frozen=True, eq=False)
class _Stretch:
    """Which stations of each strip are shaft; low and high are the sides of the lowest and the highest station."""

    on: Bool[Tensor, "b k s"]
    main: Bool[Tensor, "b k s"]
    """As in `Trace`."""
    contoured: Bool[Tensor, "b k s"]
    """Stations with contours, of whatever tone, up to a wrist."""
    width: Float[Tensor, "b k"]
    surround: Float[Tensor, "b k"]
    """As in `Trace`."""
    wrists: tuple[Float[Tensor, "b k"], Float[Tensor, "b k"]]
    """Where a wrist ends the shaft on the low and the high side; infinite where none does."""

    def with_also(self, more: Bool[Tensor, "b k s"]) -> "_Stretch":
        """Longer by some stations."""
        return replace(self, on=self.on | more, main=self.main | more)


def trace(picture: SmallPicture, strips: Strips, settings: DetectorSettings) -> Trace:
    """Contours, the stretch that is a shaft, and which way the tip is."""
    profiles = read_profiles(picture, strips)
    t, seen = profiles.t, profiles.seen
    stretch = _contoured_stretch(profiles, strips, settings.min_width_fraction * picture.width_px, settings)
    tone = measure_tone(profiles, stretch.contoured, stretch.surround)
    hidden = covered(profiles, tone, stretch.on, stretch.main, _may_be_shaft(profiles, stretch), stretch.width)
    stretch = stretch.with_also(hidden)
    to_border, borders = enter(t, stretch.contoured | hidden, stretch.main, seen, stretch.width)
    way = ways(t, stretch.on, seen)
    closed = (way & tone.brighter[:, :, None]).sum(-1) > 1
    borders = through_the_dark(way, closed, stretch.on, borders)
    return _towards_tip(profiles, strips, stretch.with_also(to_border), borders, closed, settings)


def _contoured_stretch(
    profiles: StripProfiles, strips: Strips, narrowest_px: float, settings: DetectorSettings
) -> _Stretch:
    """Where contours are there and the inside is the shaft's own, in stretches long enough to count."""
    inner, outer, spacing = profiles.middle.inner, profiles.outer, profiles.spacing
    contoured = profiles.seen & profiles.sides.seen.any(2) & strips.valid[..., None] & (profiles.span > narrowest_px)
    contoured &= profiles.brighter < MAX_BRIGHTER
    contoured &= (profiles.step > settings.min_contrast) & (inner < outer - 0.5 * settings.min_contrast)
    wrists = _wrists(profiles, contoured)
    contoured &= _between(profiles.t, wrists)
    surround = masked_median(torch.where(contoured, outer, 0.0) - inner, contoured)
    on = contoured & own_tone(inner, outer, contoured, contoured)
    width = masked_median(profiles.span, on & profiles.sides.seen.all(2))
    on &= run_lengths(on) * spacing > (0.4 * width).clamp(min=2.5 * spacing)[..., None]
    return _Stretch(on, longest_run(on, 0.7 * width / spacing), contoured, width, surround, wrists)


def _wrists(
    profiles: StripProfiles, contoured: Bool[Tensor, "b k s"]
) -> tuple[Float[Tensor, "b k"], Float[Tensor, "b k"]]:
    """First and last station before a wrist, px; infinite where there is none, or nothing is left before it.

    Of a shaft that hardly enters the picture the wrist shows more than the shaft does: then it has to serve.
    """
    middle, sides, span = profiles.middle, profiles.sides, profiles.span / profiles.spacing
    width = masked_median(span, contoured)
    found = between_wrists(middle.brightness, middle.tint, sides.brightness, contoured, middle.seen, width)
    before = _between(torch.arange(contoured.shape[-1], device=contoured.device), found)
    enough = (contoured & before & sides.seen.all(2)).sum(-1) > width
    first, last = (at * profiles.spacing + profiles.t[0] for at in found)
    return torch.where(enough, first, -torch.inf), torch.where(enough, last, torch.inf)


def _between(t: Tensor, limits: tuple[Float[Tensor, "b k"], Float[Tensor, "b k"]]) -> Bool[Tensor, "b k s"]:
    """Stations from the one limit to the other."""
    return (t >= limits[0][..., None]) & (t <= limits[1][..., None])


def _may_be_shaft(profiles: StripProfiles, stretch: _Stretch) -> Bool[Tensor, "b k s"]:
    """Stations before a wrist and not much brighter than what lies beside: white plastic and metal are as neutral as a
    shaft."""
    beside = masked_median(profiles.sides.brightness.mean(2), profiles.seen)[..., None]
    dark = profiles.middle.brightness - beside < MAX_BRIGHTER
    return profiles.seen & _between(profiles.t, stretch.wrists) & dark


def _ends(
    profiles: StripProfiles, strips: Strips, stretch: _Stretch, settings: DetectorSettings
) -> tuple[Float[Tensor, "b k"], Float[Tensor, "b k"]]:
    """Where the shaft ends if its tip is on the low side, and if it is on the high side."""
    t, main, width = profiles.t, stretch.main, stretch.width
    on = stretch.on & strips.valid[..., None]
    last = carries_end(profiles, on, main, width, settings.min_contrast, settings.end_run_widths)
    low, high = (keeps_tone_beyond(profiles, main, stretch.surround, width, side) for side in (False, True))
    begins, ends = stretch.wrists
    return (
        torch.where(torch.isfinite(begins), begins, first_on(t, last | low)),
        torch.where(torch.isfinite(ends), ends, last_on(t, last | high)),
    )


def _towards_tip(
    profiles: StripProfiles,
    strips: Strips,
    stretch: _Stretch,
    borders: tuple[Bool[Tensor, "b k"], Bool[Tensor, "b k"]],
    closed: Bool[Tensor, "b k 2"],
    settings: DetectorSettings,
) -> Trace:
    """The stretch walked from the border inwards: turned round where the shaft enters on the high side.

    Args:
        profiles: of the strips.
        strips: between straight lines.
        stretch: what is shaft of them.
        borders: whether it reaches the low, the high border.
        closed: whether something brighter lies before it.
        settings: limits of what carries the end.
    """
    t, seen, on, main, (low, high) = profiles.t, profiles.seen, stretch.on, stretch.main, borders
    low_start, high_start = first_on(t, on), last_on(t, on)
    low_end, high_end = _ends(profiles, strips, stretch, settings)
    low_gap, high_gap = low_start - first_on(t, seen), last_on(t, seen) - high_start
    flip = (high & ~low) | ((high == low) & (high_gap < low_gap))
    sides = on[:, :, None] & profiles.sides.seen
    line = strips.contour(t.expand_as(on))
    lateral = line + smooth_over(profiles.sides.lateral - line, sides)
    sides &= profiles.sides.rise > settings.min_contrast
    turn, turn_both = flip[..., None], flip[..., None, None]
    tint = masked_median(profiles.middle.tint, main)
    return Trace(
        strips=strips.reverse(flip),
        t=t,
        main=torch.where(turn, main.flip(-1), main),
        on=torch.where(turn, on.flip(-1), on),
        sides=torch.where(turn_both, sides.flip(2).flip(3), sides),
        lateral=torch.where(turn_both, -lateral.flip(2).flip(3), lateral),
        start=torch.where(flip, -high_start, low_start),
        end=torch.where(flip, -low_end, high_end),
        start_at_border=torch.where(flip, high, low),
        end_at_border=torch.where(flip, low, high),
        closed=torch.where(flip, closed[..., 1], closed[..., 0]),
        width=stretch.width,
        length=on.float().sum(-1) * profiles.spacing,
        contrast=masked_median(torch.where(torch.isfinite(profiles.step), profiles.step, 0.0), on),
        tint=tint,
        evenness=evenness(profiles, tint, main),
        surround=stretch.surround,
    )


def straighten(traced: Trace) -> tuple[Strips, Float[Tensor, "b k"]]:
    """The strips with straight lines through their traced contours, and how far these wander from them, px."""
    t, main = traced.t.expand_as(traced.lateral), traced.main[:, :, None].expand_as(traced.lateral)
    spacing = float(traced.t[1] - traced.t[0])
    tolerance = (_TOLERANCE * traced.width).clamp(min=0.3 * spacing)[..., None].expand_as(traced.strips.offset)
    line = fit_lines(t, traced.lateral, traced.sides.to(t.dtype), main, tolerance, 0.1 * spacing)
    sane = (line.inliers > 5) & (line.slope.abs() < 0.2)
    both = sane.all(-1, keepdim=True)
    strips = traced.strips
    offset, slope = torch.where(both, line.offset, strips.offset), torch.where(both, line.slope, strips.slope)
    return replace(strips, offset=offset, slope=slope), torch.where(
        both[..., 0], line.scatter_px.amax(-1), 0.05 * traced.width
    )
