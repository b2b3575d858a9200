"""The same answers on a GPU as on the CPU, where there is one."""

import math

import pytest
import torch

from rmis_calib import geometry as g

pytestmark = pytest.mark.skipif(not torch.cuda.is_available(), reason="no CUDA device")


def test_rotations() -> None:
    rotvec = torch.tensor([[0.0, 0.0, 0.0], [0.3, -0.2, 0.9], [0.0, math.pi, 0.0]], dtype=torch.float64)
    for function in (g.rotvec_to_matrix, g.rotvec_to_quat):
        torch.testing.assert_close(function(rotvec.cuda()).cpu(), function(rotvec))
    R = g.rotvec_to_matrix(rotvec)
    for function in (g.matrix_to_quat, g.rotation_angle, g.project_to_so3, g.chordal_mean):
        torch.testing.assert_close(function(R.cuda()).cpu(), function(R))


def test_cameras() -> None:
    camera = g.Camera.from_values(800.0, 790.0, 320.0, 240.0, [-0.35, 0.1, 1e-3, 1e-3, 0.0], image_size=(480, 640))
    points = torch.tensor([[10.0, -20.0, 100.0], [0.0, 5.0, -3.0]], dtype=torch.float64)
    uv, valid = camera.to(device="cuda").project(points.cuda())
    torch.testing.assert_close(uv.cpu(), camera.project(points)[0])
    assert valid.tolist() == [True, False]
    xy, _ = camera.to(device="cuda").undistort_points(uv)
    torch.testing.assert_close(xy.cpu(), camera.undistort_points(uv.cpu())[0])


def test_contours() -> None:
    p, v = torch.tensor([[1.0, 2.0, 90.0], [0.6, 0.0, 0.8]], dtype=torch.float64)
    planes = g.contour_planes(p.cuda(), v.cuda(), 4.0)
    torch.testing.assert_close(planes.cpu(), g.contour_planes(p, v, 4.0))
    torch.testing.assert_close(
        g.axis_from_contours(planes, 4.0).distance_mm.cpu(), g.axis_from_contours(planes.cpu(), 4.0).distance_mm
    )


def test_rigid() -> None:
    a_T_b = g.rigid_exp(torch.tensor([0.1, 0.2, 0.3, 4.0, 5.0, 6.0], dtype=torch.float64))
    torch.testing.assert_close(g.rigid_inverse(a_T_b.cuda()).cpu(), g.rigid_inverse(a_T_b))
    assert g.RigidTransform("a", "b", a_T_b).to(device="cuda").inverse().matrix.is_cuda
