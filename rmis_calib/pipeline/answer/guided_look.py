"""A second look at the pictures, along the contours that a first answer predicts."""

from collections.abc import Mapping
from dataclasses import replace

import torch
from jaxtyping import Bool, Float
from torch import Tensor

from rmis_calib.config import CalibrationConfig
from rmis_calib.geometry.cameras import Camera
from rmis_calib.geometry.lines import line_through_points, point_line_distance
from rmis_calib.geometry.rigid import rotate_vectors
from rmis_calib.pipeline.answer.run import CalibrationRun
from rmis_calib.pipeline.motions.association import distance_to
from rmis_calib.pipeline.pictures.detection import Progress, View
from rmis_calib.vision import FrameReason, ShaftDetections, ShaftDetector

# Root mean square distance from the prediction, normalised units (1 mm at 100 mm) and shares of its own width, from
# which a candidate is another thing: half of the shaft, its shadow, an instrument.
_NEAR, _NEAR_WIDTHS = 0.01, 0.15
_SAMPLES, _STEP_MM = 24, 4.0
_SPAN_MM = 30.0
"""Between two points of a contour by which it is carried from one camera to the other."""


def look_along(
    run: CalibrationRun,
    config: CalibrationConfig,
    progress: Progress,
    detectors: Mapping[str, ShaftDetector] | None = None,
) -> tuple[View, ...] | None:
    """The views with what is found where the answer puts the shaft, in pictures that show nothing there so far; None
    where nothing is.

    Nothing is taken away: candidates that lie elsewhere still speak against the answer.

    Args:
        run: with the answer.
        config: its configuration.
        progress: called with (stage, done, total).
        detectors: of each side, where there are some; else they are made.
    """
    views, gained = [], 0
    for view in run.views:
        expected = expected_contours(run, view)
        if expected is None:
            return None
        wanted = _in_view(run, view) & ~_has_near(view.at(run.poses.frames), expected)
        detector = ShaftDetector(config.detector, view.camera) if detectors is None else detectors[view.side]
        detections, found = _with_looks(view, run, expected, wanted, detector, config, progress)
        views.append(replace(view, detections=detections))
        gained += found
    return tuple(views) if gained else None


def expected_contours(run: CalibrationRun, view: View) -> Float[Tensor, "m 2 3"] | None:
    """Contour planes where the answer puts the shaft, in the coordinates of the camera as it was given, in which shafts
    are detected; as they are predicted where the shaft is behind it. None without an answer or a camera.

    The answer goes with a camera that it corrected, by many pixels where the principal point is off: two points of each
    contour are carried over by their pixels.
    """
    predicted, ends, camera_T_arm = run.predicted_contours(view), run.predicted_ends(view), run.camera_T_arm(view)
    corrected = run.camera(view)
    if predicted is None or ends is None or camera_T_arm is None or view.camera is None or corrected is None:
        return None
    if corrected is view.camera:
        return predicted
    found, given = (camera.to(dtype=ends.dtype, device=ends.device) for camera in (corrected, view.camera))
    camera_v_axis = rotate_vectors(camera_T_arm @ run.poses.arm_T_rcm, run.poses.rcm_v_axis)
    axis = torch.stack([ends - _SPAN_MM * camera_v_axis, ends], 1)[:, None]  # (m, 1, point, 3)
    xy = axis[..., :2] / torch.where(axis[..., 2:] > 1.0, axis[..., 2:], torch.nan)
    line = (predicted / predicted[..., :2].norm(dim=-1, keepdim=True))[:, :, None]  # (m, edge, 1, 3)
    on_line = xy - point_line_distance(xy, line)[..., None] * line[..., :2]
    moved, valid = given.undistort_points(found.pixels(on_line))
    moved = torch.where(valid[..., None], moved, torch.nan)
    carried = line_through_points(moved[..., 0, :], moved[..., 1, :])
    return torch.where(torch.isfinite(carried).all(-1, keepdim=True), carried, predicted)


def about_looks(before: tuple[View, ...], after: tuple[View, ...]) -> tuple[str, ...]:
    """A note for each view that gained something."""
    notes = []
    for old, new in zip(before, after, strict=True):
        gained = int((new.detections.valid.sum(-1) > old.detections.valid.sum(-1)).sum())
        if new is not old and gained:
            notes.append(
                f"camera_{new.side}: in {gained} pictures a shaft was found by looking again where the first answer "
                "puts it"
            )
    return tuple(notes)


def _has_near(found: ShaftDetections, expected: Float[Tensor, "m 2 3"]) -> Bool[Tensor, " m"]:
    """Motions with a candidate where the shaft is expected."""
    width = (found.contour_xy[:, :, 0] - found.contour_xy[:, :, 1]).mean(2).norm(dim=-1)
    return (distance_to(found, expected) < (_NEAR_WIDTHS * width).clamp(min=_NEAR)).any(-1)


def _in_view(run: CalibrationRun, view: View) -> Bool[Tensor, " m"]:
    """Motions whose shaft, where the answer puts it, is partly in the picture."""
    ends, camera_T_arm = run.predicted_ends(view), run.camera_T_arm(view)
    assert ends is not None and camera_T_arm is not None and view.camera is not None
    camera_v_axis = rotate_vectors(camera_T_arm @ run.poses.arm_T_rcm, run.poses.rcm_v_axis)
    back = _STEP_MM * torch.arange(_SAMPLES, dtype=ends.dtype, device=ends.device)
    points = ends[:, None] - back[:, None] * camera_v_axis[:, None]
    camera: Camera = view.camera.to(dtype=points.dtype, device=points.device)
    ahead = points[..., 2] > 1.0
    xy = points[..., :2] / points[..., 2:].clamp(min=1.0)
    u, v = camera.pixels(xy).unbind(-1)
    height, width = camera.image_size
    inside = (u > 0) & (v > 0) & (u < width - 1) & (v < height - 1) & camera.can_distort(xy)
    return (ahead & inside).sum(-1) > 1


def _with_looks(
    view: View,
    run: CalibrationRun,
    expected: Float[Tensor, "m 2 3"],
    wanted: Bool[Tensor, " m"],
    detector: ShaftDetector,
    config: CalibrationConfig,
    progress: Progress,
) -> tuple[ShaftDetections, int]:
    """The detections of all frames with those of the wanted motions, and of how many motions there are such."""
    not_to_be_used = view.detections.reason.new_tensor([FrameReason.LEFT_OUT, FrameReason.REPEATED])
    searched = ~torch.isin(view.detections.reason, not_to_be_used)
    frames = run.poses.frames.tolist()
    motions = [m for m in wanted.nonzero()[:, 0].tolist() if searched[frames[m]] and view.source.has(frames[m])]
    if not motions:
        return view.detections, 0
    fields = {name: value.clone() for name, value in vars(view.detections).items()}
    gained = 0
    for first in range(0, len(motions), config.batch_size):
        progress(f"looking again, {view.side}", first, len(motions))
        batch = motions[first : first + config.batch_size]
        numbers = run.poses.frames[batch]
        images = view.source.frames(numbers.tolist()).to(config.device)
        looked = detector.look_along(images, expected[batch])
        has = looked.valid[:, 0]
        rows = torch.as_tensor(numbers, device=has.device)[has]
        for name, value in vars(looked).items():
            if value.ndim > 1:  # in place of the least sure candidate, or of none
                fields[name][rows, -1] = value[has, 0]
        fields["reason"][rows] = int(FrameReason.OK)
        gained += len(rows)
    progress(f"looking again, {view.side}", len(motions), len(motions))
    return ShaftDetections(**fields).surest_first(), gained
