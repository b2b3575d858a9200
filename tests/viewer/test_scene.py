"""Where the scene puts arms, cameras and the point that matters: against the renderer's own truth and by hand."""

import numpy as np
import pytest
import torch
import yaml
from scipy.spatial.transform import Rotation

import data_synth
import rmis_calib as rc
from rmis_calib.geometry import RigidTransform
from rmis_calib.pipeline.scene import advised_scene, place_cameras, point_covariance, scene_of
from rmis_calib.results import CalibrationResult


@pytest.fixture(scope="module")
def exact(tmp_path_factory):
    """A recording without noise, and the result that is its truth."""
    path = tmp_path_factory.mktemp("scene") / "recording"
    noise = {"kinematics_mm": 0.0, "kinematics_deg": 0.0, "head_point_px": 0.0, "stereo_mm": 0.0, "stereo_deg": 0.0}
    data_synth.write_recording(path, data_synth.load_synth_config({"motions": 3, "seed": 7, "noise": noise}))
    truth = yaml.safe_load((path / "ground_truth.yaml").read_text())
    stereo = yaml.safe_load((path / "stereo.yaml").read_text())
    written = {
        "format": "rmis-calib-result/1",
        "status": "ok",
        "message": "the truth",
        "method": "joint",
        "camera_right_T_arm": _transform("camera_right", "arm", truth["camera_right_T_arm"]),
        "camera_left_T_camera_right": _transform("camera_left", "camera_right", stereo["camera_left_T_camera_right"]),
        "covariance": np.diag([0.0, 0.0, 0.0, 1.0, 4.0, 9.0]).tolist(),
        "observability": {"verdict": "trustworthy", "sentences": ["all seen"], "working_point_mm": [0.0, 0.0, 100.0]},
        "versions": {},
        "created": "2026-01-01T00:00:00+00:00",
        "config": {},
        "notes": [],
        "residuals": {},
        "nuisances": {},
        "motions": {"used_by_motion": [True] * 3, "reason_by_motion": [""] * 3},
    }
    return rc.load_recording(path), CalibrationResult.from_dict(written)


def _transform(dst, src, rows):
    return RigidTransform(dst, src, torch.tensor(rows).double()).to_dict()


def test_head_points_of_the_scene_are_where_the_renderer_drew_them(exact):
    recording, result = exact
    scene = scene_of(recording, result)
    cameras = place_cameras(scene, recording, result)
    for side, camera, uv in (
        ("right", recording.stereo.right, recording.head_points.uv_right),
        ("left", recording.stereo.left, recording.head_points.uv_left),
    ):
        pose = cameras.base_T_camera[side][recording.head_points.frames]
        seen = np.einsum("mji,mj->mi", pose[:, :3, :3], scene.head[recording.head_points.frames] - pose[:, :3, 3])
        drawn, _ = camera.project(torch.as_tensor(seen))
        assert np.abs(drawn.numpy() - uv).max() < 0.05


def test_arms_end_where_their_transforms_do(exact):
    recording, result = exact
    scene = scene_of(recording, result)
    assert np.allclose(scene.laparoscope_points[:, -1], scene.base_T_arm[:, :3, 3])
    along, to_head = scene.end - scene.rcm, scene.head - scene.rcm
    across = np.cross(along, to_head) / np.linalg.norm(along, axis=-1, keepdims=True)
    assert np.linalg.norm(across, axis=-1).max() < 15.0  # the wrist is bent, and 10 mm long
    assert advised_scene(recording, result) is None


def test_covariance_of_a_point_by_simulation():
    """10^5 draws of R = exp(dphi) R^, t = t^ + dt."""
    generator = np.random.default_rng(0)
    A = generator.normal(size=(6, 6)) * np.array([[1e-3]] * 3 + [[0.3]] * 3)
    p, t = np.array([5.0, -3.0, 100.0]), np.array([10.0, 20.0, -30.0])
    draws = generator.normal(size=(100_000, 6)) @ A.T
    moved = Rotation.from_rotvec(draws[:, :3]).apply(p - t) + t + draws[:, 3:]
    expected = np.cov(moved.T)
    assert np.abs(point_covariance(p, t, A @ A.T) - expected).max() < 0.02 * expected.diagonal().max()


def test_the_ellipsoid_turns_with_the_camera(exact):
    recording, result = exact
    cameras = place_cameras(scene_of(recording, result), recording, result)
    for pose, covariance in zip(cameras.base_T_camera["right"], cameras.working_covariance, strict=True):
        assert np.allclose(pose[:3, :3].T @ covariance @ pose[:3, :3], np.diag([1.0, 4.0, 9.0]), atol=1e-6)
