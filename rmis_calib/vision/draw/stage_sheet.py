"""All stages of one frame on one sheet, with what each shows, so that a user can see why the frame failed."""

import cv2
import numpy as np

from rmis_calib.vision.coarse.search import SearchTrace
from rmis_calib.vision.detections import FrameReason, ShaftDetections
from rmis_calib.vision.draw.overlay import draw_detections
from rmis_calib.vision.draw.stages import draw_stages

_PANEL_WIDTH, _COLUMNS, _GAP, _TITLE, _HEADER = 480, 5, 12, 50, 58
_PAPER, _INK, _FAINT, _MARK = (22, 24, 29), (240, 240, 240), (160, 165, 175), (255, 176, 0)

_TITLES = {
    "1_small": ("1 small picture", "shrunken, lens distortion taken out"),
    "2_field_of_view": ("2 field of view", "purple is outside and not looked at"),
    "3_unlike_a_shaft": ("3 unlike a dark shaft", "dark: dark and untinted, or in a mask of yours"),
    "3_unlike_a_shaft_lit": ("3 unlike a lit shaft", "dark: untinted at any brightness, and no cavity"),
    "4_ridges": ("4 edges", "red: pixels that may vote for a line"),
    "5_votes": ("5 votes", "angle down, distance across; bright: a line"),
    "6_lines": ("6 lines", "the most voted; a tick points outwards"),
    "7_strips": ("7 strips", "best pairs of lines; dots where it looks like a shaft"),
    "8_result": ("8 measured at full resolution", "contours, axis, end and confidence of what was accepted"),
}

_FAILED_AT = {
    FrameReason.BAD_PIXELS: "1_small",
    FrameReason.NO_PICTURE: "3_unlike_a_shaft",
    FrameReason.NO_STRAIGHT_EDGES: "6_lines",
    FrameReason.NOT_A_CYLINDER: "7_strips",
    FrameReason.TOO_SHORT: "7_strips",
    FrameReason.EDGES_UNCLEAR: "8_result",
    FrameReason.AMBIGUOUS: "8_result",
}


def draw_stage_sheet(
    image: np.ndarray, found: ShaftDetections, stages: SearchTrace, frame: int = 0, title: str = ""
) -> np.ndarray:
    """The stages of one frame side by side, the one at which it failed framed in amber.

    Args:
        image: (h, w, 3) uint8 RGB.
        found: detections of a batch.
        stages: of the same batch, from `ShaftDetector.explain`.
        frame: which frame of the batch the picture is.
        title: what the frame is called.

    Returns:
        (height, width, 3) uint8 RGB.
    """
    panels = draw_stages(stages, frame) | {"8_result": draw_detections(image, found, frame)}
    reason = FrameReason(int(found.reason[frame]))
    tall = max(round(_PANEL_WIDTH * p.shape[0] / p.shape[1]) for name, p in panels.items() if name != "5_votes")
    rows = -(-len(panels) // _COLUMNS)
    width = _GAP + _COLUMNS * (_PANEL_WIDTH + _GAP)
    sheet = np.full((_HEADER + rows * (tall + _TITLE + _GAP), width, 3), _PAPER, np.uint8)
    _write(sheet, title, (_GAP, 24), 0.62, _INK)
    verdict = reason.sentence if reason is FrameReason.OK else f"no shaft: {reason.sentence}"
    _write(sheet, verdict, (_GAP, 47), 0.55, _FAINT if reason is FrameReason.OK else _MARK)
    for place, (name, panel) in enumerate(panels.items()):
        top = _HEADER + place // _COLUMNS * (tall + _TITLE + _GAP)
        left = _GAP + place % _COLUMNS * (_PANEL_WIDTH + _GAP)
        shown = _fitted(panel, tall, is_map=name == "5_votes")
        picture_top = top + _TITLE
        sheet[picture_top : picture_top + shown.shape[0], left : left + _PANEL_WIDTH] = shown
        failed = _FAILED_AT.get(reason) == name
        heading, says = _TITLES[name]
        _write(
            sheet, heading + (": here it failed" if failed else ""), (left, top + 20), 0.55, _MARK if failed else _INK
        )
        _write(sheet, says, (left, top + 40), 0.45, _FAINT)
        if failed:
            corner = (left + _PANEL_WIDTH, picture_top + shown.shape[0])
            cv2.rectangle(sheet, (left - 2, picture_top - 2), corner, _MARK, 3)
    return sheet


def _fitted(panel: np.ndarray, tall: int, is_map: bool) -> np.ndarray:
    """A panel of the sheet's width; a map without a shape of its own fills the height too."""
    height = tall if is_map else round(_PANEL_WIDTH * panel.shape[0] / panel.shape[1])
    shrinks = panel.shape[1] > _PANEL_WIDTH
    return cv2.resize(panel, (_PANEL_WIDTH, height), interpolation=cv2.INTER_AREA if shrinks else cv2.INTER_LINEAR)


def _write(sheet: np.ndarray, text: str, place: tuple[int, int], size: float, colour: tuple[int, int, int]) -> None:
    cv2.putText(sheet, text, place, cv2.FONT_HERSHEY_SIMPLEX, size, colour, 1, cv2.LINE_AA)
