"""Among many false candidates, those that move as the joints say are found."""

import numpy as np
import pytest
import torch

from data_synth.contours import view_cylinder
from rmis_calib.pipeline.arms.poses import MotionPoses
from rmis_calib.pipeline.motions.consensus import choices_by_consensus
from rmis_calib.vision import ShaftDetections

RADIUS_MM, MOTIONS, SHARE = 4.0, 60, 0.35


def frame_along(v):
    """Rotations whose third column is v."""
    x = np.cross(v, [0.0, 0.3, 1.0])
    x /= np.linalg.norm(x, axis=-1, keepdims=True)
    return np.stack([x, np.cross(v, x), v], -1)


def shafts(rng, spread):
    """RCMs and directions of a shaft that comes in from the side, in the right camera."""
    v = np.array([-0.7, 0.35, 0.65]) + spread * rng.normal(size=(MOTIONS, 3))
    return np.array([90.0, -40.0, 20.0]) + 4 * rng.normal(size=(MOTIONS, 3)), v / np.linalg.norm(
        v, axis=1, keepdims=True
    )


def contour_points(rng, p, v, camera_T_right):
    """(m, edge, point, xy): where two places of the axis are on either contour, in one camera, with noise of 0.5 px."""
    p, v = p @ camera_T_right[:3, :3].T + camera_T_right[:3, 3], v @ camera_T_right[:3, :3].T
    lines = view_cylinder(p, v, RADIUS_MM).n_contour
    lines = lines / np.linalg.norm(lines[..., :2], axis=-1, keepdims=True)
    points = []
    for s in (70.0, 120.0):
        axis = p + s * v
        xy1 = np.concatenate([axis[:, :2] / axis[:, 2:], np.ones((MOTIONS, 1))], 1)
        off = np.einsum("mei,mi->me", lines, xy1)[..., None]
        points.append(xy1[:, None, :2] - off * lines[..., :2])
    return np.stack(points, 2) + 0.5 / 700 * rng.normal(size=(MOTIONS, 2, 2, 2))


def detections(candidates, valid):
    """(m, k, 2, 2, 2) contours; all else that a choice does not look at is NaN."""
    found = torch.from_numpy(np.stack(candidates, 1))
    valid = torch.from_numpy(np.stack(valid, 1))
    nan = torch.full(valid.shape, torch.nan)
    fields = dict.fromkeys(("axis_sigma", "end_sigma", "end_sureness", "confidence"), nan)
    fields |= dict.fromkeys(
        ("contour_sigma", "end_xy", "end_uv", "scatter_px", "blur_px"), nan[..., None].repeat(1, 1, 2)
    )
    fields |= {"axis_xy": found.mean(2), "straight_px": nan[..., None, None].repeat(1, 1, 2, 8)}
    fields |= dict.fromkeys(("straight_uv", "contour_uv"), nan[..., None, None, None].repeat(1, 1, 2, 8, 2))
    return ShaftDetections(
        valid=valid, reason=torch.zeros(MOTIONS, dtype=torch.int64), contour_xy=found, end_valid=valid & False,
        end_kind=torch.full(valid.shape, -1), direction_known=valid, **fields,
    )  # fmt: skip


def recording(rng, spread=0.12, cameras=2):
    """Poses, detections of a stereo pair, the cameras, and in which motions the shaft is among the candidates."""
    p, v = shafts(rng, spread)
    right_T_arm = np.eye(4)
    right_T_arm[:3, :3] = np.linalg.qr(rng.normal(size=(3, 3)))[0]
    right_T_arm[:3, :3] *= np.sign(np.linalg.det(right_T_arm[:3, :3]))
    right_T_arm[:3, 3] = [20.0, -30.0, 40.0]
    right_T_rcm = np.tile(np.eye(4), (MOTIONS, 1, 1))
    right_T_rcm[:, :3, :3], right_T_rcm[:, :3, 3] = frame_along(v), p
    arm_T_rcm = torch.from_numpy(np.linalg.inv(right_T_arm) @ right_T_rcm)
    axis = torch.tensor([0.0, 0.0, 1.0], dtype=torch.float64).expand(MOTIONS, 3)
    poses = MotionPoses(np.arange(MOTIONS), arm_T_rcm, axis, torch.zeros(MOTIONS).double(), torch.zeros(MOTIONS, 3))
    shown = rng.random(MOTIONS) < SHARE
    left_T_right = np.eye(4)
    left_T_right[0, 3] = 5.0
    transforms = [np.eye(4), left_T_right][:cameras]
    views = []
    for camera_T_right in transforms:
        # Another instrument, which moves by itself, is the surer candidate of every picture.
        other, turned = shafts(rng, 0.2)
        other, turned = other * [-1.0, 1.0, 1.0], turned * [-1.0, 1.0, 1.0]
        false = contour_points(rng, other, turned, camera_T_right)
        true = contour_points(rng, p, v, camera_T_right)
        views.append(detections((false, true), (np.ones(MOTIONS, bool), shown)))
    return poses, tuple(views), tuple(torch.from_numpy(t) for t in transforms), torch.from_numpy(shown)


@pytest.mark.parametrize("cameras", [1, 2])
@pytest.mark.parametrize("seed", [0, 1, 2])
def test_candidates_that_move_with_the_joints_are_found(seed, cameras):
    poses, views, transforms, shown = recording(np.random.default_rng(seed), cameras=cameras)
    choices = choices_by_consensus(poses, views, transforms, RADIUS_MM)
    assert choices is not None
    for choice in choices:
        # The shaft is there in a third of the pictures, and something else in all of them.
        assert bool((choice.candidate[shown] == 1).all())
        assert int((choice.candidate[~shown] == 0).sum()) <= 3


def test_directions_that_hardly_differ_give_no_transform():
    poses, views, transforms, _ = recording(np.random.default_rng(0), spread=0.001)
    few = tuple(view.of_frames(torch.arange(MOTIONS)) for view in views)
    for view in few:
        view.valid[:, 0] = False  # only the shaft itself
        view.direction_known[:, 0] = False
    assert choices_by_consensus(poses, few, transforms, RADIUS_MM) is None
