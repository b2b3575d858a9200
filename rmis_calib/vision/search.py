"""Coarse search: from a batch of pictures to a few strips a frame that may be shafts.

Each frame of a video is searched anew. Lines of the frame before could spare edges, votes and most strips: 30 per cent
of the processor time of a picture of 1280 x 720 px, 26 with every eighth frame searched in full. But an instrument that
enters would go unseen until then, for only what is spared would show it, and batches would have to wait for each other.
"""

from dataclasses import dataclass

import torch
from jaxtyping import Bool, Float
from torch import Tensor

from rmis_calib.vision import hough, scoring, shaft_mask, strips, trace
from rmis_calib.vision.canvas import Canvas, shrink
from rmis_calib.vision.settings import DetectorSettings

_LINES, _PAIRS, _STRIPS = 48, 160, 24
# Blurred ridges of the field's border reach this far into it, small px.
_RIM_PX = 4
# A ridge below this is texture: 4 per cent of brightness a small pixel.
_MIN_GRADIENT = 0.04


@dataclass(frozen=True, eq=False)
class Stages:
    """What each stage of the search saw, for pictures that explain a result."""

    rgb: Float[Tensor, "b 3 h w"]
    seen: Bool[Tensor, "b h w"]
    unlike: Float[Tensor, "b h w"]
    ridge: Bool[Tensor, "b h w"]
    votes: Float[Tensor, "b angles rhos"]
    lines: hough.HoughLines
    evidence: scoring.Evidence
    scores: Float[Tensor, "b k"]
    factor: int
    """Full-resolution pixels a small one."""
    origin: tuple[float, float]
    """Ideal pixel of the first small pixel."""


@dataclass(frozen=True, eq=False)
class Found:
    """Strips that may be shafts, the best first in each frame."""

    trace: trace.Trace
    """The kept ones as one list, (1, m)."""
    keep: Bool[Tensor, "b c"]
    """Which ranks of which frames are in the list; at least one."""
    scores: Float[Tensor, "b c"]
    """0 for none."""


def search(
    images: Tensor, canvas: Canvas, settings: DetectorSettings, count: int, masks: Tensor | None = None
) -> tuple[Found, Stages]:
    """The best `count` strips of each frame with their contours traced, and the stages that led there.

    Args:
        images: (b, 3, H, W), uint8 or floating point in [0, 1].
        canvas: the small picture's place.
        settings: limits of width, contrast, convergence.
        count: strips wanted a frame.
        masks: (b, H, W), 1 on shafts, which replace the colour stage.
    """
    small = shrink(images, canvas.factor)
    field, within = shaft_mask.field_of_view(small, settings.black_level, _RIM_PX)
    rgb, seen, well_inside = _lay_out(canvas, small, field, within)
    if masks is None:
        unlike, tone = shaft_mask.unlikeness(rgb, seen)
    else:
        inside = canvas.lay_out(shrink(masks[:, None].to(torch.float32), canvas.factor))
        unlike, tone = shaft_mask.smooth(1 - inside[:, 0]), torch.zeros_like(inside[:, 0])
    ridge, edges = _edges(unlike, well_inside)
    votes = hough.vote(edges, images.shape[0], canvas.half_diagonal_px / canvas.factor + 2)
    lines = hough.refine(edges, hough.peaks(votes, _LINES))
    picture = strips.SmallPicture(torch.stack([unlike, seen.to(unlike.dtype), tone]), canvas, images.shape[-1])
    lines = hough.HoughLines(lines.normal, lines.rho * canvas.factor, lines.votes)
    # Masks have no texture: a strip that is too wide looks as good at a glance as the right one, so none is left out.
    count_pairs = _STRIPS if masks is None else _PAIRS
    pairs = scoring.screen(picture, strips.pair(lines, picture, settings, _PAIRS), settings, count_pairs)
    evidence = scoring.inspect(picture, pairs, settings)
    scores = scoring.score(evidence, settings)
    index, best = scoring.distinct(evidence, scores, count)
    keep = best > 0
    keep[0, 0] |= ~keep.any()  # an empty list would have no medians
    traced = trace.trace(picture, evidence.strips.pick(index).listed(keep), settings)
    # Once more around lines through what was traced: the pair of Hough lines may have followed a short stretch only.
    traced = trace.trace(picture, trace.straighten(traced), settings)
    return Found(traced, keep, best), Stages(
        rgb, seen, unlike, ridge, votes, lines, evidence, scores, canvas.factor, canvas.origin
    )


def _lay_out(
    canvas: Canvas, small: Float[Tensor, "b 3 h w"], field: Bool[Tensor, "b h w"], within: Bool[Tensor, "b h w"]
) -> tuple[Float[Tensor, "b 3 h2 w2"], Bool[Tensor, "b h2 w2"], Bool[Tensor, "b h2 w2"]]:
    """The shrunken picture, its field of view and the inner part of that, in ideal pixels."""
    if canvas.covered is None:
        return small, field, within
    stack = canvas.lay_out(torch.cat([small, field[:, None].to(small.dtype), within[:, None].to(small.dtype)], 1))
    return stack[:, :3], (stack[:, 3] > 0.5) & canvas.covered, (stack[:, 4] > 0.99) & canvas.covered


def _edges(
    unlike: Float[Tensor, "b h w"], well_inside: Bool[Tensor, "b h w"]
) -> tuple[Bool[Tensor, "b h w"], hough.EdgePixels]:
    """Thin ridges of the gradient inside the field of view, in small pixels from the middle of the canvas."""
    gu, gv = hough.gradients(unlike)
    magnitude = torch.sqrt(gu * gu + gv * gv)
    strong = ((magnitude > _MIN_GRADIENT) & well_inside).flatten().nonzero()[:, 0]
    height, width = unlike.shape[1:]
    frame, row, column = strong // (height * width), strong // width % height, strong % width
    gradient = torch.stack([gu.flatten()[strong], gv.flatten()[strong]], -1)
    top = hough.thin(magnitude, frame, row, column, *gradient.unbind(-1)).nonzero()[:, 0]
    ridge = torch.zeros_like(well_inside)
    ridge.view(-1)[strong[top]] = True
    strength = magnitude.flatten()[strong[top]]
    middle = strength.new_tensor([(width - 1) / 2, (height - 1) / 2])
    uv = torch.stack([column[top], row[top]], -1).to(strength.dtype) - middle
    return ridge, hough.EdgePixels(frame[top], uv, gradient[top] / strength[:, None], strength / (strength + 0.15))
