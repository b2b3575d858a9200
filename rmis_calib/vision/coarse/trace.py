"""Follow both contours of the best strips, station by station on the small picture, and find what is shaft.

The search for strips assumes straight lines; here each contour may wander by a fifth of the shaft's width, so that a
lens whose distortion nobody measured, or a bent shaft, does not lose the far end.
"""

from dataclasses import dataclass, replace

import torch
from jaxtyping import Bool, Float
from torch import Tensor

from rmis_calib.vision.coarse.appearance import weighted_tint
from rmis_calib.vision.coarse.borders import enter, through_the_dark, ways
from rmis_calib.vision.coarse.contour_profiles import AxisProfile, ContourProfiles, follow, read_middle
from rmis_calib.vision.coarse.scoring import MAX_BRIGHTER
from rmis_calib.vision.coarse.strips import SmallPicture, Strips
from rmis_calib.vision.coarse.wrists import between_wrists
from rmis_calib.vision.image.line_fit import fit_lines
from rmis_calib.vision.image.run_length import (
    bridge,
    first_on,
    last_on,
    longest_run,
    masked_median,
    masked_quantile,
    run_any,
    run_lengths,
    run_minimum,
    run_range,
    smooth_over,
)
from rmis_calib.vision.settings import DetectorSettings

_STATIONS = 160
# Where between shaft (0) and surroundings (1) the inside may lie. Wrists of bare metal lie at 0.5 to 0.7, shaded shafts
# below 0.35, a stretch of shaft lit differently beyond an interruption at up to 0.6 (frames of both real sets).
_TONE_SHARE = 0.38
_RUN_SHARE = 0.6
_CONTRAST_SHARE = 0.8
# Log brightness, with tint, within which the inside is the shaft's own though its contours are not seen: half of what
# tells blood and tissue from it.
_SAME_TONE = 0.35
# Largest change of tone over three stations of a plain shaft; its screws and jaws change by more.
_RUN_UNEVENNESS = 0.45
# Share of the width by which a small contour point that is not astray may lie off its line.
_TOLERANCE = 0.02
# Step of tint, as it enters the dark view, from which tissue is told from what has no colour.
_TINTED = 0.15


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
    """Step of tint across the weaker contour over that across the stronger one, 0 to 1; 1 where nothing is tinted."""
    surround: Float[Tensor, "b k"]
    """How far the surroundings lie above the shaft's own tone."""


def trace(picture: SmallPicture, strips: Strips, settings: DetectorSettings) -> Trace:
    """Contours, the stretch that is a shaft, and which way the tip is."""
    t = torch.linspace(-1, 1, _STATIONS, device=strips.offset.device) * picture.half_diagonal_px
    spacing = float(t[1] - t[0])
    stations = t.expand(*strips.valid.shape, _STATIONS)
    sides = follow(picture, strips, stations)
    middle = read_middle(picture, strips, stations, sides)
    span = sides.lateral[:, :, 0] - sides.lateral[:, :, 1]
    step = torch.where(sides.seen, sides.rise, torch.inf).amin(2)
    outer = torch.where(sides.seen, sides.outer, torch.inf).amin(2)
    edged = middle.seen & sides.seen.any(2) & strips.valid[..., None]
    edged &= span > settings.min_width_fraction * picture.width_px
    edged &= middle.brightness - sides.brightness.mean(2) < MAX_BRIGHTER
    edged &= (step > settings.min_contrast) & (middle.inner < outer - 0.5 * settings.min_contrast)
    begins, ends = (at * spacing + t[0] for at in _plain_stretch(middle, sides, edged, span / spacing))
    before = (t >= begins[..., None]) & (t <= ends[..., None])
    edged, possible = edged & before, middle.seen & before
    surround = masked_median(torch.where(edged, outer, 0.0) - middle.inner, edged)
    on = edged & _own_tone(middle.inner, outer, edged, edged)
    width = masked_median(span, on & sides.seen.all(2))
    on &= run_lengths(on) * spacing > (0.4 * width).clamp(min=2.5 * spacing)[..., None]
    main = longest_run(on, 0.7 * width / spacing)
    lit = picture.lit(strips)[..., None]
    own = torch.where(lit, middle.inner, middle.brightness + middle.tint)
    same_tone = torch.where(lit[..., 0], (0.5 * surround).clamp(max=_SAME_TONE), _SAME_TONE)
    beside = masked_median(sides.brightness.mean(2), middle.seen)[..., None]
    possible &= middle.brightness - beside < MAX_BRIGHTER  # white plastic and metal are as neutral as a shaft
    joined = _joined(t, own, same_tone, edged, on, main, possible, middle.seen, width)
    on, main = on | joined, main | joined
    to_border, borders = enter(t, edged | joined, main, middle.seen, width)
    way = ways(t, on, middle.seen)
    brighter = own > (masked_median(own, edged) + same_tone)[..., None]
    closed = (way & brighter[:, :, None]).sum(-1) > 1
    borders = through_the_dark(way, closed, on, borders)
    on, main = on | to_border, main | to_border
    line = strips.contour(stations)
    wander = smooth_over(sides.lateral - line, (on[:, :, None] & sides.seen))
    carries_end = _carries_end(middle, on & strips.valid[..., None], main, width / spacing, settings)
    down, up = (_same_tone(t, middle.inner, main, middle.seen, surround, width, high) for high in (False, True))
    tint = masked_median(middle.tint, main)
    whole = Trace(
        strips=strips,
        t=t,
        main=main,
        on=on,
        sides=on[:, :, None] & sides.seen & (sides.rise > settings.min_contrast),
        lateral=line + wander,
        start=first_on(t, on),
        end=torch.where(torch.isfinite(ends), ends, last_on(t, carries_end | up)),
        start_at_border=borders[0],
        end_at_border=borders[1],
        closed=closed[..., 0],
        width=width,
        length=on.float().sum(-1) * spacing,
        contrast=masked_median(torch.where(torch.isfinite(step), step, 0.0), on),
        tint=tint,
        evenness=_evenness(weighted_tint(sides.outer, sides.brightness, picture.lit(strips)), tint, main),
        surround=surround,
    )
    low_end = torch.where(torch.isfinite(begins), begins, first_on(t, carries_end | down))
    return _towards_tip(whole, low_end, last_on(t, on), closed[..., 1], t, middle.seen)


