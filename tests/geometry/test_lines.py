"""Lines and contour planes against brute force: points sampled on a cylinder's surface and projected with NumPy."""

import math

import numpy as np
import pytest
import torch
from torch import Tensor
from torch.autograd import gradcheck

from rmis_calib import geometry as g

RIGHT = torch.tensor([1.0, 0.0, 0.0], dtype=torch.float64)


def random_axes(count: int, seed: int = 2) -> tuple[Tensor, Tensor]:
    """Points 40 to 150 mm ahead with unit directions up to 60 degrees out of the image plane."""
    generator = torch.Generator().manual_seed(seed)
    uniform = torch.rand(count, 4, generator=generator, dtype=torch.float64)
    p = torch.stack([60 * uniform[:, 0] - 30, 60 * uniform[:, 1] - 30, 40 + 110 * uniform[:, 2]], dim=-1)
    v = torch.randn(count, 3, generator=generator, dtype=torch.float64) * torch.tensor([1.0, 1.0, 0.5])
    return p, torch.nn.functional.normalize(v, dim=-1)


def surface(p: np.ndarray, v: np.ndarray, radius: float) -> np.ndarray:
    """Points (s, angle, 3) on a cylinder's surface, near p."""
    helper = np.eye(3)[np.argmin(np.abs(v))]
    e1 = np.cross(v, helper) / np.linalg.norm(np.cross(v, helper))
    e2 = np.cross(v, e1)
    s = np.linspace(-15, 15, 7)[:, None, None]
    angle = np.linspace(0, 2 * np.pi, 20001)[None, :, None]
    return p + s * v + radius * (np.cos(angle) * e1 + np.sin(angle) * e2)


def test_line_through_points_contains_them(generator: torch.Generator) -> None:
    xy_a, xy_b = torch.randn(2, 3, 1, 2, 2, generator=generator, dtype=torch.float64)
    line = g.line_through_points(xy_a, xy_b)
    torch.testing.assert_close(line[..., :2].norm(dim=-1), torch.ones(3, 1, 2, dtype=torch.float64))
    middle = 0.3 * xy_a + 0.7 * xy_b
    torch.testing.assert_close(g.point_line_distance(middle, line), torch.zeros(3, 1, 2, dtype=torch.float64))


def test_point_line_distance_is_the_distance() -> None:
    # The line from (0, 1) to (1, 1) + ... a 3-4-5 triangle: distance of the origin from (0, 5) - (3.75, 0) is 3.
    line = g.line_through_points(
        torch.tensor([0.0, 5.0], dtype=torch.float64), torch.tensor([3.75, 0.0], dtype=torch.float64)
    )
    assert abs(float(g.point_line_distance(torch.zeros(2, dtype=torch.float64), line))) == pytest.approx(3.0)


def test_convention_a_line_is_positive_on_the_right_hand_side() -> None:
    a, b = torch.tensor([[0.0, 0.0], [1.0, 0.0]], dtype=torch.float64)
    below = torch.tensor([0.5, 0.2], dtype=torch.float64)  # y is down: right of a line directed to the right
    # Counter-literal: with y up, or with b x a, it would be -0.2.
    assert float(g.point_line_distance(below, g.line_through_points(a, b))) == pytest.approx(0.2)
    assert float(g.plane_normal_from_points(a, b)[1]) == pytest.approx(1.0)


def test_plane_normal_is_the_axis_plane_of_any_axis_through_both_points() -> None:
    p, v = random_axes(50)
    q = p + 20 * v
    n = g.plane_normal_from_points(p[:, :2] / p[:, 2:], q[:, :2] / q[:, 2:])
    torch.testing.assert_close(n, g.axis_plane(p, v))
    torch.testing.assert_close((n * v).sum(-1), torch.zeros(50, dtype=torch.float64))
    torch.testing.assert_close((n * p).sum(-1), torch.zeros(50, dtype=torch.float64))


def test_axis_plane_does_not_depend_on_the_point() -> None:
    p, v = random_axes(20)
    torch.testing.assert_close(g.axis_plane(p - 33.0 * v, v), g.axis_plane(p, v))
    torch.testing.assert_close(g.axis_plane(p, -v), -g.axis_plane(p, v))


