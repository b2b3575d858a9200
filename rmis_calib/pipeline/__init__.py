"""From a recording to the answer: detect, kinematics, assemble, solve, check; and the measures of an answer."""

from rmis_calib._lazy import lazy_exports

__getattr__, __dir__, __all__ = lazy_exports(
    __name__,
    {
        "CalibrationRun": ".run",
        "Evaluation": ".evaluation",
        "calibrate": ".calibration",
        "detect": ".detection",
        "evaluate": ".evaluation",
        "run_calibration": ".calibration",
        "solve": ".estimation",
    },
)
