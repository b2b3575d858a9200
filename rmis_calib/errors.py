"""Named errors. Every one says where the mistake is, what was expected and what was found.

Three kinds of failure never mix: a caller's mistake raises one of these; a frame without a usable shaft is data with a
reason (`vision.FrameReason`); a solve that did not work is a status (`solver.SolveStatus`), which `calibrate` turns
into `CalibrationFailed` unless it is told not to.
"""

from typing import Any


class RmisCalibError(Exception):
    """Base of every error that this package raises on purpose."""


class _ExpectedFound(RmisCalibError):
    """Message `where: expected ..., found ...`, with the three parts kept as attributes."""

    def __init__(self, message: str = "", *, where: str = "", expected: str = "", found: Any = None) -> None:
        self.where, self.expected, self.found = where, expected, found
        parts = [message] if message else []
        if expected:
            parts.append(f"expected {expected}" + ("" if found is None else f", found {found}"))
        text = "; ".join(parts)
        super().__init__(f"{where}: {text}" if where else text)


class InputError(_ExpectedFound, ValueError):
    """The caller's mistake: a value, shape, unit or file content that cannot be right."""


class DeviceError(InputError):
    """A device that this machine does not have, or that was lost."""


class ShapeError(InputError):
    """A tensor of the wrong shape or dtype."""


class FrameMismatchError(InputError):
    """Two transforms whose frames do not meet."""


class ConfigError(InputError):
    """An unknown key or an impossible value in a configuration."""


class RobotError(InputError):
    """A robot description that is incomplete or impossible."""


class RecordingError(InputError):
    """A recording folder that breaks its format."""


class ObservationsError(InputError):
    """An observations file or object that breaks its format."""


class InsufficientDataError(InputError):
    """Too few usable motions for the unknowns asked for."""


class FileError(_ExpectedFound, OSError):
    """A file that cannot be found, read or written."""


class VideoError(FileError):
    """A video or image folder that cannot be decoded as promised."""


class OutputError(FileError):
    """An output that cannot be written."""


class CalibrationFailed(RmisCalibError):
    """No trustworthy calibration; `result` holds what there is, with its status and reasons."""

    def __init__(self, message: str, result: Any = None) -> None:
        self.result = result
        super().__init__(message)
