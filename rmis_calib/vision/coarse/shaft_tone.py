"""Where along a strip the inside keeps the shaft's own tone: under blood, in the dark, before a wrist."""

from dataclasses import dataclass

import torch
from jaxtyping import Bool, Float
from torch import Tensor

from rmis_calib.vision.coarse.appearance import weighted_tint
from rmis_calib.vision.coarse.borders import reached_borders
from rmis_calib.vision.coarse.contour_profiles import StripProfiles
from rmis_calib.vision.image.run_length import (
    bridge,
    first_on,
    last_on,
    masked_median,
    masked_quantile,
    run_any,
    run_lengths,
    run_minimum,
    run_range,
)

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
# Step of tint, as it enters the dark view, from which tissue is told from what has no colour.
_TINTED = 0.15


@dataclass(frozen=True, eq=False)
class OwnTone:
    """How the inside compares with the shaft's own tone."""

    off: Float[Tensor, "b k s"]
    """Distance from it, log brightness with tint; positive where brighter."""
    tolerance: Float[Tensor, "b k 1"]
    """Within which it is the same."""

    @property
    def same(self) -> Bool[Tensor, "b k s"]:
        """Stations that have it."""
        return self.off.abs() < self.tolerance

    @property
    def brighter(self) -> Bool[Tensor, "b k s"]:
        """Stations at which something brighter shows."""
        return self.off > self.tolerance


def measure_tone(profiles: StripProfiles, contoured: Bool[Tensor, "b k s"], surround: Float[Tensor, "b k"]) -> OwnTone:
    """The inside against its median over the stations with contours.

    Args:
        profiles: of the strips.
        contoured: stations with contours.
        surround: how far the surroundings lie above the shaft.
    """
    middle, lit = profiles.middle, profiles.lit[..., None]
    tone = torch.where(lit, middle.inner, middle.brightness + middle.tint)
    tolerance = torch.where(lit, (0.5 * surround[..., None]).clamp(max=_SAME_TONE), _SAME_TONE)
    return OwnTone(tone - masked_median(tone, contoured)[..., None], tolerance)


def own_tone(
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


def covered(
    profiles: StripProfiles,
    tone: OwnTone,
    on: Bool[Tensor, "b k s"],
    main: Bool[Tensor, "b k s"],
    possible: Bool[Tensor, "b k s"],
    width: Float[Tensor, "b k"],
) -> Bool[Tensor, "b k s"]:
    """Stations between contoured stretches, or between one and the border, at which the inside keeps its tone.

    A dark cavity behind a shaft, or a film of blood on it, takes its contours away and not the shaft.
    """
    t = profiles.t
    same = possible & tone.same
    run = run_any(bridge(on | same, 0.5 * width / profiles.spacing) & possible, main)
    low, high = reached_borders(t, run, profiles.seen, width)
    first, last = first_on(t, on & run), last_on(t, on & run)
    from_low = (low & ~high)[..., None] | (t >= first[..., None])
    from_high = (high & ~low)[..., None] | (t <= last[..., None])
    return run & from_low & from_high


def keeps_tone_beyond(
    profiles: StripProfiles,
    main: Bool[Tensor, "b k s"],
    surround: Float[Tensor, "b k"],
    width: Float[Tensor, "b k"],
    high: bool,
) -> Bool[Tensor, "b k s"]:
    """Stations beyond the contoured stretch, on its high or low side, at which the inside keeps its tone.

    Before a dark cavity, under blood or a shadow a shaft loses its contours but not its own tone.
    """
    t, step, inner = profiles.t, profiles.spacing, profiles.middle.inner
    last = (last_on if high else first_on)(t, main)[..., None]
    distance = t - last if high else last - t
    tone = masked_median(inner, main & (distance > -6 * step))
    same = profiles.seen & (inner < (tone + _TONE_SHARE * surround.clamp(min=0.2))[..., None])
    reached = run_any(bridge(same | main, 0.3 * width / step), main & (distance > -2 * step))
    return reached & same & (distance > 0)


def carries_end(
    profiles: StripProfiles,
    on: Bool[Tensor, "b k s"],
    main: Bool[Tensor, "b k s"],
    width: Float[Tensor, "b k"],
    min_contrast: float,
    run_widths: float,
) -> Bool[Tensor, "b k s"]:
    """Stations among which the shaft's end is: those of stretches long enough, or else of the longest.

    The end may lie on a stretch whose contours do not continue the lines (a sleeve, a lens that bends them). There it
    is enough that the inside has the shaft's tone and both sides, most of a width away, do not; and only beyond an
    interruption, such as a ball: a wrist follows the shaft at once and is darker than tissue as well.

    Args:
        profiles: of the strips.
        on: stations with contours.
        main: the longest stretch of them.
        width: of the shaft, px.
        min_contrast: least step to the sides.
        run_widths: shortest stretch that counts, widths.
    """
    inner, far, width = profiles.middle.inner, profiles.middle.far, width / profiles.spacing
    darker = profiles.seen & torch.isfinite(far) & (inner < far - min_contrast)
    beyond = darker & ~run_any(bridge(darker | on, 0.3 * width), main)
    band = on | (beyond & (run_range(inner) < _RUN_UNEVENNESS) & own_tone(inner, far, beyond, on))
    long_runs = band & (run_lengths(band) > run_widths * width[..., None] - 1)
    return torch.where(long_runs.any(-1, keepdim=True), long_runs, main)


def evenness(profiles: StripProfiles, tint: Float[Tensor, "b k"], main: Bool[Tensor, "b k s"]) -> Float[Tensor, "b k"]:
    """Step of tint across the weaker contour over that across the stronger one, 0 to 1; 1 where nothing is tinted.

    Between a contour and a stripe of glare, only one side is tissue.

    Args:
        profiles: of the strips.
        tint: of the inside.
        main: stations that count.
    """
    beside = weighted_tint(profiles.sides.outer, profiles.sides.brightness, profiles.lit)
    step = masked_median(beside, main[:, :, None].expand_as(beside)) - tint[..., None]
    weaker, stronger = step.amin(-1), step.amax(-1)
    return torch.where(stronger > _TINTED, (weaker / stronger.clamp(min=_TINTED)).clamp(0.0, 1.0), 1.0)
