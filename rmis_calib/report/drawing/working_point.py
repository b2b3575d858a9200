"""How far off the instrument may be drawn: the answer's sigma as an ellipse on a frame, at the frame's own scale."""

import math
from dataclasses import dataclass

import cv2
import numpy as np
import torch
from jaxtyping import Float, UInt8

from rmis_calib.geometry.cameras import Camera
from rmis_calib.pipeline.answer.predicted_shaft import PredictedShaft, in_picture, inside, predict_shaft
from rmis_calib.pipeline.answer.run import CalibrationRun
from rmis_calib.pipeline.scene import point_covariance
from rmis_calib.report.drawing.choosing import largest_residual
from rmis_calib.report.drawing.frames import overlays
from rmis_calib.report.drawing.marks import Mark
from rmis_calib.report.drawing.overlays import Overlay

_SHOWN_MM, _SHOWN_PART = 34.0, 0.3
"""Width of the cut-out at least, mm and part of the frame: the tip of an instrument and what is about it."""
_SIGMAS_SHOWN = 10.0
"""Width of the cut-out in sigmas at least: the 2-sigma ellipse fits with room."""
_ASPECT = 4.0 / 3.0
_WIDTH_PX = 720
_RULERS_MM = (1.0, 2.0, 5.0, 10.0, 20.0, 50.0, 100.0)
_ELLIPSE_POINTS = 48
_NOT_HERE = ("x", "y", "z", "rcm", "refused", "search")
_STEP_MM = 1e-3


@dataclass(frozen=True)
class WorkingPointPicture:
    """A cut-out of a frame about the head point, with the answer's sigma there.

    Attributes:
        overlay: the cut-out with the ellipses, enlarged.
        ruler_mm: length of the scale bar.
        ruler_px: the same in the picture, at the head point's distance.
        enlarged: how many times the frame is enlarged.
        depth_mm: distance of the head point from the camera along the viewing direction.
        across_mm: 1 sigma along the ellipse's long and short axis, mm at that distance.
        along_view_mm: 1 sigma along the ray.
        total_mm: root of the trace of the head point's covariance.
    """

    overlay: Overlay
    ruler_mm: float
    ruler_px: float
    enlarged: float
    depth_mm: float
    across_mm: tuple[float, float]
    along_view_mm: float
    total_mm: float


def working_point_picture(run: CalibrationRun) -> WorkingPointPicture | None:
    """The usual frame (of the better half) of the right camera whose head point is nearest to the working point, cut
    out about it; None without a covariance, or where no head point is in view."""
    result, view = run.result, run.views[0]
    camera, camera_T_arm = run.camera(view), run.camera_T_arm(view)
    if view.side != "right" or result.covariance is None or camera is None or camera_T_arm is None:
        return None
    residual = np.where(result.motions.used[run.poses.frames], largest_residual(run), np.nan)
    with np.errstate(invalid="ignore"):
        motions = np.flatnonzero(residual <= np.nanmedian(residual)) if np.isfinite(residual).any() else np.arange(0)
    predicted = predict_shaft(run, view, motions)
    if predicted is None or not len(motions):
        return None
    index = _nearest(predicted, camera, view.source.size, result.observability.working_point_mm)
    if index is None:
        return None
    head = predicted.head[index].numpy()
    covariance = point_covariance(head, camera_T_arm[:3, 3].cpu().numpy(), result.covariance)
    overlay = next(iter(overlays(run, motions[index : index + 1], view.side)))
    return _cut_out(overlay, camera, head, covariance)


def _nearest(
    predicted: PredictedShaft, camera: Camera, size: tuple[int, int], working_point_mm: tuple | None
) -> int | None:
    """The motion whose head point is in the picture and nearest to the working point."""
    seen = inside(in_picture(camera, predicted.head), size, margin=-0.08)
    if not seen.any():
        return None
    heads = predicted.head.numpy()
    wanted = heads[seen].mean(0) if working_point_mm is None else np.asarray(working_point_mm, dtype=float)
    return int(np.where(seen, np.linalg.norm(heads - wanted, axis=1), np.inf).argmin())


