"""How likely a traced and measured strip is a shaft with both contours right: a logistic regression on six features."""

import torch
from jaxtyping import Bool, Float
from torch import Tensor

from rmis_calib.vision.coarse.trace import Trace
from rmis_calib.vision.detections import CLOSED_CONFIDENCE
from rmis_calib.vision.image.line_fit import LineFit

# Fitted as tests/benchmarks/fit_confidence.py does, on eleven presets (seeds 1001 to 1006, ten frames each) and the
# labelled real frames, each in one view and in two: 2,508 candidates. Each seed judged by a fit to the others: of
# 1,368 lines above 0.9, 98 % are right.
_BASE = -9.17
_WEIGHTS = (-2.99, 1.04, 0.96, 3.61, 1.21, -3.3)
# Product of features, each 0 to 1: without this gate twice as many strips of the real frames are false.
_LEAST_PLAUSIBILITY = 0.3
# Of 168 candidates below this evenness 14 are right, and those have no tissue beside them.
_EVEN, _UNEVEN_PROBABILITY = 0.4, 0.6
_WANDER_FLOOR = 0.003
"""Share of the width below which less wander makes no shaft more certain."""


def features(
    trace: Trace, fit: LineFit, share: Float[Tensor, "b k"], reach_px: float
) -> tuple[Float[Tensor, "b k"], ...]:
    """What the probability depends on; every one is free of the picture's size.

    Args:
        trace: of the small picture.
        fit: lines at full resolution.
        share: of the points offered to the worse line, those that carry it.
        reach_px: the picture's diagonal.
    """
    width = trace.width.clamp(min=1.0)
    return (
        # Contours of a cavity wander by a twentieth of its width and more.
        (fit.wander_px.amax(-1) / width + _WANDER_FLOOR).log(),
        trace.start_at_border.to(width.dtype),
        trace.sides.all(2).sum(-1) / trace.on.sum(-1).clamp(min=1),
        share.clamp(min=0.05).log(),
        (trace.length / reach_px).clamp(min=0.01).log(),
        # Shafts of the real frames reach 0.44 where tissue reflects on them, cavities of tissue start at 0.47.
        _sigmoid((trace.tint - 0.42) / 0.04),
    )


def probability(of: tuple[Float[Tensor, "b k"], ...]) -> Float[Tensor, "b k"]:
    """The probability that both lines are a shaft's contours to within three times their uncertainty."""
    weights = of[0].new_tensor(_WEIGHTS)
    return _sigmoid(_BASE + (torch.stack(of, -1) * weights).sum(-1))


def _sigmoid(x: Float[Tensor, "b k"]) -> Float[Tensor, "b k"]:
    """As torch's, which computes the last few elements of a tensor otherwise than the rest: a frame must not depend on
    which others are in its batch."""
    return 1 / (1 + (-x).exp())


def capped(certain: Float[Tensor, "b k"], trace: Trace) -> Float[Tensor, "b k"]:
    """The probability, limited where only one side is tissue: half of a shaft, between a contour and a stripe of glare,
    is as straight as the whole; and where the dark thing does not come from the border."""
    certain = torch.where(trace.evenness < _EVEN, certain.clamp(max=_UNEVEN_PROBABILITY), certain)
    return torch.where(trace.closed, certain.clamp(max=CLOSED_CONFIDENCE), certain)


def plausible(trace: Trace, fit: LineFit, share: Float[Tensor, "b k"], reach_px: float) -> Bool[Tensor, "b k"]:
    """Whether enough speaks for a shaft: contrast, length, agreement of the points and the border, all at once.

    Args:
        trace: of the small picture.
        fit: lines at full resolution.
        share: of the points offered to the worse line, those that carry it.
        reach_px: the picture's diagonal.
    """
    contrast = trace.contrast / (trace.contrast + 0.08)
    length = 1 - torch.exp(-1.2 * trace.length / trace.width.clamp(min=1.0))
    # Contours of a cavity wander by a twentieth of its width and more; those of a shaft out of focus by half of that.
    agreement = 1 / (1 + (fit.wander_px.amax(-1) / (1.0 + 0.035 * trace.width)).square().square())
    border = torch.where(trace.start_at_border, 1.0, 0.45)
    # A short dark bar at the border may be anything; a long one is rarely furniture.
    size = 1 - torch.exp(-trace.length / (0.12 * reach_px))
    return contrast * length * agreement * border * size * (share / 0.6).clamp(max=1.0) > _LEAST_PLAUSIBILITY
