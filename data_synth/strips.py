"""Straight pictures of shafts, painted directly along the strip between their contours, with the end known exactly.

A picture is across by along: rows run from one width left of the middle line to one width right of it, columns from
where the shaft enters the picture to where the strip leaves it. Nothing is projected, so thousands of strips a minute
can differ in everything that a scene's few instruments share: surfaces, wrists, rings and balls, light, shadows, lens
and compression. Lengths are in widths of the shaft, colours are encoded values. Same seed, same strips. torch, float32.
"""

from __future__ import annotations

from dataclasses import dataclass

import torch
import torch.nn.functional as nnf
from torch import Tensor

from data_synth.instruments import edge
from data_synth.strip_parts import Draw, Parts, draw_parts, draw_tones

OCCLUDED, BORDER, WRONG = 0.08, 0.12, 0.22
"""Shares of strips whose end something hides, whose shaft leaves the picture, and that do not fit their shaft."""


@dataclass(frozen=True)
class PaintedStrips:
    """m strips and the truth of each.

    Attributes:
        picture: (m, 3, across, along) RGB, 0 to 1.
        known: (m, across, along) 1 in the field of view, else 0.
        columns_per_width: (m,) columns that a shaft's width is long.
        fits: (m,) bool, whether a shaft lies between the contours as it should.
        end: (m,) column at which the tube ends on the middle line; the column past the last where it leaves the
            picture first.
        ring: (m,) bool, whether a ring closes the tube.
        hidden: (m,) bool, whether something hides the end.
    """

    picture: Tensor
    known: Tensor
    columns_per_width: Tensor
    fits: Tensor
    end: Tensor
    ring: Tensor
    hidden: Tensor


@dataclass(frozen=True)
class _Lattice:
    """Where the pixels of m strips lie: s (m, 1, along) beyond the end and y (m, across, along) left of the true axis,
    both in widths; and how far the point spread reaches, (m, 1, 1) widths."""

    s: Tensor
    y: Tensor
    blur: Tensor


def paint_strips(
    backgrounds: Tensor, count: int, generator: torch.Generator, across: int = 24, along: int = 128
) -> PaintedStrips:
    """Strips over pieces of background pictures (n, 3, H, W), 0 to 1, of the size at which strips are read."""
    draw = Draw(generator, count)
    width_px, chord_px = draw.between(6.0, 64.0, log=True), draw.between(110.0, 400.0)
    columns = width_px * (along - 1) / chord_px
    leaves, hidden = draw.chance(BORDER), draw.chance(OCCLUDED)
    first, last = (torch.where(draw.chance(0.25), draw.between(0.0, 0.25), torch.zeros(())) * along for _ in range(2))
    place = first + 4.0 + (along - 6.0 - first) * draw.between(0.0, 1.0)
    end = torch.where(leaves, along + draw.between(1.0, 60.0), place)
    fits, lattice = _lattice(draw, columns, end, width_px, across, along)
    picture = _background(draw, backgrounds, width_px, chord_px, across, along)
    parts = draw_parts(draw, -end / columns)
    picture = _cast_shadow(draw, picture, lattice)
    for k in range(len(parts.s_from)):
        picture = _paint(picture, lattice, parts, k)
    picture = _occlude(draw, picture, backgrounds, lattice, hidden, -end / columns)
    known = _field_of_view(draw, lattice.y, first, last)
    leaves = end > along - 1 - last
    end, hidden = torch.where(leaves, along + 1.0, end), hidden & ~leaves
    picture = _sensed(draw, _lit(draw, picture, along), width_px, chord_px)
    return PaintedStrips(picture, known, columns, fits, end, parts.ring, hidden)


def _lattice(
    draw: Draw, columns: Tensor, end: Tensor, width_px: Tensor, across: int, along: int
) -> tuple[Tensor, _Lattice]:
    """Pixels' places, and whether the contours fit: most are a little off, some by a third of the width and more."""
    x = torch.arange(along, dtype=torch.float32)
    y = torch.linspace(1.0, -1.0, across)[None, :, None]
    wrong = draw.chance(WRONG)
    shift = draw.normal() * 0.02
    scale = 1.0 + draw.normal() * 0.03
    off = draw.between(0.32, 1.0) * draw.sign()
    narrow = torch.where(draw.chance(0.5), draw.between(0.35, 0.65), draw.between(1.6, 2.4))
    how = draw.among(3)
    shift = torch.where(wrong & (how != 1), off, shift)
    scale = torch.where(wrong & (how != 0), narrow, scale)
    tilt = (draw.normal() * 0.025)[:, None, None] * (x / (along - 1) - 0.5)
    lateral = y * scale[:, None, None] + shift[:, None, None] + tilt
    s = (x - end[:, None]) / columns[:, None]
    blur = draw.between(0.45, 2.2, log=True) / width_px
    return ~wrong, _Lattice(s[:, None], lateral, blur[:, None, None])


