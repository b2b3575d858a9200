"""What a live session knows after a frame."""

from dataclasses import dataclass
from typing import Literal

import numpy as np
from jaxtyping import Float

from rmis_calib.geometry.rigid import RigidTransform

LiveStatus = Literal["collecting", "weak", "ready"]


@dataclass(frozen=True)
class LiveAnswer:
    """What is known after a frame.

    Attributes:
        status: `collecting` (no estimate yet), `weak`, or `ready`: `result` is expected to be trustworthy.
        message: one line: why.
        frames: frames so far; used: those that show the shaft and agree.
        frame_used: whether the last one did; frame_reason: why not, else empty.
        camera_right_T_arm: the estimate, mm; None while collecting.
        covariance: (6, 6) as in a result, for nominal noise and encoders without offsets.
        advice: the motions that would help most, in words, as far as they are computed (`Session.advice` waits).
    """

    status: LiveStatus
    message: str
    frames: int
    used: int
    frame_used: bool
    frame_reason: str
    camera_right_T_arm: RigidTransform | None = None
    covariance: Float[np.ndarray, "6 6"] | None = None
    advice: tuple[str, ...] = ()
