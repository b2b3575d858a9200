"""Edges that the pictures show along the predicted contours: the answer against the pictures, not line against line.

The shaft that an answer predicts is looked for in pictures of used motions, at stations along both contours from the
picture's border to the shaft's end. Nothing of what was detected there takes part.
"""

from collections.abc import Iterator
from dataclasses import fields

import numpy as np
import torch
from jaxtyping import Float, Int
from torch import Tensor

from rmis_calib.geometry.cameras import Camera
from rmis_calib.pipeline.answer.predicted_shaft import LEAST_DEPTH_MM, predict_shaft
from rmis_calib.pipeline.answer.run import CalibrationRun
from rmis_calib.pipeline.answer.view_edges import STRETCHES, ViewEdges
from rmis_calib.pipeline.pictures.detection import View
from rmis_calib.vision.fine.predicted_edges import PredictedEdges, edges_at
from rmis_calib.vision.image.sampling import inside

STATIONS = 24
"""Along each contour; a multiple of `STRETCHES`."""
MOST_MOTIONS = 60
"""Pictures a camera: to read and look at more takes time, and tells little more."""
_AT_ONCE = 16
"""Pictures in memory."""


def picture_edges(run: CalibrationRun) -> tuple[ViewEdges, ...]:
    """Edges in pictures of the used motions in which a camera's shaft was found, evenly spread ones where there are
    many; nothing without an answer."""
    if run.result.camera_right_T_arm is None:
        return ()
    found = []
    for view, choice in zip(run.views, run.choices, strict=True):
        used = run.result.motions.used[run.poses.frames] & choice.taken.cpu().numpy()
        motions = np.array([m for m in np.flatnonzero(used) if view.source.has(int(run.poses.frames[m]))], dtype=int)
        motions = motions[np.unique(np.linspace(0, len(motions) - 1, min(len(motions), MOST_MOTIONS)).astype(int))]
        camera = run.camera(view)
        if camera is not None and len(motions):
            found.append(_in_view(view, camera, motions, run))
    return tuple(found)


def _in_view(view: View, camera: Camera, motions: Int[np.ndarray, " m"], run: CalibrationRun) -> ViewEdges:
    parts = list(_read(view, camera, motions, run))
    found = PredictedEdges(*(torch.cat([getattr(part, f.name) for part in parts]) for f in fields(PredictedEdges)))
    left, right = found.px.unflatten(-1, (STRETCHES, -1)).nanquantile(0.5, dim=-1).unbind(1)  # (m, b) each
    of_k1 = _of_k1(found.uv, camera.to(found.uv.dtype)).unflatten(-1, (STRETCHES, -1)).mean(-1)
    tensors = (found.px, found.looked, found.uv, 0.5 * (right - left), 0.5 * (right + left), of_k1)
    return ViewEdges(view.side, motions, *(value.cpu().numpy() for value in tensors))


def _of_k1(uv: Float[Tensor, "m 2 s 2"], camera: Camera) -> Float[Tensor, "m s"]:
    """How far to the right radial distortion of k1 = 1 moves the middle between both contours, px."""
    focal, centre = torch.stack([camera.fx, camera.fy]), torch.stack([camera.cx, camera.cy])
    middle = (uv.mean(1) - centre) / focal
    along = torch.nn.functional.normalize((uv[:, :, -1] - uv[:, :, 0]).sum(1), dim=-1)
    right = torch.stack([-along[:, 1], along[:, 0]], dim=-1)[:, None]
    return (middle.square().sum(-1, keepdim=True) * middle * focal * right).sum(-1)


def _read(view: View, camera: Camera, motions: Int[np.ndarray, " m"], run: CalibrationRun) -> Iterator[PredictedEdges]:
    """A few pictures at a time."""
    device = run.poses.arm_T_rcm.device
    for start in range(0, len(motions), _AT_ONCE):
        some = motions[start : start + _AT_ONCE]
        shaft = predict_shaft(run, view, some)
        assert shaft is not None
        images = view.source.frames(run.poses.frames[some].tolist()).to(device)
        yield edges_at(images, camera, visible_stations(shaft.edges.to(device), camera, view.source.size))


def visible_stations(
    edges: Float[Tensor, "m 2 p 3"], camera: Camera, size: tuple[int, int]
) -> Float[Tensor, "m 2 s 2"]:
    """Places along the visible part of each contour, in normalised undistorted coordinates; NaN where there is none.

    Args:
        edges: points of the contours in the camera, mm (`predict_shaft`).
        camera: which sees them.
        size: (height, width) of its pictures, px.
    """
    uv, valid = camera.project(edges)
    seen = valid & (edges[..., 2] > LEAST_DEPTH_MM) & inside(uv, size)
    count = seen.shape[-1]
    index = torch.arange(count, device=edges.device)
    ends = torch.stack([torch.where(seen, index, count).amin(-1), torch.where(seen, index, -1).amax(-1)], dim=-1)
    ends_p = edges.gather(2, ends.clamp(0, count - 1)[..., None].expand(-1, -1, -1, 3))
    first, last = (ends_p[..., :2] / ends_p[..., 2:]).unbind(2)
    share = (torch.arange(STATIONS, dtype=edges.dtype, device=edges.device)[:, None] + 0.5) / STATIONS
    xy = first[:, :, None] + share * (last - first)[:, :, None]
    has_some = (ends[..., 1] > ends[..., 0]).all(-1)  # of both contours: else no width is seen
    return torch.where(has_some[:, None, None, None], xy, torch.nan)
