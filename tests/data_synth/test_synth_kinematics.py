"""The generator's own kinematics, against numbers worked out by hand and against independent formulae."""

import numpy as np
import pytest
from scipy.linalg import expm
from scipy.spatial.transform import Rotation

from data_synth.kinematics import (
    Arm,
    Joint,
    arm_to_dict,
    arms_from_dict,
    dh_matrix,
    pose_noise,
    random_rotations,
    rigid,
    rigid_inverse,
    rotation_from_rotvec,
    transform_points,
)
from data_synth.scene import build_scene, poses_at
from data_synth.settings import SceneSettings


@pytest.mark.parametrize("angle", [0.0, 1e-9, 1e-3, 1.0, np.pi, 3.5])
def test_rotation_is_that_of_scipy(angle: float) -> None:
    rotvec = angle * np.array([2.0, -3.0, 6.0]) / 7.0
    np.testing.assert_allclose(rotation_from_rotvec(rotvec), Rotation.from_rotvec(rotvec).as_matrix(), atol=1e-15)


def test_modified_dh_is_craigs_product() -> None:
    joint = Joint("j", "revolute", 0.3, 5.0, 0.2, 7.0, 0.1)
    a_T_x = rigid(rotation_from_rotvec([0.3, 0.0, 0.0]), [5.0, 0.0, 0.0])
    x_T_z = rigid(rotation_from_rotvec([0.0, 0.0, 0.2 + 0.4 + 0.1]), [0.0, 0.0, 7.0])
    np.testing.assert_allclose(dh_matrix(joint, 0.4, "modified"), a_T_x @ x_T_z, atol=1e-15)
    # The standard convention puts the same two the other way round: the counter-literal.
    np.testing.assert_allclose(dh_matrix(joint, 0.4, "standard"), x_T_z @ a_T_x, atol=1e-15)
    assert np.abs(a_T_x @ x_T_z - x_T_z @ a_T_x).max() > 1.0


def test_prismatic_joint_adds_reading_and_offset_to_d() -> None:
    # Rx(90 deg) turns the joint's z axis to -y: d = 7 + 20 - 3 = 24 mm along it.
    joint = Joint("insertion", "prismatic", np.pi / 2, 0.0, 0.0, 7.0, -3.0)
    np.testing.assert_allclose(dh_matrix(joint, 20.0, "modified")[:3, 3], [0.0, -24.0, 0.0], atol=1e-14)


def test_pose_noise_is_rotation_exponential_and_plain_translation() -> None:
    noise = pose_noise(np.random.default_rng(3), (2,), 0.2, 1.5)
    eps = np.random.default_rng(3).standard_normal((2, 6))
    for i in range(2):
        x, y, z = 0.2 * eps[i, :3]
        np.testing.assert_allclose(noise[i, :3, :3], expm(np.array([[0, -z, y], [z, 0, -x], [-y, x, 0]])), atol=1e-14)
        np.testing.assert_allclose(noise[i, :3, 3], 1.5 * eps[i, 3:])


def test_random_rotations_are_rotations() -> None:
    R = random_rotations(np.random.default_rng(0), (50,))
    np.testing.assert_allclose(R @ np.swapaxes(R, -1, -2), np.broadcast_to(np.eye(3), (50, 3, 3)), atol=1e-14)
    np.testing.assert_allclose(np.linalg.det(R), 1.0)


def test_inverse_undoes_any_batch() -> None:
    a_T_b = pose_noise(np.random.default_rng(1), (2, 3), 1.0, 50.0)
    np.testing.assert_allclose(rigid_inverse(a_T_b) @ a_T_b, np.broadcast_to(np.eye(4), (2, 3, 4, 4)), atol=1e-13)


def test_scene_is_as_its_settings_say_at_home() -> None:
    settings = SceneSettings()
    scene = build_scene(settings)
    poses = poses_at(scene, scene.laparoscope_home, scene.instrument_home)
    camera_T_rcm = scene.camera_right_T_arm @ poses.arm_T_rcm
    np.testing.assert_allclose(camera_T_rcm[:3, 3], settings.instrument_rcm_mm, atol=1e-12)
    np.testing.assert_allclose(transform_points(camera_T_rcm, poses.rcm_p_head), settings.target_mm, atol=1e-12)
    base_T_camera = poses.base_T_arm @ rigid_inverse(scene.camera_right_T_arm)
    np.testing.assert_allclose(base_T_camera, scene.base_T_camera_home, atol=1e-12)


def test_arms_pivot_about_their_rcm() -> None:
    scene = build_scene(SceneSettings())
    generator = np.random.default_rng(0)
    moves = np.array([0.2, 0.2, 30.0]) * generator.standard_normal((20, 3))
    poses = poses_at(scene, scene.laparoscope_home + moves, scene.instrument_home + moves[::-1])
    # Laparoscope: its optical axis passes through the point 120 mm behind the home camera, whatever the joints.
    base_T_camera = poses.base_T_arm @ rigid_inverse(scene.camera_right_T_arm)
    base_p_pivot = transform_points(scene.base_T_camera_home, np.array([0.0, 0.0, -120.0]))
    camera_p_pivot = transform_points(rigid_inverse(base_T_camera), base_p_pivot)
    np.testing.assert_allclose(camera_p_pivot[:, :2], 0.0, atol=1e-12)
    # Instrument: the RCM does not move, and the axis is a unit vector towards the head point.
    shaft = scene.instrument.shaft(scene.instrument_home + moves)
    np.testing.assert_allclose(
        shaft.base_T_rcm[:, :3, 3], np.broadcast_to(shaft.base_T_rcm[0, :3, 3], (20, 3)), atol=1e-12
    )
    np.testing.assert_allclose(shaft.rcm_p_head, shaft.rcm_s_end_mm[:, None] * shaft.rcm_v_axis, atol=1e-12)
    assert (shaft.rcm_s_end_mm > 0).all()


def test_arm_survives_yaml_form() -> None:
    scene = build_scene(SceneSettings())
    arms = arms_from_dict(scene.robot_dict("r"))
    readings = scene.instrument_home + np.array([0.1, -0.2, 8.0])
    np.testing.assert_array_equal(arms["instrument"].frames(readings), scene.instrument.frames(readings))
    np.testing.assert_array_equal(arms["laparoscope"].tool(readings), scene.laparoscope.tool(readings))
    assert "end_T_tool" not in arm_to_dict(Arm(np.eye(4), ()), instrument=True)
