"""Detections and kinematics to the solver's observations."""

from typing import Any

import numpy as np
import torch
from jaxtyping import Float
from torch import Tensor

from rmis_calib.config import CalibrationConfig
from rmis_calib.geometry.cameras import Camera
from rmis_calib.io import Recording, ShaftObservations
from rmis_calib.pipeline.arms.poses import MotionPoses
from rmis_calib.pipeline.motions.association import Choice, reversed_direction
from rmis_calib.pipeline.pictures.detection import View
from rmis_calib.pipeline.words import words_of
from rmis_calib.solver import Problem
from rmis_calib.vision import FrameReason, ShaftDetections

DIRECTION_UNKNOWN = "the picture does not show on which side the tip is"
ANOTHER_INSTRUMENT = "no shaft in the picture is where the joints put the instrument"


def assemble(
    recording: Recording,
    poses: MotionPoses,
    views: tuple[View, ...],
    choices: tuple[Choice, ...],
    config: CalibrationConfig,
) -> ShaftObservations:
    """The solver's input, one motion a frame whose joints are known.

    Args:
        recording: cameras, shaft diameter and head points.
        poses: kinematics of the motions.
        views: detections of every frame.
        choices: candidate of every motion, one entry a view.
        config: what the pictures leave out.
    """
    errors, focal = config.picture_errors, float(recording.stereo.right.focal)
    arrays: dict[str, Any] = {}
    for view, choice in zip(views, choices, strict=True):
        camera = recording.stereo.left if view.side == "left" else recording.stereo.right
        model_sigma = errors.model_sigma_px / float((camera or recording.stereo.right).focal)
        arrays |= _measured(view.side, view.at(poses.frames), choice, model_sigma)
    extrinsics = recording.stereo.camera_left_T_camera_right
    return ShaftObservations(
        arm_T_rcm=poses.arm_T_rcm.cpu().numpy(),
        rcm_v_axis=poses.rcm_v_axis.cpu().numpy(),
        camera_left_T_camera_right=extrinsics.matrix.numpy() if extrinsics is not None and len(views) == 2 else None,
        shaft_radius_mm=recording.shaft_diameter_mm / 2,
        **setup_observations(poses),
        rcm_s_end_mm=poses.rcm_s_end_mm.cpu().numpy(),
        sigma_edge_bias=errors.edge_bias_px / focal,
        sigma_focal=errors.focal_sigma_relative,
        sigma_centre=errors.centre_sigma_px / focal,
        sigma_lens=errors.lens_sigma,
        sigma_readout=_readout_sigma(recording, config),
        sigma_rcm_mm=recording.robot.rcm_sigma_mm,
        **head_observations(recording, poses, views),
        **arrays,
    )


def _readout_sigma(recording: Recording, config: CalibrationConfig) -> float:
    """As `sigma_readout`; 0 where the recording tells how long its rows take, whose points are then put to one
    instant."""
    told = bool(recording.rolling_shutter_s)
    focal_rows = float(recording.stereo.right.focal) / recording.right.size[0]
    return 0.0 if told else config.picture_errors.readout_sigma_s * focal_rows


def problem_of(observations: ShaftObservations, config: CalibrationConfig) -> Problem:
    """The configured kinds of measurement as the solver's tensors."""
    return Problem.from_observations(observations, device=config.device).only(*config.measurements)


def setup_observations(poses: MotionPoses) -> dict[str, Any]:
    """The laparoscope's own kinematics, and the set-up where somebody states it."""
    if poses.laparoscope_base_T_arm is None or poses.laparoscope_base_T_instrument_base is None:
        return {}
    arrays: dict[str, Any] = {"laparoscope_base_T_arm": poses.laparoscope_base_T_arm.cpu().numpy()}
    if poses.setup_is_stated:
        arrays["laparoscope_base_T_instrument_base"] = poses.laparoscope_base_T_instrument_base.cpu().numpy()
        if poses.setup_sigma is not None:
            arrays["sigma_setup_mm"], arrays["sigma_setup_rad"] = poses.setup_sigma
    return arrays


