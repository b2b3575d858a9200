"""Everything that a report draws, gathered from a calibration."""

from dataclasses import dataclass

import numpy as np

from rmis_calib.pipeline.answer.run import CalibrationRun
from rmis_calib.report.charts.picture_edges import EdgeMap, edge_maps
from rmis_calib.report.charts.residuals import ResidualFigure, residual_figures
from rmis_calib.report.charts.signed import residual_evidence
from rmis_calib.report.drawing.choosing import ShownMotions, choose_motions
from rmis_calib.report.drawing.frames import overlays
from rmis_calib.report.drawing.overlays import Overlay
from rmis_calib.report.drawing.rejections import RejectionSheet, rejection_sheets
from rmis_calib.report.drawing.scene import SceneDrawing, draw_scene
from rmis_calib.report.drawing.working_point import WorkingPointPicture, working_point_picture

WORST, TYPICAL, REJECTED = 4, 4, 3
"""Motions of each kind in the page (rejected: for each reason), few enough for a page of some 2 MB."""


@dataclass(frozen=True)
class ReportMaterial:
    """What goes into a page beside the result; a page without it says what the result says.

    Attributes:
        worst: pictures of the used motions with the largest residuals.
        typical: pictures of usual ones; of usable ones where nothing was solved.
        sheets: rejected motions by reason.
        working_point: the answer's sigma on a frame.
        residuals: drawn with their sign.
        edge_maps: edges of the pictures off the predicted contours.
        scene: both arms, cameras and the instrument in three dimensions.
    """

    worst: tuple[Overlay, ...] = ()
    typical: tuple[Overlay, ...] = ()
    sheets: tuple[RejectionSheet, ...] = ()
    working_point: WorkingPointPicture | None = None
    residuals: tuple[ResidualFigure, ...] = ()
    edge_maps: tuple[EdgeMap, ...] = ()
    scene: SceneDrawing | None = None

    @property
    def pictures(self) -> tuple[Overlay, ...]:
        """Every picture of the page, the most usual first."""
        return (*self.typical, *self.worst, *(overlay for sheet in self.sheets for overlay in sheet.overlays))


def gather_material(run: CalibrationRun) -> ReportMaterial:
    """What a calibration's report draws; reads the frames that it shows."""
    chosen = choose_motions(run, WORST, TYPICAL, REJECTED)
    worst, typical = shown_pictures(run, chosen)
    return ReportMaterial(
        worst=worst,
        typical=typical,
        sheets=rejection_sheets(run, chosen.rejected),
        working_point=working_point_picture(run),
        residuals=residual_figures(residual_evidence(run)),
        edge_maps=edge_maps(run),
        scene=draw_scene(run),
    )


def shown_pictures(run: CalibrationRun, chosen: ShownMotions) -> tuple[tuple[Overlay, ...], tuple[Overlay, ...]]:
    """Pictures of the worst motions, each in the camera where it is worst, and of typical ones, cameras in turn."""
    sides = [view.side for view in run.views]
    wanted = {motion: _worst_side(run, motion, sides) for motion in chosen.worst}
    wanted |= {motion: sides[place % len(sides)] for place, motion in enumerate(chosen.typical)}
    drawn: dict[int, Overlay] = {}
    for side in sides:
        motions = np.array(sorted(motion for motion, camera in wanted.items() if camera == side), dtype=int)
        drawn |= dict(zip(motions.tolist(), overlays(run, motions, side), strict=True))
    return tuple(drawn[motion] for motion in chosen.worst), tuple(drawn[motion] for motion in chosen.typical)


def _worst_side(run: CalibrationRun, motion: int, sides: list[str]) -> str:
    frame = int(run.poses.frames[motion])
    return max(sides, key=lambda side: run.result.residual(f"contour_{side}", frame) or 0.0)