def _background(draw: Draw, backgrounds: Tensor, width_px: Tensor, chord_px: Tensor, across: int, along: int) -> Tensor:
    """Pieces (m, 3, across, along) of the pictures along lines through them, in a light of their own."""
    height, width = backgrounds.shape[2:]
    angle = draw.between(0.0, 2 * torch.pi)
    direction = torch.stack([angle.cos(), angle.sin()], -1)
    centre = torch.stack([draw.between(0.25, 0.75) * width, draw.between(0.25, 0.75) * height], -1)
    t = torch.linspace(-0.5, 0.5, along) * chord_px[:, None]
    y = torch.linspace(1.0, -1.0, across) * width_px[:, None]
    left = torch.stack([direction[:, 1], -direction[:, 0]], -1)
    place = (
        centre[:, None, None]
        + t[:, None, :, None] * direction[:, None, None]
        + (y[:, :, None, None] * left[:, None, None])
    )
    grid = 2 * place / torch.tensor([width - 1.0, height - 1.0]) - 1
    which = draw.among(len(backgrounds))
    pieces = nnf.grid_sample(backgrounds[which], grid, padding_mode="reflection", align_corners=True)
    tint = draw_tones(draw, 0.5, 1.4, 0.25)
    return (pieces * tint[:, :, None, None]).clamp(0.0, 1.0)


def _cast_shadow(draw: Draw, picture: Tensor, lattice: _Lattice) -> Tensor:
    """The background darkened along one side of the shaft."""
    beside = draw.between(0.2, 1.1) * draw.sign()
    broad, soft = draw.between(0.4, 0.7), draw.between(0.08, 0.4)
    away = (broad[:, None, None] - (lattice.y - beside[:, None, None]).abs()) / soft[:, None, None]
    before_tip = (draw.between(0.0, 4.0)[:, None, None] - lattice.s) / soft[:, None, None]
    depth = torch.where(draw.chance(0.5), draw.between(0.1, 0.75), torch.zeros(()))
    dark = depth[:, None, None] * torch.sigmoid(3 * away) * torch.sigmoid(3 * before_tip)
    return picture * (1 - dark)[:, None]


def _paint(picture: Tensor, lattice: _Lattice, parts: Parts, k: int) -> Tensor:
    """Part k of every strip over what lies behind it."""

    def of(values: Tensor) -> Tensor:
        return values[k][:, None, None]

    length = (of(parts.s_to) - of(parts.s_from)).clamp(min=1e-3)
    share = ((lattice.s - of(parts.s_from)) / length).clamp(0.0, 1.0)
    belly = (1 - (2 * share - 1).square()).clamp(min=0.0).sqrt()
    radius = 0.5 * (of(parts.ratio) + (of(parts.ratio_to) - of(parts.ratio)) * share)
    radius = (radius * (1 + of(parts.roundness) * (belly - 1))).clamp(min=1e-3)
    y = lattice.y - of(parts.lateral) - of(parts.bend) * (lattice.s - of(parts.s_from)).clamp(min=0.0)
    n = (y / radius).clamp(-1.0, 1.0)
    facing = (1 - n * n).sqrt()
    rim = of(parts.rim) * (1 - facing)
    cover = edge(radius - y.abs(), lattice.blur) * edge(of(parts.s_to) + rim - lattice.s, lattice.blur)
    cover = cover * edge(lattice.s - of(parts.s_from) - rim, lattice.blur) * of(parts.present)
    body = of(parts.limb) + (1 - of(parts.limb)) * facing
    waves = (of(parts.waves_along) * lattice.s + of(parts.phase)).sin() * (of(parts.waves_round) * n).cos()
    body = body * (1 + of(parts.relief) * waves)
    shine = of(parts.shine) * (-((n - of(parts.light)) / of(parts.breadth)).square()).exp()
    colour = body[:, None] * parts.colour[k][:, :, None, None] + shine[:, None]
    return torch.lerp(picture, colour.clamp(0.0, 1.0), cover.clamp(0.0, 1.0)[:, None])


