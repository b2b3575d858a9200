"""The parts of instruments that strips.py paints: tubes, rings, wrists of several pieces, jaws, balls, sleeves and
tapes, with surfaces drawn at random. Lengths in widths of the tube beyond its end; torch, float32."""

from __future__ import annotations

from dataclasses import dataclass, fields

import torch
from torch import Tensor

LENGTH = 1e3
"""The tube begins so far before its end."""
LEAST_STEP = 0.07
"""What follows the tube differs from it by so much in some colour: an end that nobody sees has no place."""
LEAST_TO_END = -2.5
"""In widths of the tube: what is fixed on a tube ends before this. A band nearer to the end looks like a ring, and what
is beyond it like the wrist's base, which often has the tube's own colour."""


class Draw:
    """Random values for m strips, in a fixed order from one generator."""

    def __init__(self, generator: torch.Generator, count: int) -> None:
        self.generator, self.count = generator, count

    def between(self, low: float, high: float, log: bool = False) -> Tensor:
        """(m,) uniform, or uniform in the logarithm."""
        share = torch.rand(self.count, generator=self.generator)
        return low * (high / low) ** share if log else low + (high - low) * share

    def normal(self, *shape: int) -> Tensor:
        """(m, *shape) standard normal."""
        return torch.randn(self.count, *shape, generator=self.generator)

    def chance(self, share: float) -> Tensor:
        """(m,) bool."""
        return torch.rand(self.count, generator=self.generator) < share

    def sign(self) -> Tensor:
        """(m,) -1 or 1."""
        return torch.where(self.chance(0.5), 1.0, -1.0)

    def among(self, count: int) -> Tensor:
        """(m,) int64 below `count`."""
        return torch.randint(count, (self.count,), generator=self.generator)


def draw_tones(draw: Draw, low: float, high: float, tint: float) -> Tensor:
    """Colours (m, 3) of about these brightnesses, a third of them nearly grey."""
    grey = draw.between(low, high)[:, None]
    colourful = torch.where(draw.chance(0.35), 0.15 * tint, tint)[:, None]
    return (grey * (1 + colourful * (2 * torch.rand(draw.count, 3, generator=draw.generator) - 1))).clamp(0.0, 1.5)


@dataclass(frozen=True)
class Parts:
    """p parts of m instruments about one axis, in the order in which they are painted; all (p, m) but `colour`.

    Attributes:
        s_from, s_to: where a part begins and ends.
        ratio, ratio_to: its diameter there.
        roundness: 0: a tube or cone; 1: a ball.
        lateral, bend: place across the axis where it begins, and slope of its own axis.
        rim: how far its ends bulge along the axis at the limb, as the ellipses of a tilted tube do.
        colour: (p, m, 3).
        limb: brightness at the limb, share of that in the middle.
        shine, light, breadth: the highlight's strength, place (-1 to 1 across) and breadth.
        relief, waves_along, waves_round, phase: a pattern on its surface.
        present: 1 or 0.
        ring: (m,) bool, whether a ring closes the tube.
    """

    s_from: Tensor
    s_to: Tensor
    ratio: Tensor
    ratio_to: Tensor
    roundness: Tensor
    lateral: Tensor
    bend: Tensor
    rim: Tensor
    colour: Tensor
    limb: Tensor
    shine: Tensor
    light: Tensor
    breadth: Tensor
    relief: Tensor
    waves_along: Tensor
    waves_round: Tensor
    phase: Tensor
    present: Tensor
    ring: Tensor


