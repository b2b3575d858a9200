"""The conventions page, run; and what each line of it would give if it were read the other way."""

import doctest
import math

import pytest
import torch
from scipy.spatial.transform import Rotation

from rmis_calib import geometry as g
from rmis_calib.geometry import conventions


def vector(*entries: float) -> torch.Tensor:
    return torch.tensor(entries, dtype=torch.float64)


def test_the_page_is_true() -> None:
    result = doctest.testmod(conventions, verbose=False)
    assert result.failed == 0
    assert result.attempted > 15


def test_convention_camera_axes_are_right_down_forward() -> None:
    camera = g.Camera.from_values(100.0, 100.0, 50.0, 40.0, image_size=(81, 101))
    uv, valid = camera.project(torch.stack([vector(1, 0, 10), vector(0, 1, 10), vector(0, 0, -10)]))
    # x goes to greater columns, y to greater rows. Counter-literal: with y up the second would be (50, 30).
    assert uv[:2].tolist() == [[60.0, 40.0], [50.0, 50.0]]
    assert valid.tolist() == [True, True, False]


def test_convention_camera_left_T_camera_right_moves_points_to_the_right() -> None:
    # The right camera is at +x of the left one, so its origin is at (+5, 0, 0) in camera_left.
    camera_left_T_camera_right = g.rigid_from_rotation_translation(torch.eye(3, dtype=torch.float64), vector(5, 0, 0))
    camera = g.Camera.from_values(800.0, 800.0, 320.0, 240.0, image_size=(480, 640))
    camera_right_p_x = vector(0, 0, 100)
    uv_camera_right, _ = camera.project(camera_right_p_x)
    uv_camera_left, _ = camera.project(g.transform_points(camera_left_T_camera_right, camera_right_p_x))
    # Disparity f b / z = 40 px, further right in the left picture. Counter-literal: the inverse would give -40.
    torch.testing.assert_close(uv_camera_left - uv_camera_right, vector(40, 0))


def test_convention_uv_is_column_then_row_and_sizes_are_height_then_width() -> None:
    camera = g.Camera.from_values(100.0, 100.0, 319.5, 239.5, image_size=(480, 640))
    uv, _ = camera.project(vector(0, 0, 1))
    # The centre of a picture 640 wide and 480 high. Counter-literal: (row, column) would be (239.5, 319.5).
    assert uv.tolist() == [319.5, 239.5]
    assert camera.image_size == (480, 640)


def test_convention_perturbation_is_in_the_destination_frame() -> None:
    # camera_R_arm turns z of arm into x of camera; an error of 0.1 rad about the camera's x is one about the arm's z.
    camera_R_arm = g.rotvec_to_matrix(vector(0, math.pi / 2, 0))
    dphi = vector(0.1, 0, 0)
    perturbed = g.rotvec_to_matrix(dphi) @ camera_R_arm
    torch.testing.assert_close(g.matrix_to_rotvec(perturbed @ camera_R_arm.mT), dphi)
    # Counter-literal: R^ exp(dphi) would need (0, 0, 0.1) instead.
    torch.testing.assert_close(g.matrix_to_rotvec(camera_R_arm.mT @ perturbed), vector(0, 0, 0.1))


def test_convention_kinematic_noise_is_expressed_at_the_rcm() -> None:
    arm_T_rcm = g.rigid_from_rotation_translation(g.rotvec_to_matrix(vector(0, 0, math.pi / 2)), vector(100, 0, 0))
    xi = vector(0.0, 0.0, 0.1, 1.0, 0.0, 0.0)
    noisy = arm_T_rcm @ g.rigid_exp(xi)
    # The lever arm does not enter, and x of the rcm is y of the arm: (100, 1, 0).
    # Counter-literal: a left perturbation would give exp(0.1 z) (100, 0, 0) + (1, 0, 0) = (100.5, 9.98, 0).
    torch.testing.assert_close(noisy[:3, 3], vector(100, 1, 0))


def test_convention_quat_wxyz_in_files_against_scipy() -> None:
    rotvec = vector(0.3, -0.2, 0.9)
    matrix = g.rigid_from_rotation_translation(g.rotvec_to_matrix(rotvec), vector(1, 2, 3))
    x, y, z, w = Rotation.from_rotvec(rotvec.numpy()).as_quat()  # SciPy's default order is x, y, z, w
    assert g.RigidTransform("a", "b", matrix).to_dict()["quat_wxyz"] == pytest.approx([w, x, y, z], abs=1e-15)


def test_convention_matrices_in_files_are_rows_in_mm() -> None:
    matrix = g.rigid_from_rotation_translation(g.rotvec_to_matrix(vector(0, 0, math.pi / 2)), vector(1, 2, 3))
    values = g.RigidTransform("a", "b", matrix).to_dict()
    # Rows: the translation is the last entry of each. Counter-literal: by columns it would be the last list.
    assert [row[3] for row in values["matrix"]] == [1.0, 2.0, 3.0, 1.0]
    assert values["translation_mm"] == [1.0, 2.0, 3.0]
    assert values["matrix"][1][0] == pytest.approx(1.0) and values["matrix"][0][1] == pytest.approx(-1.0)