def _cut_out(
    overlay: Overlay, camera: Camera, head: Float[np.ndarray, "3"], covariance: Float[np.ndarray, "3 3"]
) -> WorkingPointPicture:
    px_T_mm = projection_jacobian(camera, head)
    uv = in_picture(camera, torch.as_tensor(head)[None])[0]
    px_per_mm = float(np.sqrt(np.abs(np.linalg.det(px_T_mm @ px_T_mm.T))) ** 0.5)
    covariance_px = px_T_mm @ covariance @ px_T_mm.T
    sigmas_px = np.sqrt(np.linalg.eigvalsh(covariance_px).clip(0.0))[::-1]
    height, width = overlay.image.shape[:2]
    wanted = max(_SHOWN_MM * px_per_mm, _SHOWN_PART * width, _SIGMAS_SHOWN * float(sigmas_px[0]))
    shown = (min(wanted, width, height * _ASPECT), min(wanted / _ASPECT, width / _ASPECT, height))
    corner = np.clip(uv - np.array(shown) / 2, 0.0, np.array([width, height]) - shown)
    enlarged = _WIDTH_PX / shown[0]
    image = _enlarged(overlay.image, corner, shown)
    marks = [mark for mark in overlay.marks if mark.style not in _NOT_HERE]
    marks += [Mark(f"sigma{k}", uv + k * ellipse(covariance_px)) for k in (2, 1)]
    ray = head / np.linalg.norm(head)
    ruler_mm = max((mm for mm in _RULERS_MM if mm * px_per_mm <= 0.3 * shown[0]), default=_RULERS_MM[0])
    return WorkingPointPicture(
        overlay=Overlay(
            frame=overlay.frame,
            camera=overlay.camera,
            image=image,
            caption=overlay.caption,
            used=overlay.used,
            marks=tuple(Mark(m.style, (m.points + 0.5 - corner) * enlarged - 0.5, m.label) for m in marks),
        ),
        ruler_mm=ruler_mm,
        ruler_px=ruler_mm * px_per_mm * enlarged,
        enlarged=enlarged,
        depth_mm=float(head[2]),
        across_mm=(float(sigmas_px[0]) / px_per_mm, float(sigmas_px[1]) / px_per_mm),
        along_view_mm=math.sqrt(max(0.0, float(ray @ covariance @ ray))),
        total_mm=math.sqrt(max(0.0, float(np.trace(covariance)))),
    )


def projection_jacobian(camera: Camera, p: Float[np.ndarray, "3"]) -> Float[np.ndarray, "2 3"]:
    """Pixels per millimetre by which the image of a point moves with the point."""
    steps = _STEP_MM * torch.eye(3, dtype=torch.float64)
    ahead, behind = (camera.project(torch.as_tensor(p) + sign * steps)[0].numpy() for sign in (1.0, -1.0))
    return (ahead - behind).T / (2.0 * _STEP_MM)


def ellipse(covariance: Float[np.ndarray, "2 2"]) -> Float[np.ndarray, "p 2"]:
    """Points, from its centre, of the ellipse at Mahalanobis distance 1; closed."""
    values, axes = np.linalg.eigh(covariance)
    angle = np.linspace(0.0, 2.0 * math.pi, _ELLIPSE_POINTS + 1)
    circle = np.stack([np.cos(angle), np.sin(angle)], axis=1)
    return circle * np.sqrt(values.clip(0.0)) @ axes.T


def _enlarged(
    image: UInt8[np.ndarray, "h w 3"], corner: Float[np.ndarray, "2"], shown: tuple[float, float]
) -> UInt8[np.ndarray, "a b 3"]:
    """The part of a picture from a corner on, at the page's width."""
    scale = _WIDTH_PX / shown[0]
    size = (_WIDTH_PX, round(shown[1] * scale))
    # warpAffine counts pixel centres: centre x of the cut-out is (x + 0.5) / scale + corner - 0.5 of the picture.
    shift = 0.5 / scale - 0.5 + corner
    matrix = np.array([[1 / scale, 0.0, shift[0]], [0.0, 1 / scale, shift[1]]])
    flags = cv2.INTER_CUBIC | cv2.WARP_INVERSE_MAP
    return cv2.warpAffine(image, matrix, size, flags=flags, borderMode=cv2.BORDER_REPLICATE)