@pytest.mark.parametrize("seed", range(5))
def test_contour_planes_touch_the_brute_force_silhouette(seed: int) -> None:
    p, v = (x[0].numpy() for x in random_axes(1, seed))
    radius = 4.2
    planes = g.contour_planes(torch.from_numpy(p), torch.from_numpy(v), radius).numpy()
    points = surface(p, v, radius)
    xy = points[..., :2] / points[..., 2:]
    # Offset across the picture of the axis, positive on its right-hand side.
    a, b = (q[:2] / q[2] for q in (p - 15 * v, p + 15 * v))
    along = (b - a) / np.linalg.norm(b - a)
    across = (xy - a) @ np.array([-along[1], along[0]])
    for edge, side in ((0, -1.0), (1, 1.0)):
        line = planes[edge] / np.linalg.norm(planes[edge][:2])
        outwards = side * (xy @ line[:2] + line[2])  # (s, angle)
        # Every ring of the surface touches the contour and none crosses it. The nearest of 20001 samples is within
        # r (pi / 20001)^2 / 2 = 5e-8 mm of the point of contact, and at least 20 mm away from the camera.
        assert np.abs(outwards.max(axis=1)).max() < 1e-8
        contact = np.take_along_axis(across, outwards.argmax(axis=1)[:, None], axis=1)
        assert (side * contact > 0).all()


def test_convention_edge_0_is_on_the_left_hand_side() -> None:
    p = torch.tensor([0.0, 0.0, 100.0], dtype=torch.float64)
    planes = g.contour_planes(p, RIGHT, 60.0)
    heights = -planes[:, 2] / planes[:, 1]  # y of each contour at x = 0: tan(asin(0.6)) = 0.75
    # The tip is on the right, so edge 0 is the upper one, y < 0. Counter-literal: edge 0 below would be +0.75.
    torch.testing.assert_close(heights, torch.tensor([-0.75, 0.75], dtype=torch.float64))
    flipped = g.contour_planes(p, -RIGHT, 60.0)
    torch.testing.assert_close(-flipped[:, 2] / flipped[:, 1], torch.tensor([0.75, -0.75], dtype=torch.float64))


def test_contour_planes_have_the_sign_of_planes_from_points_in_walking_order() -> None:
    p, v = random_axes(30)
    planes = g.contour_planes(p, v, 4.0)
    # Two points on each contour line, the one further along v last.
    nearest = torch.linalg.cross(v, torch.linalg.cross(p, v))
    u = torch.nn.functional.normalize(nearest, dim=-1)
    touching = nearest[:, None] - ((nearest[:, None] * planes).sum(-1, keepdim=True)) * planes  # on each plane
    for edge in range(2):
        first, last = touching[:, edge] + 5 * u - 3 * v, touching[:, edge] + 5 * u + 3 * v
        first = first - (first * planes[:, edge]).sum(-1, keepdim=True) * planes[:, edge]
        last = last - (last * planes[:, edge]).sum(-1, keepdim=True) * planes[:, edge]
        in_front = (first[:, 2] > 1) & (last[:, 2] > 1)
        n = g.plane_normal_from_points(first[:, :2] / first[:, 2:], last[:, :2] / last[:, 2:])
        torch.testing.assert_close(n[in_front], planes[in_front, edge])
        assert int(in_front.sum()) > 20


def test_axis_from_contours_inverts_contour_planes() -> None:
    p, v = random_axes(100)
    radius = torch.linspace(2, 6, 100, dtype=torch.float64)
    axis = g.axis_from_contours(g.contour_planes(p, v, radius), radius)
    moment = torch.linalg.cross(p, v)
    torch.testing.assert_close(axis.distance_mm, moment.norm(dim=-1))
    torch.testing.assert_close(axis.camera_n_axis, g.axis_plane(p, v))
    torch.testing.assert_close(axis.half_angle_rad, torch.asin(radius / moment.norm(dim=-1)))
    nearest = p - (p * v).sum(-1, keepdim=True) * v
    torch.testing.assert_close(axis.camera_u, torch.nn.functional.normalize(nearest, dim=-1))
    # The axis direction is what the docstring promises: m x u.
    torch.testing.assert_close(torch.linalg.cross(axis.camera_n_axis, axis.camera_u), v)