def draw_parts(draw: Draw, s_first: Tensor) -> Parts:
    """Instruments whose tubes enter the picture at s_first (m,), below 0."""
    common = {"light": draw.between(-0.8, 0.8), "rim": draw.normal() * 0.1}
    tube = _surface(draw, draw_tones(draw, 0.02, 0.34, 0.35), 0.25)
    stripe = draw.chance(0.35)  # a polished tube draws the lamp as a stripe
    tube["shine"] = torch.where(stripe, draw.between(0.1, 0.9), tube["shine"])
    tube["breadth"] = torch.where(stripe, draw.between(0.04, 0.25), tube["breadth"])
    tube["relief"] = tube["relief"] * draw.between(0.0, 0.6)
    nothing = torch.zeros(draw.count)
    place = {"s_from": nothing - LENGTH, "s_to": nothing, "ratio": nothing + 1, "ratio_to": nothing + 1}
    ring, closed = _ring(draw, tube["colour"])
    wrist, reach = _wrist(draw, tube["colour"], closed, ring["s_to"])
    jaws = _jaws(draw, reach)
    listed = [*jaws, *wrist, place | tube, ring, *_around(draw, s_first, tube["colour"])]
    still = dict.fromkeys(("roundness", "lateral", "bend"), nothing) | {"present": nothing + 1}
    complete = [still | common | part for part in listed]
    stacked = {f.name: torch.stack([part[f.name] for part in complete]) for f in fields(Parts) if f.name != "ring"}
    return Parts(**stacked, ring=closed)


def _surface(draw: Draw, colour: Tensor, shine: float) -> dict[str, Tensor]:
    return {
        "colour": colour,
        "limb": draw.between(0.35, 1.05),
        "shine": draw.between(0.0, shine),
        "breadth": draw.between(0.12, 0.9),
        "relief": torch.where(draw.chance(0.4), draw.between(0.0, 0.4), torch.zeros(())),
        "waves_along": draw.between(1.0, 25.0, log=True),
        "waves_round": draw.between(0.0, 6.0),
        "phase": draw.between(0.0, 6.28),
    }


def _unlike(draw: Draw, colour: Tensor, tube: Tensor) -> Tensor:
    """The colours, moved away from the tube's where they are too near."""
    near = ((colour - tube).abs().amax(-1) < LEAST_STEP)[:, None]
    return torch.where(near, tube + draw.between(LEAST_STEP, 0.5)[:, None], colour)


def _metal(draw: Draw) -> Tensor:
    """Steel mostly, white or coloured plastic, now and then something dark."""
    steel, any_colour = draw_tones(draw, 0.2, 0.95, 0.12), draw_tones(draw, 0.08, 0.9, 0.9)
    return torch.where(draw.chance(0.75)[:, None], steel, any_colour)


def _ring(draw: Draw, tube: Tensor) -> tuple[dict[str, Tensor], Tensor]:
    """The ring that closes the tube, bright, coloured or (on a tube that is not) dark; and where there is one."""
    closed = draw.chance(0.45)
    length = draw.between(0.04, 0.4)
    colour = torch.where(draw.chance(0.7)[:, None], draw_tones(draw, 0.35, 1.0, 0.1), draw_tones(draw, 0.1, 0.9, 0.9))
    dark = (draw.chance(0.15) & (tube.amax(-1) > 0.22))[:, None]
    colour = torch.where(dark, 0.3 * tube, _unlike(draw, colour, tube))
    ratio = draw.between(0.97, 1.06)
    where = {"s_from": torch.zeros(draw.count), "s_to": length, "ratio": ratio, "ratio_to": ratio}
    return where | _surface(draw, colour, 0.5) | {"present": closed.float()}, closed


