"""Cameras against OpenCV as outside truth, out to where the distortion folds back."""

import math

import cv2
import numpy as np
import pytest
import torch
from torch import Tensor
from torch.autograd import gradcheck

from rmis_calib.errors import InputError, ShapeError
from rmis_calib.geometry import Camera, RigidTransform, StereoRig

INTRINSICS = (812.0, 795.0, 315.5, 251.25)
LENSES = {
    "none": [0.0, 0.0, 0.0, 0.0, 0.0],
    "barrel": [-0.35, 0.0, 0.0, 0.0, 0.0],
    "barrel, all terms": [-0.35, 0.16, 1.5e-3, -8e-4, -0.04],
    "pincushion": [0.25, 0.05, -1e-3, 1e-3, 0.02],
}


def camera(lens: str, dtype: torch.dtype = torch.float64) -> Camera:
    return Camera.from_values(*INTRINSICS, LENSES[lens], image_size=(480, 640), dtype=dtype)


def opencv_arguments(lens: str) -> tuple[np.ndarray, np.ndarray]:
    fx, fy, cx, cy = INTRINSICS
    return np.array([[fx, 0, cx], [0, fy, cy], [0, 0, 1]]), np.array(LENSES[lens])


def scene(count: int = 500, half_angle_deg: float = 38.0) -> Tensor:
    """Points 30 to 200 mm ahead, within a cone."""
    generator = torch.Generator().manual_seed(5)
    z = 30 + 170 * torch.rand(count, generator=generator, dtype=torch.float64)
    radius = math.tan(math.radians(half_angle_deg)) * torch.rand(count, generator=generator, dtype=torch.float64)
    angle = 2 * math.pi * torch.rand(count, generator=generator, dtype=torch.float64)
    return torch.stack([z * radius * angle.cos(), z * radius * angle.sin(), z], dim=-1)


@pytest.mark.parametrize("lens", LENSES)
def test_project_agrees_with_opencv(lens: str) -> None:
    points = scene()
    uv, valid = camera(lens).project(points)
    expected, _ = cv2.projectPoints(points.numpy(), np.zeros(3), np.zeros(3), *opencv_arguments(lens))
    assert bool(valid.all())
    torch.testing.assert_close(uv, torch.from_numpy(expected[:, 0]), rtol=0, atol=1e-10)


@pytest.mark.parametrize("lens", LENSES)
def test_undistort_agrees_with_opencv(lens: str) -> None:
    uv, _ = camera(lens).project(scene())
    xy, valid = camera(lens).undistort_points(uv)
    criteria = (cv2.TERM_CRITERIA_COUNT | cv2.TERM_CRITERIA_EPS, 500, 1e-14)
    K, distortion = opencv_arguments(lens)
    # OpenCV 4 has the criteria in a function of its own.
    undistort = getattr(cv2, "undistortPointsIter", cv2.undistortPoints)
    expected = undistort(uv.numpy()[:, None], cameraMatrix=K, distCoeffs=distortion, R=None, P=None, criteria=criteria)
    assert bool(valid.all())
    # OpenCV stops at its own tolerance of about 1e-9.
    torch.testing.assert_close(xy, torch.from_numpy(expected[:, 0]), rtol=0, atol=2e-8)


@pytest.mark.parametrize("lens", LENSES)
def test_undistort_inverts_project(lens: str) -> None:
    points = scene()
    uv, _ = camera(lens).project(points)
    xy, valid = camera(lens).undistort_points(uv)
    assert bool(valid.all())
    torch.testing.assert_close(xy, points[:, :2] / points[:, 2:], rtol=0, atol=1e-13)


def test_strong_barrel_inverts_up_to_its_fold() -> None:
    lens = camera("barrel")
    # r + k1 r^3 is greatest at r = 1 / sqrt(-3 k1) = 0.97590.
    fold = 1 / math.sqrt(3 * 0.35)
    assert math.sqrt(lens.max_radius_squared) == pytest.approx(fold, abs=1e-12)
    radius = fold * torch.tensor([0.0, 0.5, 0.9, 0.99, 0.9999], dtype=torch.float64)
    xy = torch.stack([0.6 * radius, -0.8 * radius], dim=-1)
    back, valid = lens.undistort_points(lens.pixels(xy))
    assert bool(valid.all())
    # The inverse has a square-root singularity at the fold: 1e-4 away from it a rounding of 1e-16 grows to 1e-12.
    torch.testing.assert_close(back, xy, rtol=0, atol=1e-11)