def test_bisector_is_not_the_image_midline() -> None:
    # Off the optical axis the mean of the two contour lines differs from the axis' picture: the reason for the
    # bisector.
    p = torch.tensor([0.0, 40.0, 40.0], dtype=torch.float64)
    planes = g.contour_planes(p, RIGHT, 10.0)
    midline = float((-planes[:, 2] / planes[:, 1]).mean())
    axis = g.axis_from_contours(planes, 10.0).camera_n_axis
    assert float(-axis[2] / axis[1]) == pytest.approx(1.0)
    assert midline == pytest.approx(2 / (2 * math.cos(math.asin(10 / math.hypot(40, 40))) ** 2 - 1) / 2, rel=1e-12)


@pytest.mark.parametrize("batch", [(), (1,), (3, 1, 2)])
def test_any_batch_and_broadcasting(batch: tuple[int, ...]) -> None:
    p = torch.tensor([1.0, 2.0, 80.0], dtype=torch.float64).expand(*batch, 3)
    planes = g.contour_planes(p, RIGHT, torch.tensor(4.0, dtype=torch.float64))
    assert planes.shape == (*batch, 2, 3)
    assert g.axis_from_contours(planes, 4.0).distance_mm.shape == batch
    assert g.axis_plane(p, RIGHT).shape == (*batch, 3)
    assert g.is_outside_cylinder(p, RIGHT, 4.0).shape == batch
    assert g.contour_planes(p.float(), RIGHT.float(), 4.0).dtype == torch.float32


def test_gradients() -> None:
    p, v = random_axes(4)
    radius = torch.full((4,), 4.0, dtype=torch.float64)
    assert gradcheck(g.contour_planes, tuple(x.clone().requires_grad_() for x in (p, v, radius)))
    planes = g.contour_planes(p, v, radius)

    def parts(planes: Tensor, radius: Tensor) -> tuple[Tensor, ...]:
        axis = g.axis_from_contours(planes, radius)
        return axis.camera_n_axis, axis.camera_u, axis.half_angle_rad, axis.distance_mm

    assert gradcheck(parts, (planes.requires_grad_(), radius.requires_grad_()))
    xy = torch.randn(2, 4, 2, generator=torch.Generator().manual_seed(0), dtype=torch.float64).requires_grad_()
    assert gradcheck(lambda xy: g.line_through_points(xy[0], xy[1]), (xy,))
    assert gradcheck(lambda xy: g.plane_normal_from_points(xy[0], xy[1]), (xy,))


@pytest.mark.parametrize("distance", [0.0, 1e-9, 3.0, 4.0, 4.0 * (1 + 1e-9)])
def test_camera_inside_or_on_the_cylinder_gives_finite_values_and_says_so(distance: float) -> None:
    p = torch.tensor([0.0, 0.0, distance], dtype=torch.float64, requires_grad=True)
    radius = torch.tensor(4.0, dtype=torch.float64, requires_grad=True)
    planes = g.contour_planes(p, RIGHT, radius)
    gradients = torch.autograd.grad(planes.sum(), (p, radius))
    assert all(bool(torch.isfinite(x).all()) for x in (planes, *gradients))
    assert bool(g.is_outside_cylinder(p, RIGHT, radius)) == (distance > 4.0)


def test_degenerate_lines_are_zero_not_nan() -> None:
    point = torch.tensor([0.3, -0.2], dtype=torch.float64, requires_grad=True)
    for value in (g.line_through_points(point, point), g.plane_normal_from_points(point, point)):
        assert value.tolist() == [0.0, 0.0, 0.0]
        (gradient,) = torch.autograd.grad(value.sum(), point)
        assert bool(torch.isfinite(gradient).all())
    through_centre = g.axis_plane(RIGHT * 5, RIGHT)
    assert through_centre.tolist() == [0.0, 0.0, 0.0]


def test_contours_that_coincide_are_infinitely_far() -> None:
    n = torch.tensor([[0.0, 1.0, 0.0], [0.0, 1.0, 0.0]], dtype=torch.float64, requires_grad=True)
    axis = g.axis_from_contours(n, 4.0)
    assert axis.distance_mm.tolist() == math.inf and axis.half_angle_rad.tolist() == 0.0
    (gradient,) = torch.autograd.grad(axis.camera_n_axis.sum() + axis.half_angle_rad, n)
    assert bool(torch.isfinite(gradient).all())
