"""One picture a stage of the search, so that a user can see why a frame failed."""

import cv2
import numpy as np
import torch
from torch import Tensor

from rmis_calib.vision.coarse.search import SearchTrace

_LINE_COLOUR = (90, 220, 255)
_STRIP_COLOURS = ((255, 196, 0), (0, 214, 255), (170, 255, 90))


def draw_stages(stages: SearchTrace, frame: int = 0) -> dict[str, np.ndarray]:
    """Stage name -> (h, w, 3) uint8 RGB, in the order in which the stages run; all on the small undistorted picture.

    Args:
        stages: from `ShaftDetector.explain`.
        frame: which frame of the batch.
    """
    small = (stages.rgb[frame].permute(1, 2, 0).clamp(0, 1) * 255).byte().cpu().numpy()
    seen = stages.seen[frame].cpu().numpy()
    field = small.copy()
    field[~seen] = (70, 30, 110)
    unlike = _heat(stages.unlike[frame], stages.seen[frame])
    ridges = small // 2
    ridges[stages.ridge[frame].cpu().numpy()] = (255, 80, 60)
    votes = _heat(stages.votes[frame].sqrt(), torch.ones_like(stages.votes[frame], dtype=torch.bool))
    return {
        "1_small": small,
        "2_field_of_view": field,
        "3_unlike_a_shaft": unlike,
        "3_unlike_a_shaft_lit": _heat(stages.lit[frame], stages.seen[frame]),
        "4_ridges": ridges,
        "5_votes": votes,
        "6_lines": _lines(small.copy(), stages, frame),
        "7_strips": _strips(small.copy(), stages, frame),
    }


def _heat(values: Tensor, mask: Tensor) -> np.ndarray:
    """Numbers as colours, dark is low, over the range that the mask shows."""
    shown = values[mask] if bool(mask.any()) else values.flatten()
    low, high = float(shown.min()), float(shown.max())
    scaled = ((values - low) / max(high - low, 1e-6) * 255).clamp(0, 255).byte().cpu().numpy()
    return np.ascontiguousarray(cv2.applyColorMap(scaled, cv2.COLORMAP_VIRIDIS)[..., ::-1])


def _lines(canvas: np.ndarray, stages: SearchTrace, frame: int) -> np.ndarray:
    """The most voted lines, brighter for more votes, each with a tick towards its outer side."""
    factor, votes = stages.factor, stages.lines.votes[frame]
    middle = np.array([(canvas.shape[1] - 1) / 2, (canvas.shape[0] - 1) / 2])
    reach = float(np.hypot(*canvas.shape[:2]))
    for i in votes.argsort().tolist():
        if float(votes[i]) <= 0:
            continue
        normal = stages.lines.normal[frame, i].double().cpu().numpy()
        foot = middle + normal * float(stages.lines.rho[frame, i]) / factor
        along = np.array([-normal[1], normal[0]]) * reach
        shade = 0.3 + 0.7 * float(votes[i] / votes.max())
        colour = tuple(int(c * shade) for c in _LINE_COLOUR)
        cv2.line(canvas, _pixel(foot - along), _pixel(foot + along), colour, 1, cv2.LINE_AA)
        cv2.line(canvas, _pixel(foot), _pixel(foot + 5 * normal), (255, 255, 255), 1, cv2.LINE_AA)
    return canvas


def _strips(canvas: np.ndarray, stages: SearchTrace, frame: int) -> np.ndarray:
    """The best strips with the stations at which they look like a shaft."""
    evidence, scores = stages.evidence, stages.scores[frame]
    strips, t = evidence.strips, evidence.t
    edge = strips.contour(t.expand(*strips.valid.shape, len(t)))
    points = strips.points(t.expand_as(edge[:, :, 0])[:, :, None].expand_as(edge), edge)
    place = (points[frame] - points.new_tensor(stages.origin)) / stages.factor
    for rank, i in enumerate(scores.argsort(descending=True)[:3].tolist()):
        if float(scores[i]) <= 0:
            continue
        for side in range(2):
            for dot in place[i, side][evidence.on[frame, i]].cpu().numpy():
                cv2.circle(canvas, _pixel(dot), 1, _STRIP_COLOURS[rank], -1, cv2.LINE_AA)
    return canvas


def _pixel(point: np.ndarray) -> tuple[int, int]:
    return round(float(np.clip(point[0], -1e4, 1e4))), round(float(np.clip(point[1], -1e4, 1e4)))
