"""How a hand-eye calibration with a board ended, with a sentence for every code. Imports no torch."""

from enum import IntEnum


class HandEyeStatus(IntEnum):
    """How one trial ended. `.sentence` says it in words."""

    OK = 0
    IDENTICAL = 1
    PURE_TRANSLATION = 2
    TINY = 3
    SINGLE_AXIS = 4
    PLANAR = 5
    ROTATIONS_DISAGREE = 6
    TRANSLATIONS_DISAGREE = 7
    POOR_FIT = 8
    NOT_CONVERGED = 9
    NON_FINITE = 10

    @property
    def sentence(self) -> str:
        return _SENTENCES[self]

    @property
    def is_degenerate(self) -> bool:
        """Whether the motion itself cannot answer the question, whatever the method."""
        return HandEyeStatus.IDENTICAL <= self <= HandEyeStatus.PLANAR


_SENTENCES = {
    HandEyeStatus.OK: "solved",
    HandEyeStatus.IDENTICAL: "degenerate: all poses are the same; move and rotate the robot between samples",
    HandEyeStatus.PURE_TRANSLATION: (
        "degenerate: the robot moves without rotating, so the camera's position cannot be found; rotate about two axes"
    ),
    HandEyeStatus.TINY: "degenerate: the rotations are too small to trust; rotate the robot further, about two axes",
    HandEyeStatus.SINGLE_AXIS: (
        "degenerate: all rotations share one axis, so the position along it cannot be found; rotate about a second axis"
    ),
    HandEyeStatus.PLANAR: (
        "degenerate: the motion is planar (one rotation axis, no travel along it), so the position along the axis"
        " cannot be found; rotate about a second axis"
    ),
    HandEyeStatus.ROTATIONS_DISAGREE: (
        "the robot's and the board's rotations do not belong to one rigid mounting; check pairing, the direction of the"
        " transforms, and eye-in-hand against eye-to-hand"
    ),
    HandEyeStatus.TRANSLATIONS_DISAGREE: (
        "the rotations fit but the translations do not; check the units and the direction of the transforms"
    ),
    HandEyeStatus.POOR_FIT: (
        "this method's solution fits far worse than the motions allow (with rcm: check the remote centre's coordinates)"
    ),
    HandEyeStatus.NOT_CONVERGED: "the iteration did not settle",
    HandEyeStatus.NON_FINITE: "the equations have no finite solution",
}
