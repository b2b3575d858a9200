"""Frames with the detected and the predicted shaft drawn in, as the report's legend names them."""

from collections.abc import Iterator

import numpy as np
import torch
from jaxtyping import Float, UInt8
from torch import Tensor

from rmis_calib.geometry.cameras import Camera
from rmis_calib.pipeline.detection import View
from rmis_calib.pipeline.run import CalibrationRun
from rmis_calib.report.overlays import DETECTED_RGB, PREDICTED_RGB, Overlay
from rmis_calib.results import CalibrationResult
from rmis_calib.vision import draw_dot, draw_polyline

_SAMPLES = 200
_AT_ONCE = 16
"""Frames read in one call: opening and seeking a video for each takes longer than drawing, and all may not fit."""


def overlays(run: CalibrationRun, motions: np.ndarray, side: str | None = None) -> Iterator[Overlay]:
    """Pictures of these motions (increasing numbers) in each view, or in that of one side; each video is read once, a
    few frames at a time."""
    for view in run.views:
        if side not in (None, view.side):
            continue
        contours, ends = run.predicted_contours(view), run.predicted_ends(view)
        for start in range(0, len(motions), _AT_ONCE):
            part = motions[start : start + _AT_ONCE].tolist()
            images = view.source.frames(run.poses.frames[part].tolist())
            for motion, image in zip(part, images, strict=True):
                contour_n = None if contours is None else contours[motion]
                yield _overlay(run, view, motion, image, contour_n, None if ends is None else ends[motion])


def spread(total: int, count: int) -> np.ndarray:
    """Indices of `count` of `total` things, evenly spread from the first to the last; all for -1."""
    if count < 0 or count >= total:
        return np.arange(total)
    return np.unique(np.linspace(0, total - 1, count).round().astype(int)) if count else np.arange(0)


def _overlay(
    run: CalibrationRun,
    view: View,
    motion: int,
    image: UInt8[Tensor, "3 h w"],
    contour_n: Float[Tensor, "2 3"] | None,
    camera_p_end: Float[Tensor, " 3"] | None,
) -> Overlay:
    """One frame; `contour_n` and `camera_p_end` are what the result predicts for it."""
    frame = int(run.poses.frames[motion])
    canvas = np.ascontiguousarray(image.permute(1, 2, 0).numpy())
    thickness = max(1, round(canvas.shape[1] / 360))
    choice = run.choices[run.views.index(view)]
    candidate = int(choice.candidate[motion])
    detections = view.detections
    if candidate >= 0:
        for polyline in detections.contour_uv[frame, candidate].cpu().numpy():
            draw_polyline(canvas, polyline, DETECTED_RGB, thickness)
        if bool(detections.end_valid[frame, candidate]) and view.camera is not None:
            # On the axis, as the prediction is: the rim that is seen lies in front of it, several px further along.
            end = torch.nn.functional.pad(detections.end_xy[frame, candidate].double().cpu(), (0, 1), value=1.0)
            draw_dot(canvas, view.camera.project(end)[0].numpy(), DETECTED_RGB, 2 * thickness)
    camera = run.camera(view)
    if contour_n is not None and camera is not None:
        end_known = run.result.nuisances.get("end_offset") is not None
        for polyline in contour_polylines(contour_n, camera, camera_p_end if end_known else None):
            draw_polyline(canvas, polyline, PREDICTED_RGB, max(1, thickness - 1))
    if camera_p_end is not None and camera is not None:
        uv, visible = camera.project(camera_p_end.cpu())
        if bool(visible):
            draw_dot(canvas, uv.numpy(), PREDICTED_RGB, thickness)
    used = bool(run.result.motions.used[frame])
    return Overlay(
        frame=frame, camera=view.side, image=canvas, caption=_caption(run.result, view.side, frame), used=used
    )


def _caption(result: CalibrationResult, side: str, frame: int) -> str:
    """Why the motion was not used, or how far its contours are from the prediction."""
    reason = result.motions.reasons[frame]
    px = result.residual(f"contour_{side}", frame)
    return reason or ("not measured here" if px is None else f"contours {px:.2f} px from the prediction")


def contour_polylines(
    contour_n: Float[Tensor, "2 3"], camera: Camera, camera_p_end: Float[Tensor, " 3"] | None = None
) -> Float[np.ndarray, "2 p 2"]:
    """Both contour planes as raw-pixel polylines across the picture; NaN where the lens model does not reach, and$
    beyond the shaft's end, where it is known.

    Args:
        contour_n: normals of `contour_planes`, whose sign tells which way the tip is.
        camera: that sees them.
        camera_p_end: the shaft's end on its axis, mm.
    """
    line = contour_n.cpu() / contour_n[:, :2].cpu().norm(dim=-1, keepdim=True)
    foot = -line[:, 2:] * line[:, :2]
    along = torch.stack([line[:, 1], -line[:, 0]], dim=-1)  # towards the tip
    reach = 2.0 * max(camera.image_size) / float(camera.focal)
    steps = torch.linspace(-reach, reach, _SAMPLES, dtype=line.dtype)
    xy = foot[:, None] + along[:, None] * steps[:, None]
    uv, valid = camera.project(torch.cat([xy, torch.ones_like(xy[..., :1])], dim=-1))
    if camera_p_end is not None and float(camera_p_end[2]) > 0:
        end_xy = camera_p_end[:2].cpu() / camera_p_end[2].cpu()
        valid = valid & (((xy - end_xy) * along[:, None]).sum(-1) <= 0)
    return torch.where(valid[..., None], uv, torch.nan).numpy()
