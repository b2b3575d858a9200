"""Cameras with a lens model (lens_profiles.py), and the stereo rig. Every projection says where it is valid."""

from dataclasses import dataclass
from functools import cached_property

import torch
from jaxtyping import Bool, Float
from torch import Tensor

from rmis_calib.errors import InputError, ShapeError
from rmis_calib.geometry.lens_models import COEFFICIENTS, LensModel
from rmis_calib.geometry.lens_profiles import PROFILES, fold_radius_squared
from rmis_calib.geometry.rigid import RigidTransform

# Largest undistorted radius x/z that the model is used for: 89.4 degrees off axis. It keeps r^7 finite in single
# precision.
_MAX_RADIUS_SQUARED = 1.0e4
# Newton needs 4 to 7 steps for endoscope lenses; near the fold, where the Jacobian vanishes, it halves the error per
# step.
_NEWTON_STEPS = 30


@dataclass(frozen=True, eq=False)
class Camera:
    """Intrinsics of one camera. Pixel (0, 0) is the centre of the top-left pixel.

    Convention: OpenCV. uv = (fx x_d + cx, fy y_d + cy) with (x_d, y_d) the distorted normalised point.

    Raises:
        ShapeError: an intrinsic is not a 0-d tensor, or `distortion` has another number of entries than its model.
        InputError: a focal length or a side of the image is not positive, or something is not finite.
    """

    fx: Tensor
    """Focal length along u, px, 0-d."""
    fy: Tensor
    """Focal length along v, px, 0-d."""
    cx: Tensor
    """Principal point, u, px, 0-d."""
    cy: Tensor
    """Principal point, v, px, 0-d."""
    distortion: Tensor
    """In OpenCV's order: k1, k2, p1, p2, k3 (plumb_bob), the same and k4, k5, k6 (rational_polynomial), or k1 to k4
    (equidistant)."""
    image_size: tuple[int, int]
    """(height, width), px."""
    model: LensModel = "plumb_bob"

    def __post_init__(self) -> None:
        if self.model not in COEFFICIENTS:
            raise InputError(where="camera model", expected=f"one of {', '.join(COEFFICIENTS)}", found=self.model)
        coefficients = (COEFFICIENTS[self.model],)
        for name, shape in {"fx": (), "fy": (), "cx": (), "cy": (), "distortion": coefficients}.items():
            value = getattr(self, name)
            if tuple(value.shape) != shape:
                raise ShapeError(where=f"camera {name}", expected=f"shape {shape}", found=tuple(value.shape))
            if not bool(torch.isfinite(value).all()):
                raise InputError(where=f"camera {name}", expected="finite", found=value.tolist())
        focal_lengths = self._affine()[0].detach()
        if not bool((focal_lengths > 0).all()):
            raise InputError(where="camera fx, fy", expected="positive focal lengths, px", found=focal_lengths.tolist())
        if not (len(self.image_size) == 2 and min(self.image_size) > 0):
            raise InputError(
                where="camera image_size", expected="(height, width), both positive", found=self.image_size
            )

    @classmethod
    def from_values(
        cls,
        fx: float,
        fy: float,
        cx: float,
        cy: float,
        distortion: tuple[float, ...] | list[float] = (0.0, 0.0, 0.0, 0.0, 0.0),
        *,
        image_size: tuple[int, int],
        model: LensModel = "plumb_bob",
        dtype: torch.dtype = torch.float64,
        device: torch.device | str = "cpu",
    ) -> "Camera":
        """Camera from plain numbers; `image_size` is (height, width)."""
        tensors = [torch.tensor(value, dtype=dtype, device=device) for value in (fx, fy, cx, cy, list(distortion))]
        return cls(*tensors, image_size=image_size, model=model)

    @property
    def focal(self) -> Float[Tensor, ""]:
        """Mean focal length, px: turns a small normalised length into pixels."""
        return 0.5 * (self.fx + self.fy)

    @property
    def distorts(self) -> bool:
        """Whether the picture differs from a pinhole camera's."""
        return self.model == "equidistant" or bool((self.distortion != 0).any())

    @cached_property
    def max_radius_squared(self) -> float:
        """Square of the undistorted radius up to which the radial distortion grows; beyond, the image folds back."""
        return min(
            fold_radius_squared(self.model, self.distortion.detach().cpu().double().tolist()), _MAX_RADIUS_SQUARED
        )

    def to(self, dtype: torch.dtype | None = None, device: torch.device | str | None = None) -> "Camera":
        """The same camera in another precision or on another device."""
        values = (self.fx, self.fy, self.cx, self.cy, self.distortion)
        moved = [value.to(dtype=dtype, device=device) for value in values]
        if all(new is old for new, old in zip(moved, values, strict=True)):
            return self  # with what it has computed once
        return Camera(*moved, image_size=self.image_size, model=self.model)

    def corrected(self, focal: float, centre_x: float, centre_y: float, lens: float) -> "Camera":
        """The camera whose undistorted points are `corrected_points` of this one's, to first order.

        Args:
            focal: relative change of the points' scale: the focal length falls by it.
            centre_x, centre_y: shift of the points, in focal lengths.
            lens: growth of the points by r^2 times this: k1, of whatever model, falls by it.
        """
        if not (focal or centre_x or centre_y or lens):
            return self
        fx, fy = self.fx / (1.0 + focal), self.fy / (1.0 + focal)
        only_k1 = torch.zeros_like(self.distortion)
        only_k1[0] = 1.0
        distortion = self.distortion - lens * only_k1
        return Camera(fx, fy, self.cx - centre_x * fx, self.cy - centre_y * fy, distortion, self.image_size, self.model)

    def distort(self, xy: Float[Tensor, "*batch 2"]) -> Float[Tensor, "*batch 2"]:
        """Distorted normalised coordinates. Meaningful where `can_distort` holds."""
        x, y = xy.unbind(-1)
        r2 = x * x + y * y
        radial, _ = PROFILES[self.model](r2, self.distortion)
        if self.model == "equidistant":
            return xy * radial[..., None]
        p1, p2 = self.distortion[2], self.distortion[3]
        x_d = x * radial + 2 * p1 * x * y + p2 * (r2 + 2 * x * x)
        y_d = y * radial + p1 * (r2 + 2 * y * y) + 2 * p2 * x * y
        return torch.stack([x_d, y_d], dim=-1)

    def can_distort(self, xy: Float[Tensor, "*batch 2"]) -> Bool[Tensor, "*batch"]:
        """Whether the distortion is one-to-one out to `xy`: inside the radius of the fold, with a positive Jacobian."""
        jacobian = self._distortion_jacobian(xy)
        inside = (xy * xy).sum(-1) < self.max_radius_squared
        return inside & (torch.linalg.det(jacobian) > 0)

    def pixels(self, xy: Float[Tensor, "*batch 2"]) -> Float[Tensor, "*batch 2"]:
        """Pixels of normalised undistorted points (x/z, y/z)."""
        focal, centre = self._affine()
        return self.distort(xy) * focal + centre

    def project(
        self, camera_p_x: Float[Tensor, "*batch 3"]
    ) -> tuple[Float[Tensor, "*batch 2"], Bool[Tensor, "*batch"]]:
        """Pixels of points in the camera frame, and whether each can be seen at all (inside the image or not).

        Not valid: z <= 0 (its pixel is then the principal point), or beyond the fold of the distortion (its pixel is
        then that of the point where its direction meets the fold). Values and gradients stay finite there.

        Args:
            camera_p_x: points, mm.
        """
        z = camera_p_x[..., 2:]
        in_front = z > 0
        xy = torch.where(in_front, camera_p_x[..., :2] / torch.where(in_front, z, 1.0), 0.0)
        valid = in_front[..., 0] & self.can_distort(xy)
        return self.pixels(self._clamp_radius(xy)), valid

    def undistort_points(
        self, uv: Float[Tensor, "*batch 2"]
    ) -> tuple[Float[Tensor, "*batch 2"], Bool[Tensor, "*batch"]]:
        """Normalised undistorted coordinates (x/z, y/z) of pixels, and whether the distortion has an inverse there.

        Newton's method for all points at once. First derivatives with respect to `uv` and to the camera are those of
        the inverse function, from one more step inside the graph.

        Args:
            uv: pixels in the raw image; NaN gives (0, 0) and not valid.
        """
        focal, centre = self._affine()
        distorted = (uv - centre) / focal
        finite = torch.isfinite(distorted).all(-1)
        distorted = torch.where(finite[..., None], distorted, 0.0)
        target = distorted.detach()
        tolerance = 32 * torch.finfo(target.dtype).eps * (1 + target.norm(dim=-1))
        with torch.no_grad():
            xy = self._clamp_radius(target)
            for _ in range(_NEWTON_STEPS):
                xy = self._clamp_radius(xy - self._newton_step(xy, target))
                converged = (self.distort(xy) - target).norm(dim=-1) <= tolerance
                if bool(converged.all()):
                    break
            valid = finite & converged & self.can_distort(xy)
            inverse = _inverse_2x2(self._distortion_jacobian(xy))
        step = (inverse @ (self.distort(xy) - distorted)[..., None])[..., 0]
        return torch.where(valid[..., None], xy - step, xy), valid

    def _affine(self) -> tuple[Float[Tensor, "2"], Float[Tensor, "2"]]:
        return torch.stack([self.fx, self.fy]), torch.stack([self.cx, self.cy])

    def _clamp_radius(self, xy: Float[Tensor, "*batch 2"]) -> Float[Tensor, "*batch 2"]:
        r2 = (xy * xy).sum(-1, keepdim=True)
        outside = r2 > self.max_radius_squared
        scale = (self.max_radius_squared / torch.where(outside, r2, 1.0)).sqrt()
        return torch.where(outside, xy * scale, xy)

    def _newton_step(
        self, xy: Float[Tensor, "*batch 2"], target: Float[Tensor, "*batch 2"]
    ) -> Float[Tensor, "*batch 2"]:
        inverse = _inverse_2x2(self._distortion_jacobian(xy))
        return (inverse @ (self.distort(xy) - target)[..., None])[..., 0]

    def _distortion_jacobian(self, xy: Float[Tensor, "*batch 2"]) -> Float[Tensor, "*batch 2 2"]:
        x, y = xy.unbind(-1)
        radial, radial_slope = PROFILES[self.model](x * x + y * y, self.distortion)
        slope = 2 * radial_slope  # d radial / dx = slope * x
        xx, mixed, yy = radial + slope * x * x, slope * x * y, radial + slope * y * y
        if self.model != "equidistant":
            p1, p2 = self.distortion[2], self.distortion[3]
            xx = xx + 2 * p1 * y + 6 * p2 * x
            mixed = mixed + 2 * p1 * x + 2 * p2 * y
            yy = yy + 6 * p1 * y + 2 * p2 * x
        return torch.stack([xx, mixed, mixed, yy], dim=-1).unflatten(-1, (2, 2))


