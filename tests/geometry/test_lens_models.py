"""The rational and the fisheye model against OpenCV, out to where they fold."""

import math

import cv2
import numpy as np
import pytest
import torch
from torch import Tensor
from torch.autograd import gradcheck

from rmis_calib.errors import ShapeError
from rmis_calib.geometry import Camera
from rmis_calib.geometry.cameras import corrected_point
from rmis_calib.geometry.lens_models import LensModel

INTRINSICS = (812.0, 795.0, 315.5, 251.25)
LENSES: dict[str, tuple[LensModel, list[float]]] = {
    "rational": ("rational_polynomial", [0.41, -0.12, 1.5e-3, -8e-4, 0.05, 0.72, 0.09, 0.11]),
    "rational, denominator only": ("rational_polynomial", [0.0, 0.0, 0.0, 0.0, 0.0, 0.35, 0.02, 0.0]),
    "fisheye": ("equidistant", [0.06, -0.04, 0.02, -0.006]),
    "ideal fisheye": ("equidistant", [0.0, 0.0, 0.0, 0.0]),
}


def camera(lens: str, dtype: torch.dtype = torch.float64) -> Camera:
    model, distortion = LENSES[lens]
    return Camera.from_values(*INTRINSICS, distortion, image_size=(480, 640), dtype=dtype, model=model)


def scene(count: int = 500, half_angle_deg: float = 45.0) -> Tensor:
    """Points 30 to 200 mm ahead, within a cone, the first on the axis."""
    generator = torch.Generator().manual_seed(5)
    z = 30 + 170 * torch.rand(count, generator=generator, dtype=torch.float64)
    radius = math.tan(math.radians(half_angle_deg)) * torch.rand(count, generator=generator, dtype=torch.float64)
    radius[:3] = torch.tensor([0.0, 1e-9, 0.0999], dtype=torch.float64)
    angle = 2 * math.pi * torch.rand(count, generator=generator, dtype=torch.float64)
    return torch.stack([z * radius * angle.cos(), z * radius * angle.sin(), z], dim=-1)


def opencv_pixels(lens: str, points: np.ndarray) -> np.ndarray:
    fx, fy, cx, cy = INTRINSICS
    K = np.array([[fx, 0, cx], [0, fy, cy], [0, 0, 1]])
    model, distortion = LENSES[lens]
    if model == "equidistant":
        uv, _ = cv2.fisheye.projectPoints(points[:, None], np.zeros(3), np.zeros(3), K, np.array(distortion))
    else:
        uv, _ = cv2.projectPoints(points, np.zeros(3), np.zeros(3), K, np.array(distortion))
    return uv.reshape(-1, 2)


@pytest.mark.parametrize("lens", LENSES)
def test_project_agrees_with_opencv(lens: str) -> None:
    points = scene()
    uv, valid = camera(lens).project(points)
    assert bool(valid.all())
    np.testing.assert_allclose(uv.numpy(), opencv_pixels(lens, points.numpy()), rtol=0, atol=1e-9)


@pytest.mark.parametrize("lens", LENSES)
def test_undistort_inverts_what_opencv_projects(lens: str) -> None:
    points = scene()
    xy, valid = camera(lens).undistort_points(torch.from_numpy(opencv_pixels(lens, points.numpy())))
    assert bool(valid.all())
    torch.testing.assert_close(xy, points[:, :2] / points[:, 2:], rtol=0, atol=1e-11)


def test_convention_order_of_the_rational_model() -> None:
    # (k1, k2, p1, p2, k3, k4, k5, k6): k4 is a denominator. x = 0.5, s = 0.25: 0.5 / (1 + 0.1 * 0.25).
    # Counter-literal: as a term of the numerator it would be 0.5 * (1 + 0.1 * 0.25^4) = 0.500195.
    lens = Camera.from_values(
        1.0, 1.0, 0.0, 0.0, [0.0, 0.0, 0.0, 0.0, 0.0, 0.1, 0.0, 0.0], image_size=(1, 1), model="rational_polynomial"
    )
    found = lens.distort(torch.tensor([0.5, 0.0], dtype=torch.float64))
    torch.testing.assert_close(found, torch.tensor([0.5 / 1.025, 0.0], dtype=torch.float64))


