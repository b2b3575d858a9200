"""How likely a traced and measured strip is a shaft with both contours right: a logistic regression on six marks."""

import torch
from jaxtyping import Bool, Float
from torch import Tensor

from rmis_calib.vision.edges import EdgePoints
from rmis_calib.vision.linefit import LineFit
from rmis_calib.vision.trace import Trace

# Fitted as tests/benchmarks/fit_confidence.py does, on nine presets (seeds 1001 to 1006, ten frames each: 930
# candidates) and the labelled real frames (92, counted four times). On seeds 2001 to 2004, which no fit saw: of 287
# lines above 0.85 all are on a shaft and 95 % within three sigma (mean confidence 0.98); of 34 between 0.5 and 0.85,
# 91 % and 47 % (0.70).
_BASE = -14.26
_WEIGHTS = (-2.36, -0.40, 1.82, 1.10, 1.93, 1.02)
# Product of marks, each 0 to 1: without this gate six strips of the real frames were false and not three.
_LEAST_MARK = 0.3
_SCATTER_FLOOR = 0.003
"""Share of the width below which less scatter makes no shaft more certain."""


def marks(
    trace: Trace, fit: LineFit, points: EdgePoints, share: Float[Tensor, "b k"]
) -> tuple[Float[Tensor, "b k"], ...]:
    """What the chance depends on; every one is free of the picture's size.

    Args:
        trace: of the small picture.
        fit: lines at full resolution.
        points: that they were fitted to.
        share: of the points offered to the worse line, those that carry it.
    """
    width = trace.width.clamp(min=1.0)
    return (
        # Contours of a cavity wander by a twentieth of its width and more; and they are soft.
        (fit.scatter_px.amax(-1) / width + _SCATTER_FLOOR).log(),
        (points.blur_px.amax(-1) / width).log(),
        trace.start_at_border.to(width.dtype),
        (trace.length / width).clamp(min=0.1).log(),
        trace.sides.all(2).sum(-1) / trace.on.sum(-1).clamp(min=1),
        share.clamp(min=0.05).log(),
    )


def chance(of: tuple[Float[Tensor, "b k"], ...]) -> Float[Tensor, "b k"]:
    """The chance that both lines are a shaft's contours to within three times their uncertainty."""
    weights = of[0].new_tensor(_WEIGHTS)
    return torch.sigmoid(_BASE + torch.stack(of, -1) @ weights)


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
    agreement = 1 / (1 + (fit.scatter_px.amax(-1) / (1.0 + 0.035 * trace.width)) ** 4)
    border = torch.where(trace.start_at_border, 1.0, 0.45)
    # A short dark bar at the border may be anything; a long one is rarely furniture.
    size = 1 - torch.exp(-trace.length / (0.12 * reach_px))
    return contrast * length * agreement * border * size * (share / 0.6).clamp(max=1.0) > _LEAST_MARK
