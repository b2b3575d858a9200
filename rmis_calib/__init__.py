"""Markerless hand-eye calibration of a stereo laparoscope from video and joint logs.

    import rmis_calib as rc

    result = rc.calibrate(rc.load_recording("my_recording"))

Everything public loads on first use, so that importing the package costs nothing.
"""

from rmis_calib._lazy import lazy_exports

__version__ = "0.1.0"

__getattr__, __dir__, __all__ = lazy_exports(
    __name__,
    {
        "CalibrationConfig": ".config",
        "CalibrationFailed": ".errors",
        "CalibrationResult": ".results",
        "InputError": ".errors",
        "Recording": ".io",
        "RigidTransform": ".geometry",
        "RmisCalibError": ".errors",
        "ShaftDetector": ".vision",
        "ShaftObservations": ".io",
        "calibrate": ".pipeline",
        "detect": ".pipeline",
        "evaluate": ".pipeline",
        "load_config": ".config",
        "load_recording": ".io",
        "run_calibration": ".pipeline",
        "solve": ".pipeline",
    },
)