def test_convention_an_ideal_fisheye_draws_the_angle() -> None:
    # At 45 deg x/z = 1 and the picture shows pi/4. Counter-literal: a pinhole would show 1.
    lens = camera("ideal fisheye")
    found = lens.distort(torch.tensor([0.0, 1.0], dtype=torch.float64))
    torch.testing.assert_close(found, torch.tensor([0.0, math.pi / 4], dtype=torch.float64))
    assert lens.distorts and not Camera.from_values(*INTRINSICS, image_size=(480, 640)).distorts


@pytest.mark.parametrize(
    "lens",
    [
        Camera.from_values(
            1.0,
            1.0,
            0.0,
            0.0,
            [0.2, -0.3, 0.0, 0.0, 0.01, 0.3, 0.2, 0.05],
            image_size=(1, 1),
            model="rational_polynomial",
        ),
        Camera.from_values(
            1.0,
            1.0,
            0.0,
            0.0,
            [0.0, 0.0, 0.0, 0.0, 0.0, -0.4, 0.0, 0.0],
            image_size=(1, 1),
            model="rational_polynomial",
        ),
        Camera.from_values(1.0, 1.0, 0.0, 0.0, [-0.3, 0.0, 0.0, 0.0], image_size=(1, 1), model="equidistant"),
    ],
)
def test_the_fold_is_where_the_radius_stops_growing(lens: Camera) -> None:
    radius = torch.linspace(0, 20, 2_000_001, dtype=torch.float64)
    distorted = lens.distort(torch.stack([radius, torch.zeros_like(radius)], dim=-1))[:, 0]
    first_drop = int((distorted.diff() <= 0).nonzero()[0])
    assert math.sqrt(lens.max_radius_squared) == pytest.approx(float(radius[first_drop]), abs=2e-4)
    fold = math.sqrt(lens.max_radius_squared)
    near = torch.tensor([[0.6 * fold * part, -0.8 * fold * part] for part in (0.5, 0.9, 0.99)], dtype=torch.float64)
    back, valid = lens.undistort_points(lens.pixels(near))
    assert bool(valid.all())
    torch.testing.assert_close(back, near, rtol=0, atol=1e-9)
    assert not bool(lens.can_distort(torch.tensor([1.01 * fold, 0.0], dtype=torch.float64)))


@pytest.mark.parametrize("lens", LENSES)
def test_gradients_of_points_and_intrinsics(lens: str) -> None:
    model, distortion = LENSES[lens]
    points = scene(6, 25.0).requires_grad_()
    assert gradcheck(lambda p: camera(lens).project(p)[0], (points,))
    uv = camera(lens).project(points)[0].detach()

    def undistort(*values: Tensor) -> Tensor:
        return Camera(*values, image_size=(480, 640), model=model).undistort_points(uv)[0]

    values = [torch.tensor(v, dtype=torch.float64).requires_grad_() for v in (*INTRINSICS, distortion)]
    assert gradcheck(undistort, tuple(values), atol=1e-7)


@pytest.mark.parametrize("lens", LENSES)
def test_single_precision(lens: str) -> None:
    points = scene()
    uv, _ = camera(lens, torch.float32).project(points.float())
    xy, valid = camera(lens, torch.float32).undistort_points(uv)
    assert bool(valid.all())
    assert float((uv.double() - camera(lens).project(points)[0]).abs().max()) < 1e-3
    assert float((xy.double() - points[:, :2] / points[:, 2:]).abs().max()) * INTRINSICS[0] < 5e-3


@pytest.mark.parametrize("lens", LENSES)
def test_a_corrected_camera_moves_points_as_the_solver_does(lens: str) -> None:
    xy = scene(200, 20.0)
    xy = xy[:, :2] / xy[:, 2:]
    uv = camera(lens).pixels(xy)
    for change in ((1e-4, 0.0, 0.0, 0.0), (0.0, 1e-4, -2e-4, 0.0), (0.0, 0.0, 0.0, 1e-3)):
        found, _ = camera(lens).corrected(*change).undistort_points(uv)
        expected = torch.stack(corrected_point(*xy.unbind(-1), *change), dim=-1)
        moved, missed = (expected - xy).norm(dim=-1), (found - expected).norm(dim=-1)
        # The correction of a bent lens is that of the straight one to first order in the picture: at 20 deg the slopes
        # of these lenses differ from 1 by up to 0.25.
        assert float((missed - 0.3 * moved).max()) < 1e-9


def test_a_wrong_number_of_coefficients_is_refused() -> None:
    with pytest.raises(ShapeError, match=r"distortion: expected shape \(4,\)"):
        Camera.from_values(*INTRINSICS, image_size=(4, 4), model="equidistant")
