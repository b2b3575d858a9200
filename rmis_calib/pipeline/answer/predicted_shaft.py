"""Where a result puts the instrument: points in a camera, and where these lie in its picture."""

from dataclasses import dataclass

import numpy as np
import torch
from jaxtyping import Float, Int
from torch import Tensor

from rmis_calib.geometry.cameras import Camera
from rmis_calib.geometry.lines import contour_planes
from rmis_calib.geometry.rigid import rotate_vectors, transform_points
from rmis_calib.pipeline.answer.run import CalibrationRun
from rmis_calib.pipeline.pictures.detection import View

_SAMPLES = 200
LEAST_DEPTH_MM = 1.0


@dataclass(frozen=True, eq=False)
class PredictedShaft:
    """The instrument at M motions, in one camera, mm.

    Attributes:
        rcm, end, head: remote centre, end of the shaft and head point.
        edges: (M, 2, p, 3) points of the lines in which the rays touch the shaft, from the RCM to its end; edge 0 is
            the left one of who looks towards the tip.
        camera_R_arm: rotation of the answer.
    """

    rcm: Float[Tensor, "m 3"]
    end: Float[Tensor, "m 3"]
    head: Float[Tensor, "m 3"]
    edges: Float[Tensor, "m 2 p 3"]
    camera_R_arm: Float[Tensor, "3 3"]


def predict_shaft(run: CalibrationRun, view: View, motions: Int[np.ndarray, " m"]) -> PredictedShaft | None:
    """Where the result puts the instrument at these motions; None without a transform."""
    camera_T_arm = run.camera_T_arm(view)
    if camera_T_arm is None:
        return None
    at = torch.as_tensor(motions, device=camera_T_arm.device)
    poses = run.poses
    camera_T_rcm = camera_T_arm @ poses.arm_T_rcm[at]
    rcm = camera_T_rcm[:, :3, 3]
    v = rotate_vectors(camera_T_rcm, poses.rcm_v_axis[at])
    end = rcm + v * (poses.rcm_s_end_mm[at] + run.result.nuisance("end_offset"))[:, None]
    radius_mm = run.result.nuisance("radius", run.recording.shaft_diameter_mm / 2)
    return PredictedShaft(
        rcm=rcm.cpu(),
        end=end.cpu(),
        head=transform_points(camera_T_rcm, poses.rcm_p_head[at]).cpu(),
        edges=shaft_edges(rcm, end, radius_mm).cpu(),
        camera_R_arm=camera_T_arm[:3, :3].cpu(),
    )


def shaft_edges(
    camera_p_rcm: Float[Tensor, "*batch 3"], camera_p_end: Float[Tensor, "*batch 3"], radius_mm: float
) -> Float[Tensor, "*batch 2 p 3"]:
    """Points of the two lines in which the camera's rays touch a cylinder, from the RCM to its end: the feet, on the
    two contour planes, of points of the axis."""
    along = camera_p_end - camera_p_rcm
    n = contour_planes(camera_p_rcm, torch.nn.functional.normalize(along, dim=-1), radius_mm)[..., :, None, :]
    part = torch.linspace(0.0, 1.0, _SAMPLES, dtype=along.dtype, device=along.device)[:, None]
    axis = (camera_p_rcm[..., None, :] + along[..., None, :] * part)[..., None, :, :]
    return axis - (axis * n).sum(-1, keepdim=True) * n


def in_picture(camera: Camera, camera_p_x: Float[Tensor, "*batch 3"]) -> Float[np.ndarray, "*batch 2"]:
    """Raw pixels of points; NaN where a point is behind the camera or beyond the reach of the lens model."""
    uv, valid = camera.project(camera_p_x)
    valid = valid & (camera_p_x[..., 2] > LEAST_DEPTH_MM)
    return torch.where(valid[..., None], uv, torch.nan).numpy()


def inside(uv: Float[np.ndarray, "*batch 2"], size: tuple[int, int], margin: float = 0.0) -> np.ndarray:
    """(*batch) whether pixels lie in a picture of this (height, width), widened by a part of its width."""
    height, width = size
    more = margin * width
    with np.errstate(invalid="ignore"):
        return (uv >= -more).all(-1) & (uv[..., 0] < width + more) & (uv[..., 1] < height + more)
