"""Ideal pixels: where a pinhole camera without distortion would have drawn a point of the raw picture.

Contours are straight only after undistortion. The picture itself is never resampled: edge coordinates are moved to
ideal pixels, lines live there, and samples are read at the raw pixel that belongs to an ideal one.
"""

from dataclasses import dataclass, field
from functools import cached_property

import torch
from jaxtyping import Bool, Float
from torch import Tensor

from rmis_calib.geometry import Camera


@dataclass(frozen=True)
class Lens:
    """Raw <-> ideal <-> normalised coordinates; without a camera, all three are pixels."""

    camera: Camera | None
    _copies: dict[tuple[torch.dtype, torch.device], Camera] = field(default_factory=dict, compare=False, repr=False)

    @cached_property
    def distorts(self) -> bool:
        """Whether raw and ideal pixels differ."""
        return self.camera is not None and self.camera.distorts

    @property
    def focal_px(self) -> float:
        """Mean focal length; 1 without a camera, so that normalised units are pixels."""
        return 1.0 if self.camera is None else float(self.camera.focal)

    def _like(self, points: Tensor, camera: Camera) -> Camera:
        """The camera in the points' precision and on their device, converted once."""
        key = (points.dtype, points.device)
        if key not in self._copies:
            self._copies[key] = camera.to(dtype=points.dtype, device=points.device)
        return self._copies[key]

    def _intrinsics(self, like: Tensor) -> tuple[Tensor, Tensor]:
        if self.camera is None:
            return like.new_ones(2), like.new_zeros(2)
        camera = self._like(like, self.camera)
        return torch.stack([camera.fx, camera.fy]), torch.stack([camera.cx, camera.cy])

    def normalise(self, ideal: Float[Tensor, "*points 2"]) -> Float[Tensor, "*points 2"]:
        """Ideal pixels to normalised undistorted coordinates (x/z, y/z)."""
        focal, centre = self._intrinsics(ideal)
        return (ideal - centre) / focal

    def to_ideal_lines(self, lines: Float[Tensor, "*lines 3"]) -> Float[Tensor, "*lines 3"]:
        """Lines a x + b y + c = 0 in normalised undistorted coordinates, as lines in ideal pixels of the same sides."""
        focal, centre = self._intrinsics(lines)
        normal = lines[..., :2] / focal
        return torch.cat([normal, lines[..., 2:] - (normal * centre).sum(-1, keepdim=True)], -1)

    def to_raw(self, ideal: Float[Tensor, "*points 2"]) -> Float[Tensor, "*points 2"]:
        """Ideal pixels to raw pixels."""
        if self.camera is None or not self.distorts:
            return ideal
        return self._like(ideal, self.camera).pixels(self.normalise(ideal))

    def to_ideal(self, raw: Float[Tensor, "*points 2"]) -> Float[Tensor, "*points 2"]:
        """Raw pixels to ideal pixels; NaN where the distortion has no inverse."""
        if self.camera is None or not self.distorts:
            return raw
        focal, centre = self._intrinsics(raw)
        xy, valid = self._like(raw, self.camera).undistort_points(raw)
        return torch.where(valid[..., None], xy * focal + centre, torch.nan)

    def is_regular(self, ideal: Float[Tensor, "*points 2"]) -> Bool[Tensor, "*points"]:
        """Whether the distortion is one-to-one out to these points; beyond, raw pixels mean something else."""
        if self.camera is None or not self.distorts:
            return torch.ones_like(ideal[..., 0], dtype=torch.bool)
        return self._like(ideal, self.camera).can_distort(self.normalise(ideal))
