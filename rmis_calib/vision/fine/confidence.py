"""How likely a traced and measured strip is a shaft with both contours right: a logistic regression on nine features.

Six are of the contours, three of the network of strips (coarse/strip_network.py). What the network says for a shaft
counts everywhere: none of the 137 strips of the real frames to which it gives log odds above `_SURE` is wrong. What it
says against one counts only where contours deceive: in what is tinted like a cavity, and in the lit view, in which
white fat is as neutral as a shaft. Elsewhere it refuses real shafts, 4 of 15 in a recording with balls on the tube.
"""

import torch
from jaxtyping import Bool, Float
from torch import Tensor

from rmis_calib.vision.coarse.trace import Trace
from rmis_calib.vision.detections import CLOSED_CONFIDENCE
from rmis_calib.vision.image.line_fit import LineFit

# Fitted by tests/benchmarks/fit_confidence.py --frames 4 --benches 4: twelve presets and benches (seeds 1001 to 1006)
# and the labelled real frames, each in one view and in two, 1,454 candidates. Each set of real frames judged by a fit
# to the others: mean loss 0.204, without the network 0.218; benches 1.644 and 1.738, presets 0.145 and 0.140.
_BASE = -6.41
_WEIGHTS = (-2.21, 1.44, 0.62, 3.37, 1.04, -2.83, 0.81, -1.98, -1.07)
# Product of features, each 0 to 1: without this gate twice as many strips of the real frames are false.
_LEAST_PLAUSIBILITY = 0.3
# Log odds of the network: from where they speak for a shaft, by how much they can at most, where they are sure; and
# below which they speak against one, and by how much at most.
_FOR, _MOST_FOR, _SURE = 3.0, 6.0, 6.0
_AGAINST, _MOST_AGAINST = 6.0, 8.0
# Of 168 candidates below this evenness 14 are right, and those have no tissue beside them.
_EVEN, _UNEVEN_PROBABILITY = 0.4, 0.6
_WANDER_FLOOR = 0.003
"""Share of the width below which less wander makes no shaft more certain."""


def features(
    trace: Trace,
    fit: LineFit,
    share: Float[Tensor, "b k"],
    reach_px: float,
    network: Float[Tensor, "b k"],
    lit: Bool[Tensor, "b k"],
) -> tuple[Float[Tensor, "b k"], ...]:
    """What the probability depends on; every one is free of the picture's size.

    Args:
        trace: of the small picture.
        fit: lines at full resolution.
        share: of the points offered to the worse line, those that carry it.
        reach_px: the picture's diagonal.
        network: log odds that the network gives for a shaft.
        lit: strips of the lit view.
    """
    width = trace.width.clamp(min=1.0)
    # Shafts of the real frames reach 0.44 where tissue reflects on them, cavities of tissue start at 0.47.
    like_cavity = _sigmoid((trace.tint - 0.42) / 0.04)
    against = (_AGAINST - network).clamp(0.0, _MOST_AGAINST) / _AGAINST
    return (
        # Contours of a cavity wander by a twentieth of its width and more.
        (fit.wander_px.amax(-1) / width + _WANDER_FLOOR).log(),
        trace.start_at_border.to(width.dtype),
        trace.sides.all(2).sum(-1) / trace.on.sum(-1).clamp(min=1),
        share.clamp(min=0.05).log(),
        (trace.length / reach_px).clamp(min=0.01).log(),
        like_cavity,
        # Half of a shaft, between a contour and a stripe of glare, looks like a whole one.
        (network - _FOR).clamp(0.0, _MOST_FOR) / 4 * (trace.evenness >= _EVEN),
        like_cavity * against,
        lit * against,
    )


def probability(of: tuple[Float[Tensor, "b k"], ...]) -> Float[Tensor, "b k"]:
    """The probability that both lines are a shaft's contours to within three times their uncertainty, or 3 px."""
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


def plausible(
    trace: Trace, fit: LineFit, share: Float[Tensor, "b k"], reach_px: float, network: Float[Tensor, "b k"]
) -> Bool[Tensor, "b k"]:
    """Whether enough speaks for a shaft: contrast, length, agreement of the points and the border, all at once; or the
    network is sure, of a short piece between the border and a wrist, or one out of focus.

    Args:
        trace: of the small picture.
        fit: lines at full resolution.
        share: of the points offered to the worse line, those that carry it.
        reach_px: the picture's diagonal.
        network: log odds that the network gives for a shaft.
    """
    contrast = trace.contrast / (trace.contrast + 0.08)
    length = 1 - torch.exp(-1.2 * trace.length / trace.width.clamp(min=1.0))
    # Contours of a cavity wander by a twentieth of its width and more; those of a shaft out of focus by half of that.
    agreement = 1 / (1 + (fit.wander_px.amax(-1) / (1.0 + 0.035 * trace.width)).square().square())
    border = torch.where(trace.start_at_border, 1.0, 0.45)
    # A short dark bar at the border may be anything; a long one is rarely furniture.
    size = 1 - torch.exp(-trace.length / (0.12 * reach_px))
    together = contrast * length * agreement * border * size * (share / 0.6).clamp(max=1.0)
    return (together > _LEAST_PLAUSIBILITY) | (network > _SURE)
