"""How a solve ended, and what became of each motion, with a sentence for every code. Imports no torch."""

from enum import IntEnum


class SolveStatus(IntEnum):
    """How a solve ended. `.sentence` says it in words."""

    CONVERGED = 0
    MAX_ITERATIONS = 1
    STALLED = 2
    NON_FINITE = 3
    SINGULAR = 4
    BEHIND_CAMERA = 5
    INCONSISTENT = 6
    MISFIT = 7
    NO_CAMERA = 8

    @property
    def sentence(self) -> str:
        return _SENTENCES[self]


_SENTENCES = {
    SolveStatus.CONVERGED: "converged",
    SolveStatus.MAX_ITERATIONS: "ran out of steps before the estimate settled",
    SolveStatus.STALLED: "no step improved the fit although it had not settled",
    SolveStatus.NON_FINITE: "a residual became infinite or undefined",
    SolveStatus.SINGULAR: "the measurements leave a direction of the transform entirely undetermined",
    SolveStatus.BEHIND_CAMERA: "the best fit puts the shaft behind the camera or its tip on the wrong side",
    SolveStatus.NO_CAMERA: "the estimate leaves a camera without a positive focal length",
    SolveStatus.MISFIT: "the residuals are larger than the noise levels explain",
    SolveStatus.INCONSISTENT: (
        "a camera has more measurements that contradict the transform than agree with it (are the cameras swapped?)"
    ),
}


class MotionReason(IntEnum):
    """Why a motion was or was not used."""

    USED = 0
    NOT_MEASURED = 1
    OUTLIER = 2
    OUTLIER_ONE_CAMERA = 3
    THINNED = 4

    @property
    def sentence(self) -> str:
        return _REASONS[self]


_REASONS = {
    MotionReason.USED: "used",
    MotionReason.NOT_MEASURED: "no camera measured the shaft",
    MotionReason.OUTLIER: "does not fit the other motions",
    MotionReason.OUTLIER_ONE_CAMERA: "used from one camera; the other camera's measurement does not fit",
    MotionReason.THINNED: "left out: other motions carry nearly all the information",
}