def _wrist(draw: Draw, tube: Tensor, closed: Tensor, ring_end: Tensor) -> tuple[list[dict[str, Tensor]], Tensor]:
    """Three pieces from the tip to the tube, the outer two bent to a side; and where the jaws begin (m,).

    Beyond a ring the first piece may look like the tube itself; then it is short.
    """
    alike = closed & draw.chance(0.5)
    lengths = [draw.between(0.15, 2.2, log=True), draw.between(0.1, 1.5, log=True), draw.between(0.1, 1.2, log=True)]
    lengths[0] = torch.where(alike, (0.15 + 0.6 * lengths[0]).clamp(max=1.2) + ring_end, lengths[0])
    bend = torch.where(draw.chance(0.4), draw.normal() * 0.6, torch.zeros(()))
    first = torch.where(alike[:, None], tube * draw.between(0.8, 1.5)[:, None], _unlike(draw, _metal(draw), tube))
    colours = [first, _metal(draw), _metal(draw)]
    s, lateral, pieces = torch.zeros(draw.count), torch.zeros(draw.count), []
    ratio = draw.between(0.72, 1.03)
    for i in range(3):
        ratio_to = ratio * torch.where(draw.chance(0.6), torch.ones(()), draw.between(0.7, 1.0))
        slope = torch.zeros(draw.count) if i == 0 else bend
        where = {"s_from": s - 0.1, "s_to": s + lengths[i], "ratio": ratio, "ratio_to": ratio_to}
        shape = {"roundness": torch.where(draw.chance(0.25), draw.between(0.1, 0.6), torch.zeros(())) * (i > 0)}
        pieces.append(where | shape | _surface(draw, colours[i], 0.7) | {"lateral": lateral, "bend": slope})
        s, lateral = s + lengths[i], lateral + slope * lengths[i]
        ratio = ratio_to * draw.between(0.6, 1.0)
    pieces[2]["present"] = draw.chance(0.6).float()
    pieces[1]["present"] = torch.maximum(draw.chance(0.8).float(), pieces[2]["present"])
    return pieces[::-1], s


def _jaws(draw: Draw, s: Tensor) -> list[dict[str, Tensor]]:
    """Two jaws, or a hook or a probe."""
    opening, middle = draw.between(0.0, 0.8), draw.normal() * 0.3
    length, ratio = draw.between(0.3, 3.0), draw.between(0.1, 0.5)
    colour = _metal(draw)
    single, none = draw.chance(0.3), draw.chance(0.15)
    jaws = []
    for side in (1.0, -1.0):
        where = {"s_from": s - 0.3, "s_to": s + length, "ratio": ratio, "ratio_to": ratio * draw.between(0.3, 1.0)}
        absent = none | (single if side < 0 else torch.zeros_like(single))
        more = {"bend": middle + side * opening, "lateral": middle * 0.2, "present": (~absent).float()}
        jaws.append(where | _surface(draw, colour, 0.7) | more)
    return jaws


def _around(draw: Draw, s_first: Tensor, tube: Tensor) -> list[dict[str, Tensor]]:
    """What may sit on the tube well before its end: tapes, a sleeve, balls as markers. The tube goes on beyond them."""
    shaped, taped = draw.chance(0.28), draw.chance(0.18)
    gap = draw.between(0.5, 6.0)
    ball = draw.between(1.2, 3.2)
    # Markers are put where they stay in view: near the end as often as anywhere.
    near = LEAST_TO_END - 0.5 * ball - draw.between(0.0, 6.0)
    at = torch.where(draw.chance(0.5), near, s_first * draw.between(0.1, 0.9))
    both = draw.chance(0.6)
    colour, sleeve = draw_tones(draw, 0.15, 0.95, 1.0), draw_tones(draw, 0.03, 0.9, 0.5)
    ratio = draw.between(1.05, 2.0)
    parts = []
    surface = _surface(draw, sleeve, 0.4)
    where = {"s_from": at - gap, "s_to": at, "ratio": ratio, "ratio_to": ratio}
    parts.append(where | surface | {"present": (shaped & (draw.chance(0.5) | ~both)).float()})
    surface = _surface(draw, colour, 0.6)
    for centre in (at, at - gap):
        where = {"s_from": centre - 0.5 * ball, "s_to": centre + 0.5 * ball, "ratio": ball, "ratio_to": ball}
        parts.append(where | surface | {"roundness": torch.ones(draw.count), "present": (shaped & both).float()})
    for _ in range(2):
        start, length = s_first * draw.between(0.05, 0.95), draw.between(0.1, 1.5, log=True)
        level = _unlike(draw, draw_tones(draw, 0.05, 0.95, 0.8), tube)
        where = {"s_from": start - length, "s_to": start, "ratio": torch.ones(draw.count) * 1.01}
        parts.append(
            where | {"ratio_to": where["ratio"]} | _surface(draw, level, 0.4)
            | {"present": (taped & draw.chance(0.7)).float()}
        )  # fmt: skip
    for part in parts:  # what reaches the end would hide it
        part["present"] = part["present"] * (part["s_to"] < LEAST_TO_END)
    return parts
