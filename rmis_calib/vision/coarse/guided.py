"""Strips traced where shafts are expected, in place of a search: no edges, no votes, no candidates."""

import torch
from jaxtyping import Bool
from torch import Tensor

from rmis_calib.vision.coarse import trace
from rmis_calib.vision.coarse.search import StripCandidates, judge_strips, small_views
from rmis_calib.vision.coarse.strips import Strips
from rmis_calib.vision.image.canvas import Canvas
from rmis_calib.vision.settings import DetectorSettings

COARSER = 2
"""Side of a pixel for `trace_near`, in pixels of the small picture on which strips are searched. Contours of a shaft
that is within a fifth of its width of where it was expected are then measured as after a search, to a fifth of their
uncertainty and better."""


def trace_along(images: Tensor, canvas: Canvas, settings: DetectorSettings, expected: Strips) -> StripCandidates:
    """Contours near strips where a shaft is expected, one a picture, traced in both views; ranks are the views.

    Whether one is there is left to who measures them: nothing is ranked or left out here.
    """
    small = small_views(images, canvas, settings, 2)
    picture = small.picture
    each = {name: value.repeat_interleave(picture.views, 0) for name, value in vars(expected).items()}
    view = torch.arange(len(each["frame"]), device=expected.frame.device)
    several = Strips(**each | {"frame": view[:, None]}).listed(torch.ones_like(each["valid"]))
    straight, _ = trace.straighten(trace.walk(picture, several, settings))
    traced = trace.trace(picture, straight, settings)
    keep = each["valid"].reshape(-1, picture.views)
    scores = keep.to(traced.width.dtype)
    everywhere, verdict = torch.ones_like(keep), judge_strips(small, traced.strips)
    number, lit = view[None] // picture.views, picture.lit(traced.strips)
    return StripCandidates(traced, number, lit, everywhere, scores, verdict)


def trace_near(
    images: Tensor, canvas: Canvas, settings: DetectorSettings, expected: Strips, keep: Bool[Tensor, "b k"]
) -> StripCandidates:
    """Contours near strips where shafts are known to be about, in the dark view of a picture of half the size; ranks
    are those of the expected ones.

    Whether a shaft is there is left to who measures them: nothing is ranked or left out here.

    Args:
        images: (b, 3, H, W), uint8 or floating point in [0, 1].
        canvas: a small picture's place, of pixels `COARSER` times those of the search.
        settings: limits of width, contrast, convergence.
        expected: one list (1, m), at least one.
        keep: which ranks of which pictures are in the list.
    """
    small = small_views(images, canvas, settings, 1)
    traced = trace.trace(small.picture, expected, settings)
    # The network knows strips whose contours lie at their own place.
    straight, _ = trace.straighten(traced)
    verdict, lit = judge_strips(small, straight), small.picture.lit(straight)
    return StripCandidates(traced, straight.frame, lit, keep, keep.to(traced.width.dtype), verdict)