def test_project_is_not_valid_beyond_the_fold() -> None:
    lens = camera("barrel")
    fold = math.sqrt(lens.max_radius_squared)
    points = torch.tensor([[0.999 * fold, 0, 1], [1.001 * fold, 0, 1], [50 * fold, 0, 1]], dtype=torch.float64)
    uv, valid = lens.project(points)
    assert valid.tolist() == [True, False, False]
    # Beyond it the pixel stays at the fold instead of coming back into the picture.
    at_fold = lens.pixels(torch.tensor([fold, 0.0], dtype=torch.float64))
    torch.testing.assert_close(uv[1:], at_fold.expand(2, 2))


def test_fold_of_a_higher_order_lens_is_where_the_radius_stops_growing() -> None:
    lens = Camera.from_values(*INTRINSICS, [-0.4, 0.06, 0.0, 0.0, 0.0], image_size=(480, 640))
    radius = torch.linspace(0, 3, 30001, dtype=torch.float64)
    xy = torch.stack([radius, torch.zeros_like(radius)], dim=-1)
    distorted = lens.distort(xy)[:, 0]
    first_drop = int((distorted.diff() <= 0).nonzero()[0])
    assert math.sqrt(lens.max_radius_squared) == pytest.approx(float(radius[first_drop]), abs=2e-4)
    # It grows again further out; that branch must not be taken for the picture.
    assert float(distorted[-1]) > float(distorted[first_drop])
    assert not bool(lens.can_distort(xy[-1]))


def test_pixels_outside_the_image_circle_have_no_inverse() -> None:
    lens = camera("barrel")
    corner = torch.tensor([[5000.0, 251.25], [-9000.0, 9000.0]], dtype=torch.float64)
    xy, valid = lens.undistort_points(corner)
    assert not bool(valid.any()) and bool(torch.isfinite(xy).all())


def test_points_behind_the_camera_are_not_valid() -> None:
    points = torch.tensor([[0.0, 0.0, 10.0], [1.0, 2.0, -10.0], [1.0, 2.0, 0.0], [0.0, 0.0, 0.0]], dtype=torch.float64)
    points.requires_grad_()
    uv, valid = camera("barrel, all terms").project(points)
    assert valid.tolist() == [True, False, False, False]
    (gradient,) = torch.autograd.grad(uv.sum(), points)
    assert bool(torch.isfinite(uv).all()) and bool(torch.isfinite(gradient).all())


def test_nan_pixels_are_not_valid_and_do_not_spread() -> None:
    uv = torch.tensor([[math.nan, 1.0], [300.0, 200.0]], dtype=torch.float64, requires_grad=True)
    xy, valid = camera("barrel, all terms").undistort_points(uv)
    assert valid.tolist() == [False, True]
    assert bool(torch.isfinite(xy).all())
    (gradient,) = torch.autograd.grad(xy.sum(), uv)
    assert bool(torch.isfinite(gradient).all())


def test_convention_principal_point_is_a_pixel_centre() -> None:
    lens = Camera.from_values(100.0, 100.0, 0.0, 0.0, image_size=(480, 640))
    uv, _ = lens.project(torch.tensor([0.0, 0.0, 5.0], dtype=torch.float64))
    # (0, 0) is the centre of the top-left pixel. Counter-literal: with the corner as origin it would be (0.5, 0.5).
    assert uv.tolist() == [0.0, 0.0]


def test_convention_distortion_order_is_k1_k2_p1_p2_k3() -> None:
    xy = torch.tensor([0.5, 0.25], dtype=torch.float64)
    third = Camera.from_values(1.0, 1.0, 0.0, 0.0, [0.0, 0.0, 0.01, 0.0, 0.0], image_size=(1, 1))
    # p1: x + 2 p1 x y = 0.5025, y + p1 (r^2 + 2 y^2) = 0.254375. Counter-literal: as k3 it would be x (1 + p1 r^6).
    torch.testing.assert_close(third.distort(xy), torch.tensor([0.5025, 0.254375], dtype=torch.float64))


