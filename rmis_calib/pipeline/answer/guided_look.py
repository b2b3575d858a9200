"""A second look at the pictures, along the contours that a first answer predicts."""

from dataclasses import replace

import torch
from jaxtyping import Bool, Float
from torch import Tensor

from rmis_calib.config import CalibrationConfig
from rmis_calib.geometry.cameras import Camera
from rmis_calib.geometry.rigid import rotate_vectors
from rmis_calib.pipeline.answer.run import CalibrationRun
from rmis_calib.pipeline.motions.association import distance_to
from rmis_calib.pipeline.pictures.detection import Progress, View
from rmis_calib.vision import FrameReason, ShaftDetections, ShaftDetector

# Root mean square distance from the prediction, normalised units (1 mm at 100 mm), from which a candidate is another
# thing: half of the shaft, its shadow, an instrument.
_NEAR = 0.01
_SAMPLES, _STEP_MM = 24, 4.0


def look_along(run: CalibrationRun, config: CalibrationConfig, progress: Progress) -> tuple[View, ...] | None:
    """The views with what is found where the answer puts the shaft, in pictures that show nothing there so far; None
    where nothing is.

    Nothing is taken away: candidates that lie elsewhere still speak against the answer.
    """
    views, gained = [], 0
    for view in run.views:
        expected = run.predicted_contours(view)
        if expected is None or view.camera is None:
            return None
        wanted = _in_view(run, view) & ~_has_near(view.at(run.poses.frames), expected)
        detections, found = _with_looks(view, run, expected, wanted, config, progress)
        views.append(replace(view, detections=detections))
        gained += found
    return tuple(views) if gained else None


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
    return (distance_to(found, expected) < _NEAR).any(-1)


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
    config: CalibrationConfig,
    progress: Progress,
) -> tuple[ShaftDetections, int]:
    """The detections of all frames with those of the wanted motions, and of how many motions there are such."""
    detector = ShaftDetector(config.detector, None if view.camera is None else run.camera(view))
    searched = view.detections.reason != FrameReason.LEFT_OUT
    motions = [m for m in wanted.nonzero()[:, 0].tolist() if searched[run.poses.frames[m]]]
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