def head_observations(recording: Recording, poses: MotionPoses, views: tuple[View, ...]) -> dict[str, Any]:
    """Labelled head points as normalised undistorted coordinates, NaN where there is none; moved as their view says."""
    points = recording.head_points
    if points is None:
        return {}
    arrays = {"rcm_p_head": poses.rcm_p_head.cpu().numpy()}
    steps = {view.side: view.head_step for view in views}
    for side, camera in (("right", recording.stereo.right), ("left", recording.stereo.left)):
        xy = None if camera is None else labelled_heads(recording, side, camera, steps.get(side))
        if xy is not None:
            arrays[f"head_{side}"] = xy[poses.frames].numpy()
    return arrays


def labelled_heads(
    recording: Recording, side: str, camera: Camera, step: Float[Tensor, "n 2"] | None
) -> Float[Tensor, "n 2"] | None:
    """Labelled head points of one camera in every frame, normalised undistorted coordinates; NaN where there is none.

    Args:
        recording: with the labels.
        side: `right` or `left`.
        camera: by which they are undistorted.
        step: how far they are to be moved (`View.head_step`).
    """
    uv = None if recording.head_points is None else recording.head_points.uv(side)
    if recording.head_points is None or uv is None:
        return None
    xy, valid = camera.undistort_points(torch.as_tensor(uv, dtype=torch.float64))
    by_frame = torch.full((recording.n_frames, 2), torch.nan, dtype=torch.float64)
    by_frame[torch.as_tensor(recording.head_points.frames)] = torch.where(valid[:, None], xy, torch.nan)
    return by_frame if step is None else by_frame + step.cpu()


def reasons_for(view: View, poses: MotionPoses, choice: Choice) -> np.ndarray:
    """(M,) why a motion has no shaft in this view; empty where it has one."""
    found = view.at(poses.frames)
    reasons = words_of(found.reason, [reason.sentence for reason in FrameReason])
    reasons[found.valid.any(-1).cpu().numpy()] = DIRECTION_UNKNOWN
    reasons[(found.valid & found.direction_known).any(-1).cpu().numpy()] = ANOTHER_INSTRUMENT
    reasons[choice.taken.cpu().numpy()] = ""
    return reasons


def _measured(side: str, detections: ShaftDetections, choice: Choice, model_sigma: float) -> dict[str, np.ndarray]:
    """The chosen candidates as arrays of docs/observations.md; `model_sigma`, in normalised units, is added to
    every sigma in quadrature."""
    rows = torch.arange(len(choice.candidate), device=choice.candidate.device)
    best = choice.candidate.clamp_min(0)
    turned = choice.reversed
    least = torch.tensor(model_sigma, dtype=torch.float64, device=turned.device)

    def pick(name: str) -> Tensor:
        value = getattr(detections, name)[rows, best]
        return value.double() if value.is_floating_point() else value

    def known(value: Tensor, valid: Tensor) -> np.ndarray:
        return torch.where(valid.reshape(-1, *[1] * (value.ndim - 1)), value, torch.nan).cpu().numpy()

    contour, axis, sigma = pick("contour_xy"), pick("axis_xy"), pick("contour_sigma")
    contour = torch.where(turned[:, None, None, None], reversed_direction(contour), contour)
    axis = torch.where(turned[:, None, None], axis.flip(-2), axis)
    sigma = torch.where(turned[:, None], sigma.flip(-1), sigma)
    has_end = choice.taken & pick("end_valid") & ~turned
    kind = pick("end_kind")
    return {
        f"axis_{side}": known(axis, choice.taken),
        f"sigma_axis_{side}": known(pick("axis_sigma").hypot(least / 2**0.5), choice.taken),
        f"contour_{side}": known(contour, choice.taken),
        f"sigma_contour_{side}": known(sigma.hypot(least), choice.taken),
        f"end_{side}": known(pick("end_xy"), has_end),
        f"sigma_end_{side}": known(pick("end_sigma").hypot(least), has_end),
        f"end_kind_{side}": known(kind.double(), has_end & (kind >= 0)),
        f"end_sureness_{side}": known(pick("end_sureness"), has_end & (kind >= 0)),
        f"valid_{side}": choice.taken.cpu().numpy(),
    }
