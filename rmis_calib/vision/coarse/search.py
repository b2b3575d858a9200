"""Coarse search: from a batch of pictures to a few strips a frame that may be shafts.

Nothing here knows of other frames. What a video remembers is in `pipeline/pictures/memory.py`: between two frames that
are searched and agree, shafts are only looked for where they should be (`guided.py`), at a third of the time.
"""

from collections.abc import Callable
from dataclasses import dataclass
from functools import partial

import torch
from jaxtyping import Bool, Float, Int64
from torch import Tensor

from rmis_calib.vision.coarse import appearance, hough, scoring, strips, trace
from rmis_calib.vision.coarse.straight_pictures import straighten_pictures
from rmis_calib.vision.coarse.strip_network import StripVerdict, load_network
from rmis_calib.vision.image.canvas import Canvas, shrink
from rmis_calib.vision.settings import DetectorSettings

_LINES, _PAIRS, _STRIPS = 48, 160, 20
# Blurred ridges of the field's border reach this far into it, small px.
_RIM_PX = 4
_LIT_MERIT = 0.75
# A strip of the dark view that lies on one of the lit view: below this share of its width it is a part of the shaft,
# between the other two it has a shadow; and the merit that is left to it.
_PART_OF_LIT, _SHADOWED = 0.6, (1.1, 1.6)
_PART_MERIT = 0.5
# A ridge below this is texture: 4 per cent of brightness a small pixel.
_MIN_GRADIENT = 0.04


@dataclass(frozen=True, eq=False)
class SearchTrace:
    """What each stage of the search saw, for pictures that explain a result."""

    rgb: Float[Tensor, "b 3 h w"]
    seen: Bool[Tensor, "b h w"]
    unlike: Float[Tensor, "b h w"]
    lit: Float[Tensor, "b h w"]
    """The last view of `appearance.shaft_contrast`."""
    ridge: Bool[Tensor, "b h w"]
    """Of any view."""
    votes: Float[Tensor, "b angles rhos"]
    lines: hough.HoughLines
    evidence: scoring.Evidence
    scores: Float[Tensor, "b k"]
    leads: Float[Tensor, "b c"]
    """Scores of the strips that are measured, the best first."""
    factor: int
    """Full-resolution pixels a small one."""
    origin: tuple[float, float]
    """Ideal pixel of the first small pixel."""


@dataclass(frozen=True, eq=False)
class StripCandidates:
    """Strips that may be shafts, the best first in each frame."""

    trace: trace.Trace
    """The kept ones as one list, (1, m)."""
    frame: Int64[Tensor, "1 m"]
    """Picture that each of the list lies in."""
    lit: Bool[Tensor, "1 m"]
    """Which were found in the lit view."""
    keep: Bool[Tensor, "b c"]
    """Which ranks of which frames are in the list; at least one."""
    scores: Float[Tensor, "b c"]
    """0 for none."""
    verdict: StripVerdict
    """Of the network on the kept ones, one list (m)."""


@dataclass(frozen=True, eq=False)
class SmallViews:
    """A batch of pictures made small, in the views of `appearance.shaft_contrast`."""

    rgb: Float[Tensor, "b 3 h w"]
    seen: Bool[Tensor, "b h w"]
    well_inside: Bool[Tensor, "b h w"]
    """`seen` without a rim along black borders."""
    views: Float[Tensor, "b views h w"]
    picture: strips.SmallPicture


def small_views(
    images: Tensor, canvas: Canvas, settings: DetectorSettings, looks: int, masks: Tensor | None = None
) -> SmallViews:
    """What strips are looked for on. Arguments as in `search`."""
    small = shrink(images, canvas.factor)
    field, within = appearance.field_of_view(small, settings.black_level, _RIM_PX)
    rgb, seen, well_inside = _lay_out(canvas, small, field, within)
    if masks is None:
        views, tone = appearance.shaft_contrast(rgb, seen, looks)
    else:
        inside = canvas.lay_out(shrink(masks[:, None].to(torch.float32), canvas.factor))
        views, tone = appearance.smooth(1 - inside[:, 0])[:, None], torch.zeros_like(inside[:, 0])
    # Each view is searched as a frame of its own, until the best strips of each picture are chosen.
    count = views.shape[1]
    layers = views.new_empty(3, *views.shape)
    layers[0], layers[1], layers[2] = views, seen.to(views.dtype)[:, None], tone[:, None]
    layers = layers.flatten(1, 2)
    return SmallViews(rgb, seen, well_inside, views, strips.SmallPicture(layers, count, canvas, images.shape[-1]))


