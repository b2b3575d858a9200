"""Pinhole camera with Brown-Conrady distortion, float64 NumPy, written apart from the calibration's own.

Convention: pixel (0, 0) is the centre of the top-left pixel; uv = (column, row); normalised image
coordinates are x/z, y/z.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from data_synth.kinematics import Array
from data_synth.settings_picture import CameraSettings, IntrinsicsSettings

Bounds = tuple[float, float, float, float]
"""x_min, y_min, x_max, y_max in undistorted normalised coordinates."""


@dataclass(frozen=True)
class Camera:
    """Intrinsics in pixels; distortion is k1, k2, p1, p2, k3."""

    width: int
    height: int
    fx: float
    fy: float
    cx: float
    cy: float
    distortion: tuple[float, float, float, float, float]

    def distort(self, xy: Array) -> tuple[Array, Array]:
        """Distorted normalised coordinates (..., 2) of undistorted ones, and the Jacobian (..., 2, 2) of that map."""
        k1, k2, p1, p2, k3 = self.distortion
        x, y = xy[..., 0], xy[..., 1]
        r2 = x * x + y * y
        radial = 1.0 + r2 * (k1 + r2 * (k2 + r2 * k3))
        slope = k1 + r2 * (2.0 * k2 + 3.0 * r2 * k3)  # d radial / d r2
        distorted = np.stack(
            [
                x * radial + 2.0 * p1 * x * y + p2 * (r2 + 2.0 * x * x),
                y * radial + p1 * (r2 + 2.0 * y * y) + 2.0 * p2 * x * y,
            ],
            axis=-1,
        )
        cross = 2.0 * x * y * slope + 2.0 * p1 * x + 2.0 * p2 * y
        xx = radial + 2.0 * x * x * slope + 2.0 * p1 * y + 6.0 * p2 * x
        yy = radial + 2.0 * y * y * slope + 6.0 * p1 * y + 2.0 * p2 * x
        return distorted, np.stack([np.stack([xx, cross], -1), np.stack([cross, yy], -1)], axis=-2)

    def pixels(self, xy: Array) -> Array:
        """Pixels (..., 2) where undistorted normalised coordinates (..., 2) appear."""
        return self.distort(xy)[0] * [self.fx, self.fy] + [self.cx, self.cy]

    def project(self, p: Array) -> Array:
        """Pixels (..., 2) of points (..., 3), mm; NaN behind the camera."""
        z = np.where(p[..., 2:] > 1e-6, p[..., 2:], np.nan)
        return self.pixels(p[..., :2] / z)

    def rays(self, uv: Array) -> tuple[Array, Array]:
        """Undistorted normalised coordinates (..., 2) seen by pixels (..., 2), and their Jacobian (..., 2, 2) by the
        pixel.

        Raises:
            ValueError: the distortion cannot be inverted at one of the pixels.
        """
        target = (uv - [self.cx, self.cy]) / [self.fx, self.fy]
        xy = target.copy()
        for _ in range(30):
            distorted, jacobian = self.distort(xy)
            step = np.linalg.solve(jacobian, (target - distorted)[..., None])[..., 0]
            # Newton overshoots where strong barrel distortion flattens out; a bounded step stays on the right branch.
            xy = xy + step * np.minimum(1.0, 0.3 / np.maximum(np.linalg.norm(step, axis=-1, keepdims=True), 1e-12))
            if np.abs(step).max() < 1e-13:
                break
        distorted, jacobian = self.distort(xy)
        if np.abs(distorted - target).max() > 1e-10 or np.linalg.det(jacobian).min() <= 0.0:
            raise ValueError(f"distortion: expected an invertible model over the picture, found {self.distortion}")
        return xy, np.linalg.inv(jacobian) / [self.fx, self.fy]

    def bounds(self) -> Bounds:
        """Largest upright rectangle about the axis that is certainly in the picture: through the middles of its
        sides."""
        right, bottom = self.width - 0.5, self.height - 0.5
        sides = np.array([[-0.5, self.cy], [self.cx, -0.5], [right, self.cy], [self.cx, bottom]])
        xy, _ = self.rays(sides)
        return float(xy[0, 0]), float(xy[1, 1]), float(xy[2, 0]), float(xy[3, 1])

    def extent(self) -> Bounds:
        """Upright rectangle that holds the whole picture."""
        u, v = np.linspace(-0.5, self.width - 0.5, 33), np.linspace(-0.5, self.height - 0.5, 33)
        border = [np.stack([u, np.full(33, v[i])], -1) for i in (0, -1)] + [
            np.stack([np.full(33, u[i]), v], -1) for i in (0, -1)
        ]
        xy, _ = self.rays(np.concatenate(border))
        return float(xy[:, 0].min()), float(xy[:, 1].min()), float(xy[:, 0].max()), float(xy[:, 1].max())

    def contains(self, uv: Array) -> NDArray[np.bool_]:
        """Whether pixels (..., 2) are inside the picture; False for NaN."""
        with np.errstate(invalid="ignore"):
            return np.all((uv >= -0.5) & (uv <= [self.width - 0.5, self.height - 0.5]), axis=-1)

    def to_dict(self) -> dict:
        """The camera as an entry of stereo.yaml."""
        return {"fx": self.fx, "fy": self.fy, "cx": self.cx, "cy": self.cy, "distortion": list(self.distortion)}


def build_camera(settings: CameraSettings, intrinsics: IntrinsicsSettings) -> Camera:
    """Camera of the settings."""
    i = intrinsics
    return Camera(settings.width_px, settings.height_px, i.fx_px, i.fy_px, i.cx_px, i.cy_px, i.distortion)
