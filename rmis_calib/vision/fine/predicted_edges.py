"""Where pictures show an edge near contours that something else predicts: how far off, how sure, or nothing.

The picture alone decides. Profiles are read across the predicted contour; of all places within reach, none of which is
preferred, the steepest rise outwards counts, if a blurred step with a slope on each side explains it much better than
noise and texture do. A shaft is dark in every colour, so the profile is that of the brightest channel.
"""

from dataclasses import dataclass

import torch
from jaxtyping import Bool, Float
from torch import Tensor

from rmis_calib.geometry import Camera
from rmis_calib.vision.fine.edges import steepest
from rmis_calib.vision.fine.subpixel import step_columns, step_estimator
from rmis_calib.vision.image.pixel_mapping import Lens
from rmis_calib.vision.image.sampling import FullPicture

_REACH, _WINDOW = 16, 6
"""Steps to either side of a contour that are searched, and of an edge that are compared with a step."""
_STEP_WIDTHS = 1 / 1000
"""A step in widths of the picture, where that is more than a pixel."""
_LEAST_SPACING = 0.4
"""Of the distance of both contours, what is searched: beyond lies the other half of the shaft."""
_BLURS = (0.6, 0.8, 1.05, 1.4, 1.9, 2.5, 3.3)
"""Blurs tried, in steps."""
_GRID, _MOST_GRID, _ROUNDS = 0.1, 15, 3
"""A step is linear in its place over a part of its blur: places that it is linearised about, in steps, how many to
either side of the middle, and how often the nearest one is taken."""
_LEAST_HEIGHT, _LEAST_CONTRAST = 0.03, 5.0
"""Height of a step that is an edge: of full scale, and in what the step does not explain of the profile (rms)."""
_LEVEL = 0.004
"""Smallest noise of a profile: a level of 255."""
_LARGEST_SHIFT, _LARGEST_SIGMA = 0.5, 0.5
"""Of the place of an edge from where the step was linearised last, and of its uncertainty, in steps."""


@dataclass(frozen=True, eq=False)
class PredictedEdges:
    """What m pictures show at s stations along both contours, [left, right].

    Attributes:
        px: distance of the edge from the contour, positive outwards (the shaft is wider than predicted), in pixels of
            the undistorted picture; NaN where there is no edge.
        sigma_px: its standard deviation; NaN likewise.
        looked: whether the picture could show an edge there: all of the profile lies in it.
        uv: the stations, raw px.
    """

    px: Float[Tensor, "m 2 s"]
    sigma_px: Float[Tensor, "m 2 s"]
    looked: Bool[Tensor, "m 2 s"]
    uv: Float[Tensor, "m 2 s 2"]


def edges_at(images: Float[Tensor, "m 3 h w"] | Tensor, camera: Camera, xy: Float[Tensor, "m 2 s 2"]) -> PredictedEdges:
    """Edges near predicted contours.

    Args:
        images: RGB, uint8 or single precision in [0, 1].
        camera: which took them, with its lens.
        xy: stations in normalised undistorted coordinates (x/z, y/z), from the RCM to the tip on a straight line; NaN
            where there is none.
    """
    lens = Lens(camera)
    focal, centre = torch.stack([camera.fx, camera.fy]), torch.stack([camera.cx, camera.cy])
    ideal = (xy * focal + centre).float()
    along = torch.nn.functional.normalize(ideal[:, :, -1] - ideal[:, :, 0], dim=-1)
    left = torch.stack([along[..., 1], -along[..., 0]], dim=-1)
    outward = left * left.new_tensor([1.0, -1.0])[:, None]
    step_px = max(1.0, images.shape[-1] * _STEP_WIDTHS)
    decoded = images.contiguous(memory_format=torch.channels_last)
    picture = FullPicture(decoded, torch.arange(len(images), device=images.device)[:, None], lens)
    half = _REACH + _WINDOW
    offsets = torch.arange(-half, half + 1, device=ideal.device, dtype=ideal.dtype) * step_px
    colours, looked = picture.read_across(ideal[:, None], outward[:, None], offsets.expand(len(images), 1, 2, -1))
    profile, looked = colours[:, :, 0].amax(0), looked[:, 0]  # (m, 2, s, d)
    place, sigma, is_edge = _strongest_step(profile)
    spacing_px = (ideal[:, 0] - ideal[:, 1]).norm(dim=-1)[:, None]
    found = looked & is_edge & (place.abs() * step_px < _LEAST_SPACING * spacing_px)
    off, sigma = (torch.where(found, value * step_px, torch.nan) for value in (place, sigma))
    return PredictedEdges(off, sigma, looked, lens.to_raw(ideal))


def _strongest_step(
    profile: Float[Tensor, "m 2 s d"],
) -> tuple[Float[Tensor, "m 2 s"], Float[Tensor, "m 2 s"], Bool[Tensor, "m 2 s"]]:
    """Place of the steepest rise, in steps from the middle, its standard deviation, and whether it is an edge."""
    margin = _WINDOW - 2  # `steepest` looks two steps to either side itself
    rise, _ = steepest(profile[..., margin:-margin])
    nearest = rise.round()
    window = torch.arange(-_WINDOW, _WINDOW + 1, device=profile.device)
    at = nearest.long().clamp(-_REACH, _REACH)[..., None] + window + (_REACH + _WINDOW)
    nearby = profile.gather(-1, at)
    blur = profile.new_tensor(_BLURS)[:, None]
    shifts = torch.arange(-_MOST_GRID, _MOST_GRID + 1, device=profile.device, dtype=profile.dtype) * _GRID
    offsets = (window - shifts[:, None]).expand(len(_BLURS), -1, -1)
    blurs = blur.expand(-1, len(shifts))
    solve, columns = step_estimator(offsets, blurs), step_columns(offsets, blurs)  # (n, g, 5, d), (n, g, d, 5)
    unexplained = torch.eye(len(window), dtype=profile.dtype, device=profile.device) - columns @ solve  # (n, g, d, d)
    grid = at = torch.full_like(nearest, _MOST_GRID, dtype=torch.int64)
    best, height, rest, noise = at, nearest, nearest, nearest
    for _ in range(_ROUNDS):
        at = grid
        misfit, best = (unexplained[:, at] @ nearby[..., None])[..., 0].square().sum(-1).min(0)  # over the blurs
        noise = misfit.div(len(window) - columns.shape[-1]).sqrt().clamp_min(_LEVEL)
        height, bell = (solve[best, at, 1:3] @ nearby[..., None])[..., 0].unbind(-1)
        rest = -bell / height.clamp_min(1e-3)
        grid = ((shifts[at] + rest) / _GRID).round().clamp(-_MOST_GRID, _MOST_GRID).long() + _MOST_GRID
    sigma = noise * solve[best, at, 2].norm(dim=-1) / height.clamp_min(1e-3)
    place = nearest + shifts[at] + rest
    stands_out = (height > _LEAST_HEIGHT) & (height > _LEAST_CONTRAST * noise)
    placed = (rest.abs() < _LARGEST_SHIFT) & (sigma < _LARGEST_SIGMA) & (place.abs() <= _REACH)
    return place, sigma, stands_out & placed
