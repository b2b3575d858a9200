"""Where an edge lies, to a fraction of a pixel, as a differentiable function of the picture's pixels.

Plain torch for any leading batch and any precision: gradients pass from the points to the picture, so that the
derivative of an answer by pixels exists (`rc.solve(..., differentiable=True)`). The detector runs the same estimator
(vision/fine/edges.py); what it decides (which edge, how soft, along which colour) has no derivative, and is given here.
"""

import torch
from jaxtyping import Float
from torch import Tensor

from rmis_calib.vision.image.sampling import sample

# Ridge on the two slopes: enough to keep the system regular where a contour is flat, too little to bias its place.
_SLOPE_RIDGE = 0.02


def step_columns(offsets: Float[Tensor, "*#b d"], blur: Float[Tensor, "*#b"]) -> Float[Tensor, "*b d 5"]:
    """Columns: level, step, derivative of the step by its place (negated), slope inside, slope outside."""
    z = offsets / blur[..., None]
    step = torch.special.ndtr(z)
    bell = torch.exp(-0.5 * z * z) / (2.5066283 * blur[..., None])
    ramp = offsets * step + blur[..., None] ** 2 * bell  # integral of the step: the outer side's blurred slope
    return torch.stack([torch.ones_like(step), step, bell, ramp - offsets, ramp], -1)


def step_estimator(offsets: Float[Tensor, "*#b d"], blur: Float[Tensor, "*#b"]) -> Float[Tensor, "*b 5 d"]:
    """Least-squares solution as a matrix, with a weak prior that slopes are small and a window around the step."""
    columns = step_columns(offsets, blur)
    reach = (2.5 * blur + 1.0)[..., None]
    window = torch.exp(-0.5 * (offsets / reach).square().square())[..., None]
    weighted = (columns * window).mT
    prior = torch.diag(offsets.new_tensor([0.0, 0.0, 0.0, 1.0, 1.0])) * _SLOPE_RIDGE
    return torch.linalg.solve(weighted @ columns + prior, weighted)


def step_place(
    profile: Float[Tensor, "*#batch d"], blur: Float[Tensor, "*#batch"], newton_steps: int = 4
) -> Float[Tensor, "*batch"]:
    """Place of a blurred step in a profile, in its own steps from its middle; positive towards its end.

    The step is linearised about its place: a linear least-squares solve says how far off that is, and the next one is
    about there. The detector, whose profiles are centred on the edge, takes one.

    Args:
        profile: brightness at evenly spaced points across the edge, an odd number of them.
        blur: standard deviation of the step's blur, in steps of the profile.
        newton_steps: how often to linearise.
    Returns:
        where the level is half-way between the two sides, slopes on both sides allowed for; no number, or any, where
        the profile has no step.
    """
    count = profile.shape[-1]
    offsets = torch.arange(count, dtype=profile.dtype, device=profile.device) - 0.5 * (count - 1)
    place = (profile[..., 0] * blur).new_zeros(torch.broadcast_shapes(profile.shape[:-1], blur.shape))
    for _ in range(newton_steps):
        solve = step_estimator(offsets - place[..., None], blur)[..., 1:3, :]
        height, bell = (solve @ profile[..., None])[..., 0].unbind(-1)
        place = place - bell / height
    return place


def edge_points(
    picture: Float[Tensor, "h w"],
    uv: Float[Tensor, "*points 2"],
    across: Float[Tensor, "*#points 2"],
    step_px: float,
    blur_px: float,
    samples: int = 13,
) -> Float[Tensor, "*points 2"]:
    """The points moved along `across` onto the edge: pixel coordinates, differentiable by the picture.

    Args:
        picture: one channel, any scale; pixel (0, 0) is the centre of the top-left pixel.
        uv: points near the edge: within a blur or two of it.
        across: unit direction across the edge, from either side.
        step_px: distance of the profile's samples.
        blur_px: standard deviation of the edge's blur.
        samples: of a profile, odd.
    """
    offsets = (torch.arange(samples, dtype=uv.dtype, device=uv.device) - 0.5 * (samples - 1)) * step_px
    at = uv[..., None, :] + offsets[:, None] * across[..., None, :]
    profile = sample(picture[None], at[..., 0], at[..., 1])[0]
    blur = torch.full_like(profile[..., 0], blur_px / step_px)
    return uv + step_px * step_place(profile, blur)[..., None] * across
