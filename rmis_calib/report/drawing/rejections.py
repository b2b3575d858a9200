"""For each reason of rejection a few of its pictures, with what was wrongly taken for the shaft, or nearly."""

from dataclasses import dataclass

import numpy as np
import torch
from jaxtyping import UInt8
from torch import Tensor

from rmis_calib.config import CalibrationConfig, parse_config
from rmis_calib.pipeline.answer.predicted_shaft import predict_shaft
from rmis_calib.pipeline.answer.run import CalibrationRun
from rmis_calib.pipeline.pictures.detection import View
from rmis_calib.report.drawing.frames import detected_marks, overlay_of, predicted_marks
from rmis_calib.report.drawing.marks import Mark
from rmis_calib.report.drawing.overlays import Overlay
from rmis_calib.vision import ShaftDetector, strip_edges


@dataclass(frozen=True)
class RejectionSheet:
    """Pictures of motions that were rejected for one reason.

    Attributes:
        reason: in words.
        count: motions that were rejected for it.
        overlays: some of them.
    """

    reason: str
    count: int
    overlays: tuple[Overlay, ...]


def rejection_sheets(run: CalibrationRun, rejected: dict[str, tuple[int, ...]]) -> tuple[RejectionSheet, ...]:
    """A sheet for each reason.

    Args:
        run: the calibration.
        rejected: motions to show, by reason (`choose_motions`).
    """
    counts = run.result.motions.rejected_by_reason
    return tuple(
        RejectionSheet(reason, counts[reason], tuple(_pictures(run, run.views[0], np.array(motions))))
        for reason, motions in rejected.items()
    )


def _pictures(run: CalibrationRun, view: View, motions: np.ndarray) -> list[Overlay]:
    """Each motion in one view: candidates, the prediction, and what the search looked at where nothing was found."""
    config = parse_config(dict(run.result.config))
    predicted = predict_shaft(run, view, motions)
    shown = []
    for index, (motion, image) in enumerate(
        zip(motions.tolist(), view.source.frames(run.poses.frames[motions].tolist()), strict=True)
    ):
        marks = detected_marks(run, view, motion)
        caption = "what was found does not fit, or was not taken"
        if not any(mark.style in ("refused", "detected") for mark in marks):
            looked_at = _search_marks(view, config, image)
            marks += looked_at
            caption = "no shaft was accepted" + ("" if looked_at else ", and no strip looked like one")
        marks += predicted_marks(run, view, predicted, index, None)
        shown.append(overlay_of(run, view, motion, image, marks, caption))
    return shown


def _search_marks(view: View, config: CalibrationConfig, image: UInt8[Tensor, "3 h w"]) -> list[Mark]:
    """The strips that came nearest to being a shaft; none where masks of the user's took the place of the search."""
    if config.masks is not None or min(image.shape[1:]) < 64:
        return []
    camera = None if view.camera is None else view.camera.to(dtype=torch.float64, device="cpu")
    detector = ShaftDetector(config.detector, camera)
    _, stages = detector.explain(image[None].cpu())
    return [
        Mark("search", edge[:: max(1, len(edge) // 24)])
        for edges in strip_edges(stages, detector.lens)
        for edge in edges
    ]
