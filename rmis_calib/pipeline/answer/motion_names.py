"""What motions are called to people: by the joints that set them apart, and by frames, where these are known."""

import math
from dataclasses import dataclass

import numpy as np
from jaxtyping import Bool, Float, Int

from rmis_calib.pipeline.words import ranges_in_words
from rmis_calib.robot import split_joint_column

SET_APART = 0.8
"""Motions meant that a description takes in, of all that are meant or that it takes in."""
CONDITIONS = 2
"""A description by more joints than this says nothing to anybody."""


@dataclass(frozen=True, eq=False)
class MotionNames:
    """Names for the motions of one solve; by default their numbers.

    Attributes:
        frames: (M,) frame number of each motion.
        columns: (J,) names of the joints, as in a joint log.
        readings: (M, J) their readings at each motion, rad or mm.
    """

    frames: Int[np.ndarray, " m"] | None = None
    columns: tuple[str, ...] = ()
    readings: Float[np.ndarray, "m j"] | None = None

    def one(self, motion: int) -> str:
        """`frame 612`, or `motion 12`."""
        return f"motion {motion}" if self.frames is None else f"frame {self.frames[motion]}"

    def some(self, meant: Bool[np.ndarray, " m"], among: Bool[np.ndarray, " m"]) -> str:
        """`12 motions with instrument.insertion beyond 190 mm`, or `12 motions 3 to 9, 14 to 18`.

        Args:
            meant: the motions that get a name.
            among: those from which the name has to tell them; contains all of `meant`.
        """
        count = f"{int(meant.sum())} motions"
        joints = self._by_joints(meant[among], among)
        if joints:
            return f"{count} with {joints}"
        numbers = np.flatnonzero(meant)
        if self.frames is None:
            return f"{count} {ranges_in_words(numbers.tolist())}"
        return f"{count} of frames {ranges_in_words(self.frames[numbers].tolist())}"

    def _by_joints(self, meant: Bool[np.ndarray, " n"], among: Bool[np.ndarray, " m"]) -> str:
        """The joints' ranges that set `meant` apart; empty where none do."""
        if self.readings is None or meant.all() or not meant.any():
            return ""
        readings, inside, words = self.readings[among], np.ones_like(meant), []
        for _ in range(CONDITIONS):
            cut = _best_cut(readings, meant, inside)
            if cut is None:
                return ""
            joint, value, is_above = cut
            inside = inside & ((readings[:, joint] > value) == is_above)
            words.append(self._condition(joint, value, is_above))
            if (inside & meant).sum() >= SET_APART * (inside | meant).sum():
                return " and ".join(words)
        return ""

    def _condition(self, joint: int, value: float, is_above: bool) -> str:
        name, unit = split_joint_column(self.columns[joint])
        number = f"{math.degrees(value):.3g} deg" if unit == "rad" else f"{value:.3g} mm"
        return f"{name} {'beyond' if is_above else 'below'} {number}"


NUMBERED = MotionNames()
"""Motions of which nothing but their numbers is known."""


def _best_cut(
    readings: Float[np.ndarray, "n j"], meant: Bool[np.ndarray, " n"], inside: Bool[np.ndarray, " n"]
) -> tuple[int, float, bool] | None:
    """Joint, value and side that best part the motions meant from the others inside; None where nothing parts them."""
    values, is_meant = readings[inside], meant[inside]
    if is_meant.all() or not is_meant.any():
        return None
    order = np.argsort(values, axis=0)
    values, is_meant = np.take_along_axis(values, order, axis=0), is_meant[order]
    below_meant = is_meant.cumsum(0)[:-1] / is_meant.sum(0)
    below_others = (~is_meant).cumsum(0)[:-1] / (~is_meant).sum(0)
    parted = np.where(
        np.diff(values, axis=0) > 0, below_others - below_meant, 0.0
    )  # of those above, less of those below
    row, joint = np.unravel_index(np.abs(parted).argmax(), parted.shape)
    if parted[row, joint] == 0.0:
        return None
    return int(joint), float(values[row : row + 2, joint].mean()), bool(parted[row, joint] > 0)
