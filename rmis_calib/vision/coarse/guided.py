"""Strips where shafts are known to be about, traced on a picture of half the size of that on which they are searched.

Nothing is searched: no edges, no votes, no candidates. Contours of a shaft that is within a fifth of its width of where
it was expected are then measured as after a search, to a fifth of their uncertainty and better.
"""

from jaxtyping import Bool
from torch import Tensor

from rmis_calib.vision.coarse import trace
from rmis_calib.vision.coarse.search import StripCandidates, small_views
from rmis_calib.vision.coarse.straight_pictures import straighten_pictures
from rmis_calib.vision.coarse.strip_network import load_network
from rmis_calib.vision.coarse.strips import Strips
from rmis_calib.vision.image.canvas import Canvas
from rmis_calib.vision.settings import DetectorSettings

COARSER = 2
"""Side of a pixel here, in pixels of the small picture on which strips are searched."""


def trace_near(
    images: Tensor, canvas: Canvas, settings: DetectorSettings, expected: Strips, keep: Bool[Tensor, "b k"]
) -> StripCandidates:
    """Contours near expected strips, in the dark view; ranks are those of the expected ones.

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
    seen = small.seen.to(small.rgb.dtype)
    pictures, chord = straighten_pictures(small.rgb, seen, canvas, straight, straight.frame)
    verdict = load_network(images.device).judge(pictures, chord.flatten(0, 1))
    lit = small.picture.lit(straight)
    return StripCandidates(traced, straight.frame, lit, keep, keep.to(traced.width.dtype), verdict)