def _occlude(
    draw: Draw, picture: Tensor, backgrounds: Tensor, lattice: _Lattice, hidden: Tensor, s_first: Tensor
) -> Tensor:
    """Something that lies over the end of some strips, and over the tube of a few others."""
    m, _, across, along = picture.shape
    over_tube = draw.chance(0.08) & ~hidden
    length = draw.between(0.3, 4.0)
    middle = torch.where(hidden, draw.between(-0.3, 0.3) * length, s_first * draw.between(0.2, 0.9))
    middle = torch.where(hidden, middle, torch.minimum(middle, -1.0 - 0.6 * length))
    slant = draw.between(-0.6, 0.6)
    off = (lattice.s + slant[:, None, None] * lattice.y - middle[:, None, None]).abs()
    cover = edge(0.5 * length[:, None, None] - off, 2 * lattice.blur + 0.02)
    cover = cover * (hidden | (over_tube & (s_first < -2.0)))[:, None, None]
    chord = torch.full((m,), 160.0)
    other = _background(draw, backgrounds, torch.full((m,), 24.0), chord, across, along)
    tone = draw_tones(draw, 0.1, 0.9, 0.4)[:, :, None, None].expand_as(other)
    other = torch.where(draw.chance(0.6)[:, None, None, None], other, tone * (0.7 + 0.6 * other))
    return torch.lerp(picture, other.clamp(0.0, 1.0), cover[:, None])


def _field_of_view(draw: Draw, y: Tensor, first: Tensor, last: Tensor) -> Tensor:
    """1 in the field of view, whose borders cut so many columns at either end, aslant; 0 outside."""
    along = torch.arange(y.shape[2], dtype=torch.float32)
    known = torch.ones_like(y)
    for x, cut in ((along, first), (along.flip(0), last)):
        slant = torch.where(cut > 0, 3.0 * draw.normal(), torch.zeros(()))
        known = known * (x >= cut[:, None, None] + slant[:, None, None] * y)
    return known


def _lit(draw: Draw, picture: Tensor, along: int) -> Tensor:
    """Light that falls off along the strip, another exposure and white balance, smoke."""
    at = torch.linspace(-1.0, 1.0, along)
    fall = draw.normal()[:, None] * 0.3 * at - draw.between(0.0, 0.6)[:, None] * at.square()
    gain = (fall.exp() * draw.between(0.55, 1.5, log=True)[:, None])[:, None, None]
    balance = (draw.normal(3) * 0.06).exp()[:, :, None, None]
    picture = picture.clamp(min=0.0) ** draw.between(0.75, 1.3)[:, None, None, None] * gain * balance
    smoke = torch.where(draw.chance(0.15), draw.between(0.05, 0.45), torch.zeros(()))[:, None, None, None]
    picture = torch.lerp(picture, torch.full_like(picture, 0.72), smoke)
    grey = picture.mean(1, keepdim=True)
    saturation = torch.where(draw.chance(0.2), torch.zeros(()), draw.between(0.6, 1.4))[:, None, None, None]
    return (grey + saturation * (picture - grey)).clamp(0.0, 1.0)


def _sensed(draw: Draw, picture: Tensor, width_px: Tensor, chord_px: Tensor) -> Tensor:
    """Coarse colours, sharpening, noise with a grain of one or several pixels, and blocks of strong compression."""
    across, along = picture.shape[2:]
    grey = picture.mean(1, keepdim=True)
    coarse = nnf.avg_pool2d(nnf.pad(picture - grey, (2, 2, 2, 2), mode="replicate"), 5, 1)
    picture = torch.where(draw.chance(0.4)[:, None, None, None], grey + coarse, picture)
    soft = nnf.avg_pool2d(nnf.pad(picture, (1, 1, 1, 1), mode="replicate"), 3, 1)
    sharper = torch.where(draw.chance(0.3), draw.between(0.0, 0.7), torch.zeros(()))[:, None, None, None]
    picture = picture + sharper * (picture - soft)
    fine = draw.normal(3, across, along) * draw.between(0.0, 0.025)[:, None, None, None]
    blocks = nnf.interpolate(draw.normal(3, across // 4, along // 4), scale_factor=4.0, mode="nearest")
    strength = torch.where(draw.chance(0.4), draw.between(0.0, 0.03), torch.zeros(()))[:, None, None, None]
    return (picture + fine + strength * blocks).clamp(0.0, 1.0)