def _plain_stretch(
    middle: AxisProfile, sides: ContourProfiles, edged: Bool[Tensor, "b k s"], span: Float[Tensor, "b k s"]
) -> tuple[Float[Tensor, "b k"], Float[Tensor, "b k"]]:
    """First and last station before a wrist; infinite where there is none, or nothing is left before it.

    Of a shaft that hardly enters the picture the wrist shows more than the shaft does: then it has to serve.
    """
    width = masked_median(span, edged)
    begins, ends = between_wrists(middle.brightness, middle.tint, sides.brightness, edged, middle.seen, width)
    place = torch.arange(edged.shape[-1], device=edged.device)
    before = (place >= begins[..., None]) & (place <= ends[..., None])
    enough = (edged & before & sides.seen.all(2)).sum(-1) > width
    return torch.where(enough, begins, -torch.inf), torch.where(enough, ends, torch.inf)


def _joined(
    t: Float[Tensor, " s"],
    inner: Float[Tensor, "b k s"],
    same_tone: Float[Tensor, "b k"],
    edged: Bool[Tensor, "b k s"],
    on: Bool[Tensor, "b k s"],
    main: Bool[Tensor, "b k s"],
    possible: Bool[Tensor, "b k s"],
    seen: Bool[Tensor, "b k s"],
    width: Float[Tensor, "b k"],
) -> Bool[Tensor, "b k s"]:
    """Stations between contoured stretches, or between one and the border, at which the inside keeps its tone.

    A dark cavity behind a shaft, or a film of blood on it, takes its contours away and not the shaft.
    """
    step = t[1] - t[0]
    level = masked_median(inner, edged)[..., None]
    same = possible & ((inner - level).abs() < same_tone[..., None])
    run = run_any(bridge(on | same, 0.5 * width / step) & possible, main)
    reach = 0.5 * width + 3 * step
    low = first_on(t, run) - first_on(t, seen) < reach
    high = last_on(t, seen) - last_on(t, run) < reach
    first, last = first_on(t, on & run), last_on(t, on & run)
    from_low = (low & ~high)[..., None] | (t >= first[..., None])
    from_high = (high & ~low)[..., None] | (t <= last[..., None])
    return run & from_low & from_high


def _evenness(
    beside: Float[Tensor, "b k 2 s"], tint: Float[Tensor, "b k"], main: Bool[Tensor, "b k s"]
) -> Float[Tensor, "b k"]:
    """`Trace.evenness`: between a contour and a stripe of glare, only one side is tissue.

    Args:
        beside: tint just outside of either contour.
        tint: of the inside.
        main: stations that count.
    """
    step = masked_median(beside, main[:, :, None].expand_as(beside)) - tint[..., None]
    weaker, stronger = step.amin(-1), step.amax(-1)
    return torch.where(stronger > _TINTED, (weaker / stronger.clamp(min=_TINTED)).clamp(0.0, 1.0), 1.0)


