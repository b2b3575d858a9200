"""Pictures that repeat the one before although the joints moved: a grabber that hangs, or frames written twice."""

from dataclasses import replace

import numpy as np
import torch
from jaxtyping import Bool, Float, UInt8
from torch import Tensor

from rmis_calib.pipeline.arms.poses import MotionPoses
from rmis_calib.pipeline.words import ranges_in_words
from rmis_calib.vision import FrameReason, ShaftDetections

_STRIDE = 4
"""Every fourth pixel across and down: a shaft that moves by a pixel changes its edges in hundreds of them."""
_SAME_LEVELS = 3
"""Largest change, of 255, in a picture that was copied and coded again; noise alone changes more."""
_MOVED_RAD, _MOVED_MM = 0.005, 1.0
"""Motion of the shaft (0.3 deg, or of the RCM, or along itself) that no picture can fail to show."""


class ChangeMeter:
    """Largest change of a pixel from one picture to the next, over batches of one camera's pictures."""

    def __init__(self) -> None:
        self._last: Tensor | None = None

    def __call__(self, images: UInt8[Tensor, "b 3 h w"]) -> Float[Tensor, " b"]:
        """Levels of 255; infinite for the first picture of all."""
        small = images[:, :, ::_STRIDE, ::_STRIDE].to(torch.int16)
        before = torch.cat((small[:1] if self._last is None else self._last, small[:-1]))
        change = (small - before).abs().flatten(1).amax(1).to(torch.float32)
        if self._last is None:
            change[0] = torch.inf
        self._last = small[-1:].clone()
        return change


def repeated_motions(change: Float[Tensor, " n"], poses: MotionPoses) -> Bool[np.ndarray, " m"]:
    """Which motions have a picture that repeats the one before, while the joints moved the shaft.

    Args:
        change: of every frame, from `ChangeMeter`; infinite where a frame was not looked at.
        poses: kinematics of the motions.
    """
    same = (change <= _SAME_LEVELS).cpu().numpy()[poses.frames]
    # The picture shows the instant at which the run of equal ones began.
    number = np.arange(len(same))
    shown = torch.as_tensor(np.maximum.accumulate(np.where(same, 0, number)))
    T, v, s = (value.cpu() for value in (poses.arm_T_rcm, poses.rcm_v_axis, poses.rcm_s_end_mm))
    d = (T[:, :3, :3] @ v[..., None])[..., 0]
    turned = torch.linalg.vector_norm(d - d[shown], dim=-1) > _MOVED_RAD
    shifted = torch.linalg.vector_norm(T[:, :3, 3] - T[shown, :3, 3], dim=-1) > _MOVED_MM
    slid = (s - s[shown]).abs() > _MOVED_MM
    return same & (turned | shifted | slid).numpy()


def without_frames(detections: ShaftDetections, frames: np.ndarray) -> ShaftDetections:
    """The detections with nothing found in these frames, as they repeat others."""
    index = torch.as_tensor(frames, device=detections.valid.device)
    valid, reason = detections.valid.clone(), detections.reason.clone()
    valid[index], reason[index] = False, int(FrameReason.REPEATED)
    return replace(detections, valid=valid, reason=reason)


def about_repeats(side: str, frames: np.ndarray) -> str:
    """A sentence that names the frames in ranges."""
    named = ranges_in_words(frames.tolist())
    return (
        f"camera_{side}: {len(frames)} pictures repeat the one before although the joints moved (frames {named}); "
        "they were left out: did the frame grabber stall, or were frames written twice?"
    )
