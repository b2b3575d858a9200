"""A second look at pictures in which a first answer expects a shaft and none was taken."""

from dataclasses import replace

import torch
from jaxtyping import Bool, Float
from torch import Tensor

from rmis_calib.config import CalibrationConfig
from rmis_calib.pipeline.association import Choice, association_gate, consistent_choice
from rmis_calib.pipeline.background import without_background
from rmis_calib.pipeline.detection import Progress, View, concatenate
from rmis_calib.pipeline.run import CalibrationRun
from rmis_calib.vision import ShaftDetections, ShaftDetector
from rmis_calib.vision.detections import merge

_SURE = 0.8
"""Shafts that are as sure as this stay as they are."""
_FROM_CENTRE = 0.2
"""Half the distance of the two points by which an expected line is given, normalised units."""


def contour_points(n_contour: Float[Tensor, "m 2 3"]) -> Float[Tensor, "m 2 2 2"]:
    """Two points [edge, point, xy] of the lines in which contour planes cut the picture, those of both edges abreast.

    Convention: they lie about the place that is nearest to the picture's centre.
    """
    axis = torch.nn.functional.normalize(n_contour, dim=-1)
    axis = torch.nn.functional.normalize(axis[:, 0] * _sign(axis) + axis[:, 1], dim=-1)
    size = axis[:, :2].square().sum(-1, keepdim=True).clamp(min=1e-12)
    foot = -axis[:, 2:] * axis[:, :2] / size
    along = torch.stack([-axis[:, 1], axis[:, 0]], -1) / size.sqrt()
    left = torch.stack([along[:, 1], -along[:, 0]], -1)
    points = torch.stack([foot - _FROM_CENTRE * along, foot + _FROM_CENTRE * along], 1)  # (m, point, xy)
    # Each line, met when walking sideways from the axis: n . (p + s left, 1) = 0.
    value = torch.einsum("mex,mpx->mep", n_contour[..., :2], points) + n_contour[..., 2:]
    slope = torch.einsum("mex,mx->me", n_contour[..., :2], left)
    sideways = -value / torch.where(slope.abs() < 1e-9, 1e-9, slope)[..., None]
    return points[:, None] + sideways[..., None] * left[:, None, None]


def _sign(axis: Float[Tensor, "m 2 3"]) -> Float[Tensor, "m 1"]:
    """1 where both normals point the same way, -1 where they are opposed."""
    return torch.where((axis[:, 0] * axis[:, 1]).sum(-1, keepdim=True) < 0, -1.0, 1.0).to(axis.dtype)


def look_again(
    run: CalibrationRun, config: CalibrationConfig, progress: Progress
) -> tuple[tuple[View, ...], tuple[Choice, ...]] | None:
    """Views with what a second look found, and the candidates near to what the answer expects; None where nothing is
    to be looked at, or no answer tells where.

    Pictures are searched again in which no shaft was taken, or one that is not sure. What lies elsewhere than where the
    shaft is expected is passed over in them.
    """
    if run.result.status not in ("ok", "weak"):
        return None
    used = torch.as_tensor(run.result.motions.used[run.poses.frames], device=run.poses.arm_T_rcm.device)
    views, choices, searched = [], [], 0
    for view, choice in zip(run.views, run.choices, strict=True):
        prediction = run.predicted_contours(view)
        if prediction is None:
            return None
        found = view.at(run.poses.frames)
        gate = association_gate(choice, found, prediction, used)
        doubtful = _doubtful(found, choice)
        searched += int(doubtful.sum())
        if bool(doubtful.any()):
            progress(f"looking again, {view.side}", 0, int(doubtful.sum()))
            view = _searched_near(view, run, doubtful, contour_points(prediction), config, progress)
        again = consistent_choice(view.at(run.poses.frames), prediction, gate)
        views.append(view)
        choices.append(
            Choice(torch.where(doubtful, again.candidate, choice.candidate), _turned(again, choice, doubtful))
        )
    return (tuple(views), tuple(choices)) if searched else None


def _turned(again: Choice, choice: Choice, doubtful: Bool[Tensor, " m"]) -> Bool[Tensor, " m"]:
    return torch.where(doubtful, again.reversed, choice.reversed)


def _doubtful(found: ShaftDetections, choice: Choice) -> Bool[Tensor, " m"]:
    """Motions whose picture shows no shaft that was taken, or one that is not sure."""
    own = found.confidence.gather(1, choice.candidate.clamp(min=0)[:, None])[:, 0]
    return ~choice.taken | ~(own >= _SURE)


def _searched_near(
    view: View,
    run: CalibrationRun,
    doubtful: Bool[Tensor, " m"],
    expected: Float[Tensor, "m 2 2 2"],
    config: CalibrationConfig,
    progress: Progress,
) -> View:
    """The view with what is found in the doubtful motions' pictures near to where it is expected."""
    detector = ShaftDetector(config.detector, view.camera)
    frames = run.poses.frames[doubtful.cpu().numpy()]
    expected, parts = expected[doubtful], []
    for first in range(0, len(frames), config.batch_size):
        some = slice(first, first + config.batch_size)
        images = view.source.frames(frames[some].tolist()).to(config.device)
        parts.append(detector.detect_near(images, expected[some]))
        progress(f"looking again, {view.side}", min(first + config.batch_size, len(frames)), len(frames))
    at = torch.as_tensor(frames, device=view.detections.valid.device)
    better = merge(view.detections.of_frames(at), concatenate(parts), config.detector.second_look_below)
    joined = {name: value.clone() for name, value in vars(view.detections).items()}
    for name, value in vars(better).items():
        joined[name][at] = value
    detections, _ = without_background(ShaftDetections(**joined), run.poses)
    return replace(view, detections=detections)
