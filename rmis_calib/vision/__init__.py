"""Finding instrument shafts in pictures: contour lines, axis and end, with uncertainty."""

from rmis_calib._lazy import lazy_exports

__getattr__, __dir__, __all__ = lazy_exports(
    __name__,
    {
        "DetectorSettings": ".settings",
        "FrameReason": ".reasons",
        "ShaftDetections": ".detections",
        "ShaftDetector": ".shaft_lines",
        "draw_detections": ".overlay",
        "draw_dot": ".overlay",
        "draw_polyline": ".overlay",
        "draw_stage_sheet": ".stage_sheet",
        "draw_stages": ".stages",
        "load_segmenter": ".masks",
    },
)
