"""Estimation of `camera_right_T_arm` from lines, contours, ends and head points of the instrument's shaft."""

from rmis_calib._lazy import lazy_exports

__getattr__, __dir__, __all__ = lazy_exports(
    __name__,
    {
        "LineStatistics": ".start.line_statistics",
        "NoiseLevels": ".problem",
        "Problem": ".problem",
        "MotionReason": ".status",
        "Solution": ".solution",
        "SolverSettings": ".settings",
        "SolveStatus": ".status",
        "Verdict": ".observability",
        "solve": ".api",
    },
)
