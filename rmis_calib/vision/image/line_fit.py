"""Robust straight lines through contour points, with an honest uncertainty."""

from dataclasses import dataclass

import torch
from jaxtyping import Bool, Float
from torch import Tensor

from rmis_calib.vision.image.run_length import masked_mean

_ITERATIONS = 5
_BLOCKS = 12
# Lines compared at first, and points that are asked about each.
_PAIRS, _VOTERS = 64, 64


@dataclass(frozen=True, eq=False)
class LineFit:
    """y = offset + slope * t, and how well the points agree with it."""

    offset: Float[Tensor, "*b"]
    slope: Float[Tensor, "*b"]
    centre_t: Float[Tensor, "*b"]
    """Weighted mean station: there, offset and slope errors are uncorrelated."""
    spread_t: Float[Tensor, "*b"]
    """Weighted rms of the stations about their mean."""
    scatter_px: Float[Tensor, "*b"]
    """Standard deviation of one of the points that carry the line."""
    wander_px: Float[Tensor, "*b"]
    """Robust standard deviation of all trusted points about the line, whether they carry it or not."""
    sigma_px: Float[Tensor, "*b"]
    """Standard deviation of the line at centre_t - spread_t and at centre_t + spread_t, each."""
    inliers: Float[Tensor, "*b"]
    """Number of points that carry the line."""


def fit_lines(
    t: Float[Tensor, "*b p"],
    y: Float[Tensor, "*b p"],
    weight: Float[Tensor, "*b p"],
    trusted: Bool[Tensor, "*b p"],
    tolerance: Float[Tensor, "*b"],
    floor_px: float,
) -> LineFit:
    """Lines through the points that agree: from the line that most agree with, by least squares with Tukey's biweight
    on a robust scale.

    The uncertainty is the larger of what independent points give and what the means of twelve consecutive blocks
    say: texture, glare and a bent shaft move neighbours together.

    Args:
        t: stations, px.
        y: lateral places, px.
        weight: prior weight of each point, 0 for none.
        trusted: points that set the first lines and the scale; the others join where they agree.
        tolerance: standard deviation of a point that is not astray, px, by which lines are first compared.
        floor_px: smallest standard deviation of one point.
    """
    trusted = trusted & (weight > 0)
    first = _consensus(t, y, weight * trusted, tolerance)
    # About the middle of the trusted points and the first line, numbers are small: sums of squares lose nothing.
    middle = masked_mean(t, trusted)
    from_middle = t - middle[..., None]
    start, incline = first[0] + first[1] * middle, first[1]
    off = y - start[..., None] - incline[..., None] * from_middle
    columns = torch.stack([torch.ones_like(t), from_middle, off, from_middle.square(), from_middle * off], -2)
    near = trusted & (off.abs() < 3 * tolerance[..., None])
    unknown = torch.where(near, 0.0, torch.nan)
    robust = weight * near
    for _ in range(_ITERATIONS):
        centre, mean, slope, variance = _solve(columns, robust)
        residual = off - mean[..., None] - slope[..., None] * (from_middle - centre[..., None])
        scale = (residual.abs() + unknown).nanmedian(-1).values.nan_to_num_().mul_(1.4826).clamp_(min=floor_px)
        robust = weight * (1 - (residual / (4.7 * scale[..., None])).square()).clamp_(min=0.0).square_()
    spread = variance.sqrt()
    wander = torch.where(trusted, residual.abs(), torch.nan).nanmedian(-1).values
    inliers = robust.sum(-1).square() / robust.square().sum(-1).clamp(min=1e-9)
    scatter = ((robust * residual.square()).sum(-1) / robust.sum(-1).clamp(min=1e-9)).sqrt().clamp(min=floor_px)
    independent = scatter * (2.0 / inliers.clamp(min=3.0)).sqrt()
    together = _block_sigma(residual, robust, (from_middle - centre[..., None]) / spread[..., None].clamp(min=1e-6))
    sigma = torch.maximum(independent, together)
    slope = slope + incline
    return LineFit(
        start + mean - slope * (middle + centre) + incline * centre,
        slope,
        middle + centre,
        spread,
        scatter,
        (1.4826 * torch.nan_to_num(wander)).clamp(min=floor_px),
        sigma,
        (robust > 0.1 * weight.clamp(min=1e-9)).sum(-1).to(t.dtype),
    )


def _consensus(
    t: Float[Tensor, "*b p"], y: Float[Tensor, "*b p"], weight: Float[Tensor, "*b p"], tolerance: Float[Tensor, "*b"]
) -> tuple[Float[Tensor, "*b"], Float[Tensor, "*b"]]:
    """Of the lines through pairs of points at least a quarter apart, the one that most points agree with."""
    count = t.shape[-1]
    first = torch.arange(_PAIRS, device=t.device) * (count - 1) // _PAIRS
    apart = count // 4 + (torch.arange(_PAIRS, device=t.device) * 37) % (count // 2)
    second = (first + apart) % count
    run = t[..., second] - t[..., first]
    slope = (y[..., second] - y[..., first]) / torch.where(run.abs() < 1e-3, 1e-3, run)
    offset = y[..., first] - slope * t[..., first]
    usable = (weight[..., first] > 0) & (weight[..., second] > 0) & (run.abs() > 1e-3)
    some = slice(None, None, max(1, count // _VOTERS))
    residual = y[..., None, some] - offset[..., None] - slope[..., None] * t[..., None, some]
    agree = torch.exp(-0.5 * (residual / tolerance[..., None, None]).square()) @ weight[..., some, None]
    best = torch.where(usable, agree[..., 0], -1.0).argmax(-1, keepdim=True)
    return offset.gather(-1, best)[..., 0], slope.gather(-1, best)[..., 0]


def _solve(
    columns: Float[Tensor, "*b 5 p"], weight: Float[Tensor, "*b p"]
) -> tuple[Float[Tensor, "*b"], Float[Tensor, "*b"], Float[Tensor, "*b"], Float[Tensor, "*b"]]:
    """Weighted means of t and y, slope, and variance of t, from the columns 1, t, y, t^2, t y."""
    total, t, y, tt, ty = (columns * weight[..., None, :]).sum(-1).unbind(-1)
    total = total.clamp(min=1e-9)
    t, y = t / total, y / total
    variance = (tt / total - t * t).clamp_(min=0.0)
    return t, y, (ty / total - t * y) / variance.clamp(min=1e-9), variance


def _block_sigma(
    residual: Float[Tensor, "*b p"], weight: Float[Tensor, "*b p"], lever: Float[Tensor, "*b p"]
) -> Float[Tensor, "*b"]:
    """Standard deviation of the line's value at either end point, from sums of weighted residuals over blocks."""
    blocks = (*residual.shape[:-1], _BLOCKS, residual.shape[-1] // _BLOCKS)
    used = blocks[-1] * _BLOCKS
    total = weight.sum(-1).clamp(min=1e-9)
    influence = weight * residual / total[..., None]
    means = influence[..., :used].reshape(blocks).sum(-1)
    tilts = (influence * lever)[..., :used].reshape(blocks).sum(-1)
    return (means.square().sum(-1) + tilts.square().sum(-1)).sqrt()
