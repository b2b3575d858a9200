"""What the small picture says for each strip: where both contours are there and the inside looks like a shaft."""

from dataclasses import dataclass, fields

import torch
from jaxtyping import Bool, Float
from torch import Tensor

from rmis_calib.vision.coarse.appearance import weighted_tint
from rmis_calib.vision.coarse.borders import enters_high, reached_borders
from rmis_calib.vision.coarse.strips import SmallPicture, Strips
from rmis_calib.vision.image.run_length import (
    bridge,
    first_on,
    last_on,
    masked_mean,
    masked_median,
    run_any,
    run_lengths,
    third_lowest,
)
from rmis_calib.vision.settings import DetectorSettings

_STATIONS, _GLANCES = 96, 32
_ALIKE = 12
_INNER, _RIM = 7, 4
MAX_BRIGHTER = 0.5
"""Log brightness by which the inside of a shaft may exceed its surroundings. Slate-grey shafts on dark liver reach 0.3;
white and bare metal instruments, less tinted than tissue as well, start at 0.6."""
# A wrist of bare metal lies about half-way between shaft and tissue (0.5 to 0.7 in both da Vinci and grasper pictures);
# shading along a shaft stays below 0.25.
_SHAFT_SHARE = 0.38
# A column of squares alternates over half of its way, half of one that something hides over a fifth; shafts of the real
# frames and of all presets over less than a twentieth, for the wrist of bare metal over something dark.
_LEAST_ALTERNATION = 0.2


@dataclass(frozen=True, eq=False)
class Evidence:
    """The stretch of each strip that is a shaft, walked from the border of the picture to the tip."""

    strips: Strips
    t: Float[Tensor, " s"]
    """Stations, px."""
    on: Bool[Tensor, "b k s"]
    """Both contours are there and the inside is of the shaft's own tone, in stretches long enough to count."""
    start: Float[Tensor, "b k"]
    """First station of the shaft, px."""
    end: Float[Tensor, "b k"]
    """Last station of the last stretch that is long enough to carry the end, px."""
    start_at_border: Bool[Tensor, "b k"]
    """The shaft enters the field of view here."""
    end_at_border: Bool[Tensor, "b k"]
    """The other end leaves it too: which one is the tip is not known."""
    width: Float[Tensor, "b k"]
    """Mean width, px."""
    length: Float[Tensor, "b k"]
    """Supported length, px."""
    paired_length: Float[Tensor, "b k"]
    """Length along which both contours are in the field of view, px."""
    contrast: Float[Tensor, "b k"]
    """Median over the shaft of the weaker contour's step."""
    purity: Float[Tensor, "b k"]
    """How much of the inside is shaft and how much of the surroundings is not, 0 to 1."""
    alternation: Float[Tensor, "b k"]
    """How much of the way between its first and its last stretch changes tones with what lies beside it, 0 to 1: the
    squares of a chessboard do, and one thing does not."""

    def lies_on(self) -> Bool[Tensor, "b k k"]:
        """Whether the middle of each shaft (first) lies on another (second) that runs the same way."""
        return lies_on(self.strips, 0.5 * (self.start + self.end), self.width)

    def pick(self, index: Tensor) -> "Evidence":
        """The strips with these indices, (b, k') int64."""
        rows = torch.arange(index.shape[0], device=index.device)[:, None]
        own = {f.name: getattr(self, f.name)[rows, index] for f in fields(self) if f.name not in ("strips", "t")}
        return Evidence(strips=self.strips.pick(index), t=self.t, **own)

    def views_together(self, views: int) -> "Evidence":
        """The strips found in the views of one picture, which follow one another as frames, as those of one frame."""

        def join(value: Tensor) -> Tensor:
            return value.unflatten(0, (-1, views)).flatten(1, 2)

        own = {f.name: join(getattr(self, f.name)) for f in fields(self) if f.name not in ("strips", "t")}
        strips = {f.name: join(getattr(self.strips, f.name)) for f in fields(self.strips)}
        return Evidence(strips=Strips(**strips), t=self.t, **own)


