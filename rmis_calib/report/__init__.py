"""The one-page report of a calibration: the answer, how sure it is, and what it rests on."""

from rmis_calib._lazy import lazy_exports

__getattr__, __dir__, __all__ = lazy_exports(
    __name__,
    {
        "DETECTED_RGB": ".overlays",
        "PREDICTED_RGB": ".overlays",
        "DetectionPictures": ".detection_pictures",
        "Overlay": ".overlays",
        "PictureChoice": ".detection_pictures",
        "write_calibration_folder": ".folder",
        "write_lines": ".folder",
        "write_report": ".page",
    },
)