def _inverse_2x2(matrix: Float[Tensor, "*batch 2 2"]) -> Float[Tensor, "*batch 2 2"]:
    """Inverse, with the determinant kept away from zero: at the fold a Newton step must stay finite."""
    (a, b), (c, d) = (row.unbind(-1) for row in matrix.unbind(-2))
    det = a * d - b * c
    det = torch.where(det.abs() < 1e-6, torch.where(det < 0, -1e-6, 1e-6).to(det.dtype), det)
    adjugate = torch.stack([d, -b, -c, a], dim=-1).unflatten(-1, (2, 2))
    return adjugate / det[..., None, None]


def corrected_point(
    x: Tensor,
    y: Tensor,
    focal: Tensor | float,
    centre_x: Tensor | float,
    centre_y: Tensor | float,
    lens: Tensor | float,
) -> tuple[Tensor, Tensor]:
    """Undistorted points (x, y) of a camera as `Camera.corrected` would have them, to first order; any shapes that
    broadcast."""
    scale = focal + (x * x + y * y) * lens
    return x + (x * scale + centre_x), y + (y * scale + centre_y)


@dataclass(frozen=True, eq=False)
class StereoRig:
    """The right camera, and the left one with its pose where there is one.

    Raises:
        InputError: a left camera without extrinsics, extrinsics without a left camera, or extrinsics of other frames.
    """

    right: Camera
    left: Camera | None = None
    camera_left_T_camera_right: RigidTransform | None = None

    def __post_init__(self) -> None:
        if (self.left is None) != (self.camera_left_T_camera_right is None):
            found = "only one of them"
            raise InputError(where="stereo rig", expected="left and camera_left_T_camera_right together", found=found)
        extrinsics = self.camera_left_T_camera_right
        if extrinsics is not None and (extrinsics.dst, extrinsics.src) != ("camera_left", "camera_right"):
            raise InputError(where="stereo rig", expected="camera_left_T_camera_right", found=extrinsics.name)

    def to(self, dtype: torch.dtype | None = None, device: torch.device | str | None = None) -> "StereoRig":
        """The same rig in another precision or on another device."""
        left = None if self.left is None else self.left.to(dtype, device)
        extrinsics = self.camera_left_T_camera_right
        return StereoRig(
            self.right.to(dtype, device), left, None if extrinsics is None else extrinsics.to(dtype, device)
        )
