"""Detections and kinematics to the solver's observations; which candidate of a frame is the instrument's shaft."""

from dataclasses import dataclass

import numpy as np
import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor

from rmis_calib.config import CalibrationConfig
from rmis_calib.geometry.lines import contour_planes, point_line_distance
from rmis_calib.geometry.rigid import rotate_vectors, transform_points
from rmis_calib.io import Recording, ShaftObservations
from rmis_calib.pipeline.detection import View
from rmis_calib.pipeline.poses import MotionPoses
from rmis_calib.vision import FrameReason, ShaftDetections

DIRECTION_UNKNOWN = "the picture does not show on which side the tip is"


@dataclass(frozen=True, eq=False)
class Choice:
    """Which candidate of each motion's frame is taken for the instrument's shaft.

    Attributes:
        candidate: (M,) index; -1 for none.
        reversed: (M,) whether RCM side and tip side (and so the two edges) are exchanged.
    """

    candidate: Int[Tensor, " m"]
    reversed: Bool[Tensor, " m"]

    @property
    def taken(self) -> Bool[Tensor, " m"]:
        return self.candidate >= 0

    def where(self, known: Bool[Tensor, " m"]) -> "Choice":
        """This choice in the motions that are known, none in the others."""
        return Choice(torch.where(known, self.candidate, -1), self.reversed & known)

    def same_as(self, other: "Choice") -> bool:
        return torch.equal(self.candidate, other.candidate) and torch.equal(self.reversed, other.reversed)


def first_choice(detections: ShaftDetections) -> Choice:
    """The most confident candidate whose tip side is known."""
    usable = detections.valid & detections.direction_known
    candidate = torch.where(usable.any(-1), usable.int().argmax(-1), -1)
    return Choice(candidate, torch.zeros_like(usable[:, 0]))


def consistent_choice(detections: ShaftDetections, predicted_n_contour: Float[Tensor, "m 2 3"]) -> Choice:
    """The candidate nearest to where a first calibration and the kinematics put the shaft.

    A candidate whose tip side the picture does not show is taken in the direction that fits. Whether the nearest one
    is near enough is the solver's outlier test, which knows the noise.
    """
    forward = _distance(detections.contour_xy, predicted_n_contour)
    backward = _distance(_reverse(detections.contour_xy), predicted_n_contour)
    backward = torch.where(detections.direction_known, torch.inf, backward)
    distance = torch.where(detections.valid, torch.minimum(forward, backward), torch.inf)
    best = distance.argmin(dim=-1)
    reached = torch.isfinite(distance.gather(-1, best[:, None])[:, 0])
    turned = (backward < forward).gather(-1, best[:, None])[:, 0]
    return Choice(torch.where(reached, best, -1), turned & reached)


def predict_contours(
    camera_T_arm: Float[Tensor, "4 4"], poses: MotionPoses, radius_mm: float
) -> Float[Tensor, "m 2 3"]:
    """Contour planes of the shaft where kinematics and calibration put it, in one camera."""
    camera_T_rcm = camera_T_arm @ poses.arm_T_rcm
    return contour_planes(camera_T_rcm[..., :3, 3], rotate_vectors(camera_T_rcm, poses.rcm_v_axis), radius_mm)


def predict_ends(camera_T_arm: Float[Tensor, "4 4"], poses: MotionPoses, offset_mm: float) -> Float[Tensor, "m 3"]:
    """The shaft's end on the axis, in one camera, mm."""
    rcm_p_end = poses.rcm_v_axis * (poses.rcm_s_end_mm + offset_mm)[:, None]
    return transform_points(camera_T_arm @ poses.arm_T_rcm, rcm_p_end)


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
    arrays: dict[str, np.ndarray] = {}
    for view, choice in zip(views, choices, strict=True):
        floor = config.model_sigma_px / float(recording.stereo.right.focal)
        arrays |= _measured(view.side, select_frames(view.detections, poses.frames), choice, floor)
    extrinsics = recording.stereo.camera_left_T_camera_right
    return ShaftObservations(
        arm_T_rcm=poses.arm_T_rcm.cpu().numpy(),
        rcm_v_axis=poses.rcm_v_axis.cpu().numpy(),
        camera_left_T_camera_right=extrinsics.matrix.numpy() if extrinsics is not None and len(views) == 2 else None,
        shaft_radius_mm=recording.shaft_diameter_mm / 2,
        rcm_s_end_mm=poses.rcm_s_end_mm.cpu().numpy(),
        sigma_edge_bias=config.edge_bias_px / float(recording.stereo.right.focal),
        **head_observations(recording, poses),
        **arrays,
    )


