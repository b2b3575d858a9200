"""A second look finds what the first one missed, and a wrong answer gathers no support from it."""

import dataclasses

import numpy as np
import pytest
import torch

from data_synth import load_synth_config, render_frames
from data_synth.world import build_world
from rmis_calib.geometry import Camera
from rmis_calib.geometry.lines import contour_planes
from rmis_calib.geometry.rotations import rotvec_to_matrix
from rmis_calib.pipeline.association import consistent_choice
from rmis_calib.pipeline.second_look import contour_points
from rmis_calib.vision import ShaftDetector

FRAMES = 10
GATE = 0.027


@pytest.fixture(scope="module")
def hard():
    """Pictures of `hard`, their camera, and the true pose of the shaft in each: a point of the axis, and direction."""
    config = dataclasses.replace(load_synth_config("hard"), motions=FRAMES, seed=31)
    images, truth = render_frames(config)
    own = build_world(config).cameras["right"].to_dict()
    k = [own[name] for name in ("fx", "fy", "cx", "cy")]
    camera = Camera.from_values(*k, own["distortion"], image_size=tuple(images.shape[-2:]))
    return images, camera, torch.as_tensor(truth.camera_p_rcm), torch.as_tensor(truth.camera_v_axis), truth.visible


def test_points_of_predicted_lines_lie_on_them():
    p = torch.tensor([[20.0, -10.0, 80.0], [-25.0, 5.0, 110.0]], dtype=torch.float64)
    v = torch.nn.functional.normalize(torch.tensor([[-0.7, 0.3, 0.6], [0.5, -0.4, 0.1]], dtype=torch.float64), dim=-1)
    planes = contour_planes(p, v, 4.0)
    points = contour_points(planes)
    homogeneous = torch.cat([points, torch.ones_like(points[..., :1])], -1)
    assert float(torch.einsum("mex,mepx->mep", planes, homogeneous).abs().max()) < 1e-12
    along = points[:, :, 1] - points[:, :, 0]
    assert bool(((along[:, 0] * along[:, 1]).sum(-1) > 0).all())


def taken(hard, rotation_deg: float, shift_mm: float) -> int:
    """Pictures in which a candidate lies where an answer that is off by so much expects the shaft."""
    images, camera, p, v, visible = hard
    axis = torch.nn.functional.normalize(torch.tensor([0.2, -0.3, 1.0], dtype=torch.float64), dim=-1)
    turn = rotvec_to_matrix(np.deg2rad(rotation_deg) * axis)
    side = torch.nn.functional.normalize(torch.tensor([1.0, 1.0, 0.3], dtype=torch.float64), dim=-1)
    planes = contour_planes(p @ turn.mT + shift_mm * side, v @ turn.mT, 4.0)
    expected = contour_points(planes).float()
    detector = ShaftDetector(camera=camera)
    found = [detector.detect_near(images[i : i + 1], expected[i : i + 1]) for i in range(FRAMES)]
    choices = [consistent_choice(f, planes[i : i + 1], GATE).candidate for i, f in enumerate(found)]
    return sum(int(c) >= 0 for c, seen in zip(choices, visible, strict=True) if seen)


def test_a_wrong_answer_gathers_no_support(hard):
    """Off by 5 deg and 10 mm, what is expected lies beside the shaft; what is looked at there is not taken for it."""
    visible = int(hard[-1].sum())
    assert taken(hard, 0.0, 0.0) >= 0.8 * visible
    assert taken(hard, 5.0, 10.0) <= 0.2 * visible