@dataclass(frozen=True, eq=False)
class _Profiles:
    inner: Float[Tensor, "b k s"]
    outer: Float[Tensor, "b k s"]
    step: Float[Tensor, "b k s"]
    brighter_side: Float[Tensor, "b k s"]
    purity: Float[Tensor, "b k s"]
    open: Bool[Tensor, "b k s"]
    both: Bool[Tensor, "b k s"]
    seen: Bool[Tensor, "b k s"]
    width: Float[Tensor, "b k s"]


def _profiles(picture: SmallPicture, strips: Strips, t: Float[Tensor, " s"], narrowest_px: float) -> _Profiles:
    """Read inside, just across both contours, and beyond them, at every station."""
    stations = t.expand(*strips.valid.shape, t.shape[0])
    left, right = strips.contour(stations).unbind(2)
    width = left - right
    unit = float(picture.factor)
    half = (0.5 * width - 1.5 * unit).clamp(min=0.25 * unit)
    share = torch.linspace(-1, 1, _INNER, device=t.device)[:, None]
    inner_y = 0.5 * (left + right)[:, :, None] + half[:, :, None] * share
    # Defocus and motion blur make the contours of a wide shaft several small pixels soft.
    near = (0.07 * width).clamp(min=1.5 * unit)
    far = [(0.2 * width).clamp(min=3 * unit), (0.4 * width).clamp(min=5 * unit)]
    around = [left + near, left - near, right + near, right - near, *(left + f for f in far), *(right - f for f in far)]
    lateral = torch.cat([inner_y, torch.stack(around, 2)], 2)  # (b, k, n, s)
    value, seen, tone = picture.read(strips, stations[:, :, None], lateral)
    left_outside, left_inside, right_inside, right_outside = value[:, :, _INNER : _INNER + _RIM].unbind(2)
    # The third darkest of seven: a glare stripe may cover half of the width.
    inner = third_lowest(value[:, :, :_INNER])
    inf = value.new_tensor(torch.inf)
    left_seen, right_seen = (seen[:, :, at] & seen[:, :, at + 1] for at in (_INNER, _INNER + 2))
    step = torch.minimum(
        torch.where(left_seen, left_outside - left_inside, inf),
        torch.where(right_seen, right_outside - right_inside, inf),
    )
    outer = torch.minimum(torch.where(left_seen, left_outside, inf), torch.where(right_seen, right_outside, inf))
    one_side, both_sides = left_seen | right_seen, left_seen & right_seen
    middle = 0.5 * (inner + outer)
    glare = _glare(weighted_tint(value, tone, picture.lit(strips)), tone)
    # Beyond a contour there is neither more shaft nor the glare on it: else the strip is a part of a wider one.
    brighter_side = torch.maximum(left_outside, right_outside)
    open_beyond = torch.maximum(middle, inner + 0.35 * (brighter_side - inner))[:, :, None]
    beyond = slice(_INNER + _RIM, None)
    free = ((value[:, :, beyond] > open_beyond) & ~glare[:, :, beyond]) | ~seen[:, :, beyond]
    own = (value[:, :, :_INNER] < middle[:, :, None]) | glare[:, :, :_INNER]
    purity = own.float().mean(2) * free.float().mean(2)
    centre_seen = seen[:, :, _INNER // 2]
    brighter = third_lowest(tone[:, :, :_INNER]) - 0.5 * (tone[:, :, _INNER] + tone[:, :, _INNER + 3])
    is_open = centre_seen & one_side & (width > narrowest_px) & strips.valid[..., None] & (brighter < MAX_BRIGHTER)
    return _Profiles(inner, outer, step, brighter_side, purity, is_open, both_sides, centre_seen, width)


def _glare(tint: Float[Tensor, "b k n s"], tone: Float[Tensor, "b k n s"]) -> Bool[Tensor, "b k n s"]:
    """Points brighter than the surroundings of the strip that have lost their tint: light reflected by a shaft."""
    left, right = _INNER, _INNER + 3
    tinted = torch.maximum(tint[:, :, left], tint[:, :, right])[:, :, None]
    bright = torch.minimum(tone[:, :, left], tone[:, :, right])[:, :, None]
    return (tint < 0.4 * tinted) & (tone > bright + 0.1) & (tinted > 0.15)


def screen(picture: SmallPicture, strips: Strips, settings: DetectorSettings, count: int) -> Strips:
    """The `count` strips that most look like one at a glance: five points across at 32 stations.

    Votes alone favour long edges of tissue over the short contours of a shaft that just enters the picture. Of strips
    that lie on one another `_ALIKE` go before the others: one plain shaft gives dozens, and would leave no room for a
    second one.
    """
    t = torch.linspace(-1, 1, _GLANCES, device=strips.offset.device) * picture.half_diagonal_px
    stations = t.expand(*strips.valid.shape, _GLANCES)
    left, right = strips.contour(stations).unbind(2)
    width = left - right
    near = (0.1 * width).clamp(min=2.0 * picture.factor)
    middle = 0.5 * (left + right)
    lateral = torch.stack([left + near, middle + 0.25 * width, middle, middle - 0.25 * width, right - near], 2)
    value, seen, _ = picture.read(strips, stations[:, :, None], lateral)
    inner = value[:, :, 1:4].amin(2)
    left_rise = torch.where(seen[:, :, 0], value[:, :, 0] - inner, torch.inf)
    right_rise = torch.where(seen[:, :, 4], value[:, :, 4] - inner, torch.inf)
    rise = torch.minimum(left_rise, right_rise)
    good = seen[:, :, 2] & torch.isfinite(rise) & (width > 0)
    shaft_like = good & (rise > 0.8 * settings.min_contrast)
    look = torch.where(shaft_like, 1.0 + 0.5 * rise.clamp(0.0, 1.0), 0.0).sum(-1)
    look = torch.where(strips.valid, look, -1.0)
    on = lies_on(strips, masked_mean(stations, shaft_like), masked_mean(width, shaft_like))
    rank = look.argsort(dim=1, descending=True, stable=True).argsort(dim=1)
    better = (on | on.mT) & (rank[:, :, None] > rank[:, None])
    look = torch.where(better.sum(-1) < _ALIKE, look, look - 2.0 * _GLANCES)
    return strips.pick(look.topk(min(count, look.shape[1]), dim=1).indices)


def inspect(picture: SmallPicture, strips: Strips, settings: DetectorSettings) -> Evidence:
    """Find the stretch of each strip that is a shaft, and turn the strip so that it runs towards the tip."""
    t = torch.linspace(-1, 1, _STATIONS, device=strips.offset.device) * picture.half_diagonal_px
    spacing = float(t[1] - t[0])
    p = _profiles(picture, strips, t, settings.min_width_fraction * picture.width_px)
    on = p.open & (p.step > settings.min_contrast) & (p.inner < p.outer - 0.5 * settings.min_contrast)
    tone = masked_median(p.inner, on)
    surround = masked_median(p.outer, on)
    edged = on
    on = on & (p.inner < (tone + _SHAFT_SHARE * (surround - tone).clamp(min=0.0))[..., None])
    width = masked_mean(p.width, on)
    length = run_lengths(on) * spacing
    on &= length > (0.5 * width).clamp(min=2.5 * spacing)[..., None]
    carries_end = on & (length > settings.end_run_widths * width[..., None])
    carries_end = torch.where(carries_end.any(-1, keepdim=True), carries_end, on)

    alternation = _alternation(p, on, tone, surround)
    contoured = edged & run_any(bridge(edged, 0.7 * width / spacing), on)
    low_border, high_border = borders = reached_borders(t, contoured, p.seen, width)
    flip = enters_high(t, contoured, p.seen, borders)
    start = torch.where(flip, -last_on(t, on), first_on(t, on))
    end = torch.where(flip, -first_on(t, carries_end), last_on(t, carries_end))
    return Evidence(
        strips=strips.reverse(flip),
        t=t,
        on=torch.where(flip[..., None], on.flip(-1), on),
        start=start,
        end=end,
        start_at_border=torch.where(flip, high_border, low_border),
        end_at_border=torch.where(flip, low_border, high_border),
        width=width,
        length=on.float().sum(-1) * spacing,
        paired_length=(on & p.both).float().sum(-1) * spacing,
        contrast=masked_median(p.step, on),
        purity=masked_mean(p.purity, on),
        alternation=alternation,
    )


def _alternation(
    p: _Profiles, on: Bool[Tensor, "b k s"], tone: Float[Tensor, "b k"], surround: Float[Tensor, "b k"]
) -> Float[Tensor, "b k"]:
    """`Evidence.alternation`: stations as bright as the surroundings, with a side as dark as the shaft.

    Beyond the last stretch, where the wrist of bare metal may lie over something dark, both sides have to be.
    """
    step = (surround - tone).clamp(min=0.0)[..., None]
    bright, dark = p.inner > tone[..., None] + 0.6 * step, tone[..., None] + 0.4 * step
    between = (on.cumsum(-1) > 0) & (on.flip(-1).cumsum(-1).flip(-1) > 0)
    changed = bright & p.seen & ((between & (p.outer < dark)) | (p.both & (p.brighter_side < dark)))
    exchanged = changed.sum(-1)
    return exchanged / (exchanged + on.sum(-1)).clamp(min=1)


def score(evidence: Evidence, settings: DetectorSettings) -> Float[Tensor, "b k"]:
    """Supported length, px, less for weak contours, mixed insides or surroundings, and for not reaching a border."""
    quality = evidence.contrast / (evidence.contrast + 0.3)
    entering = torch.where(evidence.start_at_border, 1.0, 0.5)
    long_enough = (evidence.length > settings.min_aspect * evidence.width) & (
        evidence.paired_length > 0.5 * settings.min_aspect * evidence.width
    )
    one_thing = evidence.alternation < _LEAST_ALTERNATION
    wanted = long_enough & one_thing & evidence.strips.valid
    return evidence.length * quality * evidence.purity**2 * entering * wanted


def lies_on(strips: Strips, middle: Float[Tensor, "b k"], width: Float[Tensor, "b k"]) -> Bool[Tensor, "b k k"]:
    """Whether the middle of each strip (first) lies on another (second) that runs the same way.

    Args:
        strips: of each picture.
        middle: station of what may be a shaft, px.
        width: of that, px.
    """
    at = strips.points(middle[..., None], strips.contour(middle[..., None]).mean(2))[:, :, 0]  # (b, k, 2)
    relative = at[:, :, None] - strips.origin[:, None]
    station = (relative * strips.along[:, None]).sum(-1)  # (b, first, second)
    lateral = (relative * strips.left[:, None]).sum(-1)
    contour = strips.contour(station.mT).movedim(-1, 1)  # (b, first, second, 2)
    margin = 0.25 * width[:, None]
    covered = (lateral < contour[..., 0] + margin) & (lateral > contour[..., 1] - margin)
    parallel = torch.einsum("bki,bji->bkj", strips.along, strips.along).abs() > 0.95
    return covered & parallel


def distinct(evidence: Evidence, scores: Float[Tensor, "b k"], count: int) -> tuple[Tensor, Float[Tensor, "b c"]]:
    """Indices and scores of the best `count` strips that do not lie on one another."""
    on = evidence.lies_on()
    overlap = on | on.mT
    left = scores.clone()
    chosen, values = [], []
    for _ in range(count):
        value, index = left.max(1)
        chosen.append(index)
        values.append(value)
        hidden = overlap.gather(1, index[:, None, None].expand(-1, 1, overlap.shape[2]))[:, 0]
        left = left.masked_fill(hidden, 0.0).scatter(1, index[:, None], 0.0)
    return torch.stack(chosen, 1), torch.stack(values, 1)
