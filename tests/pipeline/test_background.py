"""What stands still while the instrument moves is background; the instrument itself never is."""

import numpy as np
import torch

from rmis_calib.geometry.lines import contour_planes
from rmis_calib.pipeline.arms.poses import MotionPoses
from rmis_calib.pipeline.pictures.background import background_candidates, without_background
from rmis_calib.vision import FrameReason, ShaftDetections

MOTIONS, RADIUS_MM = 60, 4.0
PORT = torch.tensor([90.0, -40.0, 20.0], dtype=torch.float64)


def moving(spread_deg: tuple[float, float], seed: int = 0) -> MotionPoses:
    """An instrument that turns about its port, seen by a camera at the arm's frame, by random angles about two axes."""
    generator = torch.Generator().manual_seed(seed)
    first = torch.nn.functional.normalize(torch.tensor([-3.0, 2.0, 100.0], dtype=torch.float64) - PORT, dim=0)
    up = torch.nn.functional.normalize(torch.linalg.cross(first, PORT), dim=0)  # out of the plane through the camera
    across = torch.linalg.cross(up, first)
    angle = torch.deg2rad(torch.tensor(spread_deg)) * (torch.rand(MOTIONS, 2, generator=generator) - 0.5)
    v = torch.nn.functional.normalize(first + angle[:, :1] * up + angle[:, 1:] * across, dim=-1)
    pose = torch.eye(4, dtype=torch.float64).repeat(MOTIONS, 1, 1)
    pose[:, :3, 3] = PORT
    return MotionPoses(np.arange(MOTIONS), pose, v, torch.full((MOTIONS,), 100.0), PORT.expand(MOTIONS, 3))


def seen(poses: MotionPoses, still: bool = True) -> ShaftDetections:
    """The instrument as the first candidate of every motion, and a strip that stands still as the second."""
    planes = contour_planes(poses.arm_T_rcm[:, :3, 3], poses.rcm_v_axis, RADIUS_MM)
    axis = torch.nn.functional.normalize(planes.sum(1), dim=-1)
    axis = torch.stack([axis, torch.tensor([0.6, -0.8, 0.05], dtype=torch.float64).expand_as(axis)], 1)
    size = axis[..., :2].square().sum(-1, keepdim=True)
    foot = -axis[..., 2:] * axis[..., :2] / size
    along = torch.stack([-axis[..., 1], axis[..., 0]], -1)
    noise = 0.0005 * torch.randn(MOTIONS, 2, 1, generator=torch.Generator().manual_seed(9), dtype=torch.float64)
    points = torch.stack([foot, foot + 0.1 * along], 2) + noise[..., None]
    more = dict.fromkeys(("contour_sigma", "end_xy", "end_uv", "scatter_px", "blur_px"), (2,))
    more |= {"contour_xy": (2, 2, 2), "contour_uv": (2, 4, 2), "straight_px": (2, 8), "straight_uv": (2, 8, 2)}
    fields = {n: torch.zeros(MOTIONS, 2, *more.get(n, ())) for n in ShaftDetections.__dataclass_fields__}
    fields |= {n: fields[n].bool() for n in ("end_valid", "direction_known")}
    fields |= {"valid": torch.tensor([True, still]).expand(MOTIONS, 2), "axis_xy": points}
    return ShaftDetections(**fields | {"reason": torch.zeros(MOTIONS).long(), "end_kind": fields["end_kind"].long()})


def test_a_strip_that_stands_still_is_background_and_the_instrument_is_not():
    poses = moving((10.0, 10.0))
    assert background_candidates(seen(poses), poses).float().mean(0).tolist() == [0.0, 1.0]


def test_a_resting_instrument_is_no_background():
    poses = moving((0.0, 0.0))
    assert not background_candidates(seen(poses, still=False), poses).any()


def test_an_instrument_that_turns_in_the_plane_of_its_line_is_no_background():
    """Its line hardly moves, though its joints do: here by 10 deg, within a tenth of a degree across the plane."""
    poses = moving((0.1, 10.0))
    assert not background_candidates(seen(poses, still=False), poses).any()


def test_frames_that_are_left_with_nothing_say_why():
    poses = moving((10.0, 10.0))
    found = seen(poses)
    only_still = ShaftDetections(**vars(found) | {"valid": found.valid & torch.tensor([False, True])})
    left, count = without_background(only_still, poses)
    assert count == MOTIONS and not left.valid.any()
    assert left.reason.tolist() == [int(FrameReason.BACKGROUND)] * MOTIONS
