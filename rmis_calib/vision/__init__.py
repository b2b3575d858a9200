"""Finding instrument shafts in pictures: contour lines, axis and end, with uncertainty."""

from rmis_calib._lazy import lazy_exports

__getattr__, __dir__, __all__ = lazy_exports(
    __name__,
    {
        "DetectorSettings": ".settings",
        "FrameReason": ".detections",
        "ShaftDetections": ".detections",
        "ShaftDetector": ".detector",
        "draw_detections": ".draw.overlay",
        "draw_dot": ".draw.overlay",
        "draw_polyline": ".draw.overlay",
        "draw_stage_sheet": ".draw.stage_sheet",
        "draw_stages": ".draw.stages",
        "load_segmenter": ".masks",
    },
)