@pytest.mark.parametrize("lens", LENSES)
def test_gradients_of_points(lens: str) -> None:
    points = scene(6, 25.0).requires_grad_()
    assert gradcheck(lambda p: camera(lens).project(p)[0], (points,))
    uv = camera(lens).project(points)[0].detach().requires_grad_()
    assert gradcheck(lambda p: camera(lens).undistort_points(p)[0], (uv,), atol=1e-7)


def test_gradients_of_intrinsics() -> None:
    uv, _ = camera("barrel, all terms").project(scene(6, 25.0))

    def undistort(fx: Tensor, fy: Tensor, cx: Tensor, cy: Tensor, distortion: Tensor) -> Tensor:
        return Camera(fx, fy, cx, cy, distortion, (480, 640)).undistort_points(uv)[0]

    values = [torch.tensor(v, dtype=torch.float64) for v in (*INTRINSICS, LENSES["barrel, all terms"])]
    assert gradcheck(undistort, tuple(v.requires_grad_() for v in values), atol=1e-7)


@pytest.mark.parametrize("batch", [(), (1,), (3, 1, 2), (0,)])
def test_any_batch(batch: tuple[int, ...]) -> None:
    points = torch.ones(*batch, 3, dtype=torch.float64)
    uv, valid = camera("pincushion").project(points * torch.tensor([0.1, 0.1, 1.0], dtype=torch.float64))
    xy, back_valid = camera("pincushion").undistort_points(uv)
    assert uv.shape == xy.shape == (*batch, 2) and valid.shape == back_valid.shape == batch
    torch.testing.assert_close(xy, torch.full_like(xy, 0.1))


def test_single_precision_is_good_to_a_thousandth_of_a_pixel() -> None:
    lens = camera("barrel, all terms", torch.float32)
    points = scene()
    uv, _ = lens.project(points.float())
    xy, valid = lens.undistort_points(uv)
    assert uv.dtype == xy.dtype == torch.float32 and bool(valid.all())
    exact, _ = camera("barrel, all terms").project(points)
    assert float((uv.double() - exact).abs().max()) < 1e-3
    assert float((xy.double() - points[:, :2] / points[:, 2:]).abs().max()) * INTRINSICS[0] < 2e-3


def test_camera_in_another_precision() -> None:
    lens = camera("barrel")
    assert lens.to(torch.float32).distortion.dtype == torch.float32
    assert float(lens.focal) == 0.5 * (812.0 + 795.0)


@pytest.mark.parametrize(
    ("change", "error", "message"),
    [
        ({"fx": -812.0}, InputError, "positive focal"),
        ({"cx": math.nan}, InputError, "cx: expected finite"),
        ({"distortion": [0.0] * 4}, ShapeError, "distortion"),
        ({"fx": [1.0, 2.0]}, ShapeError, "fx"),
        ({"image_size": (0, 640)}, InputError, "image_size"),
    ],
)
def test_impossible_cameras_are_refused(change: dict, error: type[Exception], message: str) -> None:
    values = {**dict(zip(("fx", "fy", "cx", "cy"), INTRINSICS, strict=True)), "distortion": [0.0] * 5, **change}
    size = values.pop("image_size", (480, 640))
    with pytest.raises(error, match=message):
        Camera(**{key: torch.tensor(value, dtype=torch.float64) for key, value in values.items()}, image_size=size)


class TestStereoRig:
    eye = torch.eye(4, dtype=torch.float64)

    def test_mono_and_stereo(self) -> None:
        assert StereoRig(camera("none")).left is None
        extrinsics = RigidTransform("camera_left", "camera_right", self.eye)
        rig = StereoRig(camera("none"), camera("barrel"), extrinsics).to(torch.float32)
        assert rig.left is not None and rig.left.fx.dtype == torch.float32
        assert rig.camera_left_T_camera_right is not None
        assert rig.camera_left_T_camera_right.matrix.dtype == torch.float32

    def test_half_a_left_camera_is_refused(self) -> None:
        with pytest.raises(InputError, match="together"):
            StereoRig(camera("none"), camera("none"))

    def test_extrinsics_the_wrong_way_round_are_refused(self) -> None:
        with pytest.raises(InputError, match=r"found camera_right_T_camera_left"):
            StereoRig(camera("none"), camera("none"), RigidTransform("camera_right", "camera_left", self.eye))