def head_observations(recording: Recording, poses: MotionPoses) -> dict[str, np.ndarray]:
    """Labelled head points as normalised undistorted coordinates, NaN where there is none."""
    points = recording.head_points
    if points is None:
        return {}
    arrays = {"rcm_p_head": poses.rcm_p_head.cpu().numpy()}
    for side, camera, uv in (
        ("right", recording.stereo.right, points.uv_right),
        ("left", recording.stereo.left, points.uv_left),
    ):
        if camera is None or uv is None:
            continue
        xy, valid = camera.undistort_points(torch.as_tensor(uv))
        by_frame = np.full((recording.n_frames, 2), np.nan)
        by_frame[points.frames] = np.where(valid.numpy()[:, None], xy.numpy(), np.nan)
        arrays[f"head_{side}"] = by_frame[poses.frames]
    return arrays


def reasons_for(view: View, poses: MotionPoses, choice: Choice) -> list[str]:
    """(M,) why a motion has no shaft in this view; empty where it has one."""
    codes = view.detections.reason.cpu().numpy()[poses.frames]
    found = view.found.cpu().numpy()[poses.frames]
    taken = choice.taken.cpu().numpy()
    return [
        "" if is_taken else (DIRECTION_UNKNOWN if is_found else FrameReason(int(code)).sentence)
        for code, is_found, is_taken in zip(codes, found, taken, strict=True)
    ]


def select_frames(detections: ShaftDetections, frames: np.ndarray) -> ShaftDetections:
    """The detections of some frames."""
    index = torch.as_tensor(frames, device=detections.valid.device)
    return ShaftDetections(**{name: value[index] for name, value in vars(detections).items()})


def _measured(side: str, detections: ShaftDetections, choice: Choice, floor: float) -> dict[str, np.ndarray]:
    """The chosen candidates as arrays of DESIGN.md 6.2; `floor` is the least sigma, normalised units."""
    rows = torch.arange(len(choice.candidate), device=choice.candidate.device)
    best = choice.candidate.clamp_min(0)
    turned = choice.reversed
    least = torch.tensor(floor, dtype=torch.float64, device=turned.device)

    def pick(name: str) -> Tensor:
        value = getattr(detections, name)[rows, best]
        return value.double() if value.is_floating_point() else value

    def known(value: Tensor, valid: Tensor) -> np.ndarray:
        return torch.where(valid.reshape(-1, *[1] * (value.ndim - 1)), value, torch.nan).cpu().numpy()

    contour, axis, sigma = pick("contour_xy"), pick("axis_xy"), pick("contour_sigma")
    contour = torch.where(turned[:, None, None, None], _reverse(contour), contour)
    axis = torch.where(turned[:, None, None], axis.flip(-2), axis)
    sigma = torch.where(turned[:, None], sigma.flip(-1), sigma)
    has_end = choice.taken & pick("end_valid") & ~turned
    return {
        f"axis_{side}": known(axis, choice.taken),
        f"sigma_axis_{side}": known(pick("axis_sigma").hypot(least / 2**0.5), choice.taken),
        f"contour_{side}": known(contour, choice.taken),
        f"sigma_contour_{side}": known(sigma.hypot(least), choice.taken),
        f"end_{side}": known(pick("end_xy"), has_end),
        f"sigma_end_{side}": known(pick("end_sigma").hypot(least), has_end),
        f"valid_{side}": choice.taken.cpu().numpy(),
    }


def _reverse(contour_xy: Float[Tensor, "*batch 2 2 2"]) -> Float[Tensor, "*batch 2 2 2"]:
    """Seen by somebody who walks the other way: the edges change sides and the points change order."""
    return contour_xy.flip(-3).flip(-2)


def _distance(
    contour_xy: Float[Tensor, "m k 2 2 2"], predicted_n_contour: Float[Tensor, "m 2 3"]
) -> Float[Tensor, "m k"]:
    """Root mean square distance of the four contour points from the predicted lines, normalised units."""
    line = predicted_n_contour / predicted_n_contour[..., :2].norm(dim=-1, keepdim=True)
    distance = point_line_distance(contour_xy.to(line.dtype), line[:, None, :, None, :])
    return distance.square().mean(dim=(-2, -1)).sqrt()