def search(
    images: Tensor,
    canvas: Canvas,
    settings: DetectorSettings,
    looks: int,
    masks: Tensor | None = None,
) -> tuple[StripCandidates, SearchTrace]:
    """The best strips of each frame, at most `max_shafts`, with their contours traced, and the stages that led there.

    Args:
        images: (b, 3, H, W), uint8 or floating point in [0, 1].
        canvas: the small picture's place.
        settings: limits of width, contrast, convergence.
        looks: views of each picture that are searched, 1 or 2 (appearance.py); masks are a single one.
        masks: (b, H, W), 1 on shafts, which replace the colour stage.
    """
    small = small_views(images, canvas, settings, looks, masks)
    picture, views, count = small.picture, small.views, small.picture.views
    unlike = views.flatten(0, 1)
    ridge, edges = _edges(unlike, small.well_inside.repeat_interleave(count, 0))
    votes = hough.vote(edges, len(unlike), canvas.half_diagonal_px / canvas.factor + 2)
    lines = hough.refine(edges, hough.peaks(votes, _LINES))
    lines = hough.HoughLines(lines.normal, lines.rho * canvas.factor, lines.votes)
    # Masks have no texture: a strip that is too wide looks as good at a glance as the right one, so none is left out.
    count_pairs = _STRIPS if masks is None else _PAIRS
    pairs = scoring.screen(picture, strips.pair(lines, picture, settings, _PAIRS), settings, count_pairs)
    evidence = scoring.inspect(picture, pairs, settings)
    scores = scoring.score(evidence, settings)
    look = partial(judge_strips, small)
    found = _best(picture, evidence, scores, settings, look)
    ridge, votes = ridge.unflatten(0, (-1, count)).any(1), votes.unflatten(0, (-1, count)).amax(1)
    lines = hough.HoughLines(**{n: v.unflatten(0, (-1, count)).flatten(1, 2) for n, v in vars(lines).items()})
    evidence, scores = evidence.views_together(count), scores.unflatten(0, (-1, count)).flatten(1, 2)
    pictures = (small.rgb, small.seen, views[:, 0], views[:, -1], ridge, votes)
    return found, SearchTrace(*pictures, lines, evidence, scores, found.scores, canvas.factor, canvas.origin)


def judge_strips(small: SmallViews, several: strips.Strips) -> StripVerdict:
    """What the network says of strips in any of the views; places of ends as stations, px."""
    number = several.frame // small.picture.views
    seen = small.picture.layers[1, :: small.picture.views]
    straight, chord = straighten_pictures(small.rgb, seen, small.picture.canvas, several, number)
    return load_network(small.rgb.device).judge(straight, chord.flatten(0, 1))


