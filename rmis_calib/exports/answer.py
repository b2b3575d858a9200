"""What an export writes: both cameras on the arm, whether to trust them, and where the arms stood."""

from dataclasses import dataclass

import numpy as np
from jaxtyping import Float

from rmis_calib import __version__
from rmis_calib.errors import InputError
from rmis_calib.exports.hand_eye import (
    MM_PER_M,
    WRITTEN_BY,
    HandEye,
    covariance_in_metres,
    in_metres,
    turned_covariance,
    with_isi_axes,
)
from rmis_calib.exports.placement import Placement
from rmis_calib.exports.settings import ExportSettings, Side
from rmis_calib.results import CalibrationResult


@dataclass(frozen=True, eq=False)
class Answer:
    """A result, ready to be written."""

    result: CalibrationResult
    settings: ExportSettings
    placement: Placement | None
    """Where the arms stood; None without a recording."""

    @property
    def eye_on_base(self) -> bool:
        """Whether the camera stands still, so that `arm` is the robot's base."""
        if self.placement is not None:
            return self.placement.base_T_arm is None
        return self.settings.eye_on_base

    @property
    def clock_s(self) -> float:
        """Joint time less frame time in the middle of the recording, s, as far as it is known."""
        recorded = 0.0 if self.placement is None else self.placement.clock_offset_s
        return recorded + self._found("clock")

    @property
    def clock_rate(self) -> float:
        """By how much more that is a second later."""
        return self._found("clock_rate")

    def _found(self, name: str) -> float:
        """A nuisance that the data tell; one that its prior holds is no more than rounding."""
        found = self.result.nuisances.get(name)
        return self.result.nuisance(name) if found and not found.held else 0.0

    @property
    def sides(self) -> tuple[Side, ...]:
        """The cameras that there are, the one asked for first."""
        if self.result.camera_left_T_arm is None:
            if self.settings.camera == "left":
                raise InputError(where="camera", expected="right, the only camera of this result", found="left")
            return ("right",)
        return ("left", "right") if self.settings.camera == "left" else ("right", "left")

    def hand_eyes(self) -> tuple[HandEye, ...]:
        """Every camera on the arm, the one asked for first, with the axes asked for."""
        return tuple(self.hand_eye(side) for side in self.sides)

    def hand_eye(self, side: Side) -> HandEye:
        """One camera on the arm. The left one's covariance counts the extrinsics as exact."""
        result, settings = self.result, self.settings
        transform = result.camera_right_T_arm if side == "right" else result.camera_left_T_arm
        assert transform is not None  # `export` refuses results without one, and `sides` a camera that is not there
        covariance = None if result.covariance is None else covariance_in_metres(np.asarray(result.covariance))
        if side == "left" and result.camera_left_T_camera_right is not None:
            covariance = turned_covariance(covariance, result.camera_left_T_camera_right.R.numpy())
        name = settings.camera_right_frame if side == "right" else settings.camera_left_frame
        camera_T_arm = in_metres(transform.matrix.numpy())
        hand_eye = HandEye(name, settings.arm_frame, "opencv", camera_T_arm, covariance)
        return with_isi_axes(hand_eye) if settings.axes == "isi" else hand_eye

    def about(self) -> list[str]:
        """Who wrote it, and whether to trust it, a line each: the head of every file."""
        result = self.result
        lines = [f"{WRITTEN_BY} {__version__} on {result.created}, method {result.method}"]
        if not result.trustworthy:
            lines.append(f"NOT TRUSTWORTHY ({result.status}): {' '.join(result.message.split())}")
        if result.rotation_sigma_deg is not None and result.translation_sigma_mm is not None:
            sigma = f"{result.rotation_sigma_deg:.4g} deg, {result.translation_sigma_mm / MM_PER_M:.4g} m"
            lines.append(f"1 sigma: {sigma} (root of the trace)")
        return lines

    def placed(self) -> Placement:
        """Where the arms stood.

        Raises:
            InputError: no recording was given.
        """
        if self.placement is None:
            expected = "the recording of the result (--recording DIR): this format holds what a result does not"
            raise InputError(where="recording", expected=expected, found="none")
        return self.placement

    def camera_T_instrument_base(self, side: Side) -> Float[np.ndarray, "4 4"]:
        """Base of the instrument's arm in a camera (OpenCV axes) at the frame of the placement, m.

        Raises:
            InputError: no recording was given.
        """
        placed = self.placed()
        transform = self.result.camera_right_T_arm if side == "right" else self.result.camera_left_T_arm
        assert transform is not None
        camera_T_arm = in_metres(transform.matrix.numpy())
        return camera_T_arm @ placed.arm_T_instrument_base()
