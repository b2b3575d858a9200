"""Coarse search: from a batch of pictures to a few strips a frame that may be shafts."""

import math
from dataclasses import dataclass

import torch
from jaxtyping import Bool, Float
from torch import Tensor
from torch.nn.functional import max_pool2d

from rmis_calib.vision import hough, scoring, shaft_mask, strips, trace
from rmis_calib.vision.lens import Lens
from rmis_calib.vision.settings import DetectorSettings

_LINES, _PAIRS = 48, 96
# A ridge below this is texture: 3 per cent of brightness a small pixel.
_MIN_GRADIENT = 0.03


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


def search(
    images: Tensor, lens: Lens, settings: DetectorSettings, count: int
) -> tuple[trace.Trace, Float[Tensor, "b c"], Stages]:
    """The best `count` strips of each frame with their contours traced, their scores, and the stages that led there.

    Args:
        images: (b, 3, H, W), uint8 or floating point in [0, 1].
        lens: raw <-> ideal pixels.
        settings: limits of width, contrast, convergence.
        count: strips wanted a frame.
    """
    height, width = images.shape[-2:]
    factor = max(1, round(width / settings.small_width_px))
    rgb = shaft_mask.shrink(images, factor)
    seen = shaft_mask.field_of_view(rgb, settings.black_level)
    unlike, tone = shaft_mask.unlikeness(rgb, seen)
    ridge, edges = _edges(unlike, seen, lens, factor, (height, width))
    reach = 0.5 * math.hypot(height, width)
    votes = hough.vote(edges, images.shape[0], reach / factor + 2)
    lines = hough.peaks(votes, _LINES)
    layers = torch.stack([unlike, seen.to(unlike.dtype), tone], 1)
    picture = strips.SmallPicture(layers, factor, (height, width), lens, reach)
    lines = strips.snap(picture, hough.HoughLines(lines.normal, lines.rho * factor, lines.votes))
    evidence = scoring.inspect(picture, strips.pair(lines, picture, settings, _PAIRS), settings)
    scores = scoring.score(evidence, settings)
    index, best = scoring.distinct(evidence, scores, count)
    traced = trace.trace(picture, evidence.strips.pick(index), settings)
    # Once more around lines through what was traced: the pair of Hough lines may have followed a short stretch only.
    traced = trace.trace(picture, trace.straighten(traced), settings)
    return traced, best, Stages(rgb, seen, unlike, ridge, votes, lines, evidence, scores)


def _edges(
    unlike: Float[Tensor, "b h w"], seen: Bool[Tensor, "b h w"], lens: Lens, factor: int, image_size: tuple[int, int]
) -> tuple[Bool[Tensor, "b h w"], hough.EdgePixels]:
    """Thin ridges of the gradient that lie well inside the field of view, in ideal small pixels from the centre."""
    gradient = hough.gradients(unlike)
    magnitude = gradient.norm(dim=1)
    within = max_pool2d((~seen)[:, None].to(unlike.dtype), 7, 1, 3)[:, 0] < 0.5
    ridge = hough.thin(magnitude, gradient) & (magnitude > _MIN_GRADIENT) & within
    frame, row, column = ridge.nonzero(as_tuple=True)
    raw = (torch.stack([column, row], -1).to(unlike.dtype) + 0.5) * factor - 0.5
    strength = magnitude[frame, row, column]
    normal = torch.stack([gradient[frame, 0, row, column], gradient[frame, 1, row, column]], -1) / strength[:, None]
    centre = raw.new_tensor([(image_size[1] - 1) / 2, (image_size[0] - 1) / 2])
    ideal = raw
    if lens.distorts:
        ideal, normal = _straighten(raw, normal, lens)
        kept = torch.isfinite(ideal).all(-1)
        frame, ideal, normal, strength = frame[kept], ideal[kept], normal[kept], strength[kept]
    uv = (ideal - centre) / factor
    return ridge, hough.EdgePixels(frame, uv, normal, strength / (strength + 0.15))


def _straighten(
    raw: Float[Tensor, "m 2"], normal: Float[Tensor, "m 2"], lens: Lens
) -> tuple[Float[Tensor, "m 2"], Float[Tensor, "m 2"]]:
    """Edge pixels and normals in ideal pixels; a normal is turned with the edge that it stands on."""
    tangent = torch.stack([-normal[:, 1], normal[:, 0]], -1)
    ideal = lens.to_ideal(raw)
    direction = lens.to_ideal(raw + tangent) - ideal
    direction = direction / direction.norm(dim=-1, keepdim=True).clamp(min=1e-6)
    return ideal, torch.stack([direction[:, 1], -direction[:, 0]], -1)
