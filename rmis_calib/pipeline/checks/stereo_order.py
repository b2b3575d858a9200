"""Whether the right and the left pictures are what they are called: swapped, a shaft lies behind the cameras."""

import torch
from jaxtyping import Float
from torch import Tensor

from rmis_calib.geometry.lines import plane_normal_from_points
from rmis_calib.geometry.rigid import RigidTransform
from rmis_calib.pipeline.motions.association import Choice
from rmis_calib.vision import ShaftDetections

_ALONG_BASELINE = 0.3
"""Sine to the plane of the left axis below which the baseline lies in it, so that a line tells no depth."""
_BEHIND = -1.0 / 2000.0
"""Inverse depth, 1/mm, below which a shaft is behind the cameras: half a metre to 2 m are told from infinity by less
than a pixel of a laparoscope's disparity."""


def inverse_depth(
    camera_left_T_camera_right: Float[Tensor, "4 4"],
    axis_right: Float[Tensor, "m 2 2"],
    axis_left: Float[Tensor, "m 2 2"],
) -> Float[Tensor, " m"]:
    """Inverse depth, 1/mm, in the right camera of the middle of the axis that it shows; NaN where the axis runs along
    the baseline.

    Source: the point R (lambda r) + t of the ray r through that middle lies in the plane n of the left axis.
    Args:
        camera_left_T_camera_right: extrinsics.
        axis_right, axis_left: two points of the axis, normalised undistorted.
    """
    R, t = camera_left_T_camera_right[:3, :3], camera_left_T_camera_right[:3, 3]
    middle = axis_right.mean(-2)
    r = torch.cat([middle, torch.ones_like(middle[:, :1])], dim=-1)
    n = plane_normal_from_points(axis_left[:, 0], axis_left[:, 1])
    across = n @ t
    inverse = -((r @ R.mT) * n).sum(-1) / across
    return torch.where(across.abs() > _ALONG_BASELINE * t.norm(), inverse, torch.nan)


def median_inverse_depth(
    extrinsics: RigidTransform | None,
    found: tuple[ShaftDetections, ...] | list[ShaftDetections],
    choices: tuple[Choice, ...],
) -> float | None:
    """Median over the motions of `inverse_depth`, 1/mm; None for one camera, or where no motion tells it.

    Args:
        extrinsics: `camera_left_T_camera_right`.
        found: detections of the motions, one entry a camera, the right one first.
        choices: candidate of every motion, one entry a camera.
    """
    if extrinsics is None or len(found) < 2:
        return None
    axes = []
    for detections, choice in zip(found, choices, strict=True):
        rows = torch.arange(len(choice.candidate), device=choice.candidate.device)
        axis = detections.axis_xy[rows, choice.candidate.clamp_min(0)].double()
        axes.append(torch.where(choice.taken[:, None, None], axis, torch.nan))
    inverse = inverse_depth(extrinsics.matrix.to(axes[0]), *axes)
    return float(inverse.nanmedian()) if bool(torch.isfinite(inverse).any()) else None


def looks_swapped(inverse_depth: float | None) -> bool:
    """Whether the shaft lies behind the cameras."""
    return inverse_depth is not None and inverse_depth < _BEHIND