def _best(
    picture: strips.SmallPicture,
    evidence: scoring.Evidence,
    scores: Float[Tensor, "v k"],
    settings: DetectorSettings,
    look: Callable[[strips.Strips], StripVerdict],
) -> StripCandidates:
    """The best strips of each view, traced; and of these the best of each picture, traced once more.

    A strip of one view that lies on one of another competes by how straight its contours are.
    """
    wanted = settings.max_shafts
    index, best = scoring.distinct(evidence, scores, wanted)
    few = evidence.pick(index).views_together(picture.views)
    best = best.reshape(-1, picture.views * wanted)
    keep = best > 0
    keep[0, 0] |= ~keep.any()  # an empty list would have no medians
    straight, wander = trace.straighten(trace.walk(picture, few.strips.listed(keep), settings))
    merit = torch.zeros_like(best)
    merit[keep] = best[keep] / (1 + (wander / (0.02 * few.width[keep] + picture.factor)).square())[0]
    lit = few.strips.frame % picture.views > 0
    merit = torch.where(lit, _LIT_MERIT * merit, merit)
    # Between a contour and a stripe of glare lies a dark strip too, as straight as the shaft that holds it; and a shaft
    # with its shadow is another, a little wider.
    over = few.lies_on() & lit[:, None] & ~lit[:, :, None] & (merit > 0)[:, None]  # dark (first) on lit (second)
    share = few.width[:, :, None] / few.width[:, None].clamp(min=1e-6)
    wrong = over & ((share < _PART_OF_LIT) | ((share > _SHADOWED[0]) & (share < _SHADOWED[1])))
    merit = torch.where(wrong.any(-1), _PART_MERIT * merit, merit)
    index, best = scoring.distinct(few, merit, wanted)
    place = torch.zeros_like(keep, dtype=torch.int64)
    place[keep] = torch.arange(straight.frame.shape[1], device=place.device)
    chosen = best > 0
    chosen[0, 0] |= ~chosen.any()
    listed = straight.pick(place.gather(1, index)[chosen][None])
    # Once more around lines through what was traced: the pair of Hough lines may have followed a short stretch only.
    traced = trace.trace(picture, listed, settings)
    number, lit = listed.frame // picture.views, picture.lit(listed)
    return StripCandidates(traced, number, lit, chosen, best, look(traced.strips))


def _lay_out(
    canvas: Canvas, small: Float[Tensor, "b 3 h w"], field: Bool[Tensor, "b h w"], within: Bool[Tensor, "b h w"]
) -> tuple[Float[Tensor, "b 3 h2 w2"], Bool[Tensor, "b h2 w2"], Bool[Tensor, "b h2 w2"]]:
    """The shrunken picture, its field of view and the inner part of that, in ideal pixels."""
    if canvas.covered is None:
        return small, field, within
    # One layer for both: 2 within, 1 in the rest of the field, which is wider than a pixel, 0 beyond.
    inwards = (field.view(torch.uint8) + within.view(torch.uint8))[:, None].to(small.dtype)
    stack = canvas.lay_out(torch.cat([small, inwards], 1))
    return stack[:, :3], (stack[:, 3] > 0.5) & canvas.covered, (stack[:, 3] > 1.99) & canvas.covered


def _edges(
    unlike: Float[Tensor, "b h w"], well_inside: Bool[Tensor, "b h w"]
) -> tuple[Bool[Tensor, "b h w"], hough.EdgePixels]:
    """Thin ridges of the gradient inside the field of view, in small pixels from the middle of the canvas."""
    gu, gv = hough.gradients(unlike)
    magnitude = (gu * gu).addcmul_(gv, gv).sqrt_()
    strong = (magnitude > _MIN_GRADIENT) & well_inside
    for border in (strong[:, :: strong.shape[1] - 1], strong[:, :, :: strong.shape[2] - 1]):
        border.fill_(False)
    pixel = strong.flatten().nonzero()[:, 0]
    gu, gv = (component.flatten().index_select(0, pixel) for component in (gu, gv))
    top = hough.thin(magnitude, pixel, gu, gv).nonzero()[:, 0]
    pixel, gradient = pixel[top], torch.stack([gu[top], gv[top]], -1)
    ridge = torch.zeros_like(well_inside)
    ridge.view(-1)[pixel] = True
    strength = magnitude.flatten()[pixel]
    height, width = unlike.shape[1:]
    frame, row, column = pixel // (height * width), pixel // width % height, pixel % width
    middle = strength.new_tensor([(width - 1) / 2, (height - 1) / 2])
    uv = torch.stack([column, row], -1).to(strength.dtype) - middle
    return ridge, hough.EdgePixels(frame, uv, gradient / strength[:, None], strength / (strength + 0.15))
