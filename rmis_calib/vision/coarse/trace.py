"""Follow both contours of the best strips, station by station on the small picture, and find what is shaft.

The search for strips assumes straight lines; here each contour may wander by a fifth of the shaft's width, so that a
lens whose distortion nobody measured, or a bent shaft, does not lose the far end.
"""

from dataclasses import dataclass, replace

import torch
from jaxtyping import Bool, Float
from torch import Tensor

from rmis_calib.vision.coarse.borders import enter, enters_high, through_the_dark, ways
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
class Course:
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
    start_at_border: Bool[Tensor, "b k"]
    end_at_border: Bool[Tensor, "b k"]
    """Whether the shaft leaves the field of view at its start and at its end."""
    width: Float[Tensor, "b k"]
    """Median width, px."""


@dataclass(frozen=True, eq=False)
class Trace(Course):
    """What else is told of a strip that may be a shaft."""

    end: Float[Tensor, "b k"]
    """Last station of the last stretch long enough to carry the shaft's end, px."""
    closed: Bool[Tensor, "b k"]
    """Between its start and the border something brighter shows: it does not come from there, or is covered."""
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


@dataclass(frozen=True, eq=False)
class _Walk:
    """Strips walked from the lowest station to the highest."""

    profiles: StripProfiles
    strips: Strips
    stretch: _Stretch
    borders: tuple[Bool[Tensor, "b k"], Bool[Tensor, "b k"]]
    """Whether the shaft reaches the low, the high border."""
    closed: Bool[Tensor, "b k 2"]
    """Whether something brighter lies before that border."""
    turn: Bool[Tensor, "b k"]
    """Whether the shaft enters on the high side."""


def trace(picture: SmallPicture, strips: Strips, settings: DetectorSettings) -> Trace:
    """Contours, the stretch that is a shaft, which way the tip is, and what tells shafts from what is none."""
    walked = _walk(picture, strips, settings)
    profiles, stretch, turn = walked.profiles, walked.stretch, walked.turn
    low_end, high_end = _ends(profiles, strips, stretch, settings)
    tint = masked_median(profiles.middle.tint, stretch.main)
    return Trace(
        **vars(_towards_tip(walked, settings.min_contrast)),
        end=torch.where(turn, -low_end, high_end),
        closed=torch.where(turn, walked.closed[..., 1], walked.closed[..., 0]),
        length=stretch.on.float().sum(-1) * profiles.spacing,
        contrast=masked_median(torch.where(torch.isfinite(profiles.step), profiles.step, 0.0), stretch.on),
        tint=tint,
        evenness=evenness(profiles, tint, stretch.main),
        surround=stretch.surround,
    )


def walk(picture: SmallPicture, strips: Strips, settings: DetectorSettings) -> Course:
    """The first part of `trace`."""
    return _towards_tip(_walk(picture, strips, settings), settings.min_contrast)


def straighten(course: Course) -> tuple[Strips, Float[Tensor, "b k"]]:
    """The strips with straight lines through their traced contours, and how far these wander from them, px."""
    t, main = course.t.expand_as(course.lateral), course.main[:, :, None].expand_as(course.lateral)
    spacing = float(course.t[1] - course.t[0])
    tolerance = (_TOLERANCE * course.width).clamp(min=0.3 * spacing)[..., None].expand_as(course.strips.offset)
    line = fit_lines(t, course.lateral, course.sides.to(t.dtype), main, tolerance, 0.1 * spacing)
    both = ((line.inliers > 5) & (line.slope.abs() < 0.2)).all(-1, keepdim=True)
    before = course.strips
    offset, slope = torch.where(both, line.offset, before.offset), torch.where(both, line.slope, before.slope)
    wander = torch.where(both[..., 0], line.scatter_px.amax(-1), 0.05 * course.width)
    return replace(before, offset=offset, slope=slope), wander


def _walk(picture: SmallPicture, strips: Strips, settings: DetectorSettings) -> _Walk:
    """Follow both contours; find what is shaft, where it enters, and where it goes on though nothing shows it."""
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
    stretch = stretch.with_also(to_border)
    return _Walk(profiles, strips, stretch, borders, closed, enters_high(t, stretch.on, seen, borders))


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


def _towards_tip(walked: _Walk, min_contrast: float) -> Course:
    """The walk from the border inwards: turned round where the shaft enters on the high side."""
    t, on, main, (low, high) = walked.profiles.t, walked.stretch.on, walked.stretch.main, walked.borders
    sides = on[:, :, None] & walked.profiles.sides.seen
    line = walked.strips.contour(t.expand_as(on))
    lateral = line + smooth_over(walked.profiles.sides.lateral - line, sides)
    sides &= walked.profiles.sides.rise > min_contrast
    turn, stations, both = walked.turn, walked.turn[..., None], walked.turn[..., None, None]
    return Course(
        strips=walked.strips.reverse(turn),
        t=t,
        main=torch.where(stations, main.flip(-1), main),
        on=torch.where(stations, on.flip(-1), on),
        sides=torch.where(both, sides.flip(2).flip(3), sides),
        lateral=torch.where(both, -lateral.flip(2).flip(3), lateral),
        start=torch.where(turn, -last_on(t, on), first_on(t, on)),
        start_at_border=torch.where(turn, high, low),
        end_at_border=torch.where(turn, low, high),
        width=walked.stretch.width,
    )