def _carries_end(
    middle: AxisProfile,
    on: Bool[Tensor, "b k s"],
    main: Bool[Tensor, "b k s"],
    width: Float[Tensor, "b k"],
    settings: DetectorSettings,
) -> Bool[Tensor, "b k s"]:
    """Stations among which the shaft's end is: those of stretches long enough, or else of the longest.

    The end may lie on a stretch whose contours do not continue the lines (a sleeve, a lens that bends them). There it
    is enough that the inside has the shaft's tone and both sides, most of a width away, do not; and only beyond an
    interruption, such as a ball: a wrist follows the shaft at once and is darker than tissue as well.

    Args:
        middle: tones along the middle line.
        on: stations with contours.
        main: the longest stretch of them.
        width: width of the shaft, in stations.
        settings: shortest stretch that counts, least contrast.
    """
    inner, far = middle.inner, middle.far
    darker = middle.seen & torch.isfinite(far) & (inner < far - settings.min_contrast)
    beyond = darker & ~run_any(bridge(darker | on, 0.3 * width), main)
    band = on | (beyond & (run_range(inner) < _RUN_UNEVENNESS) & _own_tone(inner, far, beyond, on))
    long_runs = band & (run_lengths(band) > settings.end_run_widths * width[..., None] - 1)
    return torch.where(long_runs.any(-1, keepdim=True), long_runs, main)


def _same_tone(
    t: Float[Tensor, " s"],
    inner: Float[Tensor, "b k s"],
    main: Bool[Tensor, "b k s"],
    seen: Bool[Tensor, "b k s"],
    surround: Float[Tensor, "b k"],
    width: Float[Tensor, "b k"],
    high: bool,
) -> Bool[Tensor, "b k s"]:
    """Stations beyond the contoured stretch, on its high or low side, at which the inside keeps its tone.

    Before a dark cavity, under blood or a shadow a shaft loses its contours but not its own tone.
    """
    step = t[1] - t[0]
    last = (last_on if high else first_on)(t, main)[..., None]
    distance = t - last if high else last - t
    tone = masked_median(inner, main & (distance > -6 * step))
    same = seen & (inner < (tone + _TONE_SHARE * surround.clamp(min=0.2))[..., None])
    reached = run_any(bridge(same | main, 0.3 * width / step), main & (distance > -2 * step))
    return reached & same & (distance > 0)


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


def _own_tone(
    inner: Float[Tensor, "b k s"],
    outer: Float[Tensor, "b k s"],
    on: Bool[Tensor, "b k s"],
    known: Bool[Tensor, "b k s"],
) -> Bool[Tensor, "b k s"]:
    """Stations whose inside is still the shaft and not the metal of the wrist, which has contours too.

    Where light falls off along the shaft, its contrast to the surroundings stays; where the background changes, its
    tone stays; a wrist keeps neither. Another stretch of shaft beyond an interruption may be lit differently, so each
    unbroken run is compared with its own darkest part, and only that with what is `known` of the shaft.
    """
    contrast = torch.where(on, outer - inner, 0.0)
    usual = masked_quantile(contrast, known, 0.75)[..., None]
    darkest = run_minimum(inner, on)
    tone = masked_quantile(inner, known, 0.25)[..., None]
    same_shaft = darkest < tone + _RUN_SHARE * (outer - tone)
    steady = (inner < darkest + _TONE_SHARE * (outer - darkest)) | (contrast > _CONTRAST_SHARE * usual)
    return same_shaft & steady


def _towards_tip(
    low_to_high: Trace,
    low_end: Float[Tensor, "b k"],
    high_start: Float[Tensor, "b k"],
    high_closed: Bool[Tensor, "b k"],
    t: Tensor,
    seen: Tensor,
) -> Trace:
    """The trace walked from the border inwards: turned round where the shaft enters on the high side."""
    low, high = low_to_high.start_at_border, low_to_high.end_at_border
    low_gap = low_to_high.start - first_on(t, seen)
    high_gap = last_on(t, seen) - high_start
    flip = (high & ~low) | ((high == low) & (high_gap < low_gap))
    turn = flip[..., None]
    lateral = torch.where(turn[..., None], -low_to_high.lateral.flip(2).flip(3), low_to_high.lateral)
    return replace(
        low_to_high,
        strips=low_to_high.strips.reverse(flip),
        main=torch.where(turn, low_to_high.main.flip(-1), low_to_high.main),
        on=torch.where(turn, low_to_high.on.flip(-1), low_to_high.on),
        sides=torch.where(turn[..., None], low_to_high.sides.flip(2).flip(3), low_to_high.sides),
        lateral=lateral,
        start=torch.where(flip, -high_start, low_to_high.start),
        end=torch.where(flip, -low_end, low_to_high.end),
        start_at_border=torch.where(flip, high, low),
        end_at_border=torch.where(flip, low, high),
        closed=torch.where(flip, high_closed, low_to_high.closed),
    )
