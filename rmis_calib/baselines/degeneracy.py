"""Whether the motion determines the mounting at all, whatever the method; checked before and after solving."""

import math
from dataclasses import dataclass

import torch
from jaxtyping import Float, Int
from torch import Tensor

from rmis_calib.baselines.motions import Motions, Samples, rotation_vectors
from rmis_calib.baselines.noise import Residuals
from rmis_calib.baselines.status import HandEyeStatus
from rmis_calib.geometry import project_to_so3

NO_ROTATION_RAD = math.radians(0.01)
"""Relative rotations below this are none: the rounding of poses that files give with five digits."""
LEAST_ROTATION_RAD = math.radians(1.0)
"""Relative rotations (root mean square) below this are too small to trust."""
LEAST_OFF_AXIS_RAD = math.radians(0.5)
"""The same for rotations away from the main axis."""
NO_TRAVEL = 1e-4
"""Relative translations below this fraction of the poses' own are none."""
OFF_AXIS_NOISE = 2.0
"""Rotations away from the main axis must exceed this times the rotations' misfit over N^(1/4). Noise on N poses about
one
axis reaches about half of that (tests/baselines/test_degeneracy.py)."""
LARGEST_MISFIT, LARGEST_SHIFT_MISFIT = 0.3, 0.1
"""Largest fraction of the mean square rotation (position) that one rigid mounting may leave unexplained. Noise of a
third
of the motion leaves about a tenth; wrong pairs or directions leave half or more."""

POOR_FIT, POOR_ROTATION = 4.0, 0.01
"""A solution's mean square misfit of rotations may be this times that of the best one, and this part of the motion."""


@dataclass(frozen=True, eq=False)
class MotionAssessment:
    """What the motions alone say, of every trial.

    Attributes:
        status: a `HandEyeStatus`.
        rotation: mean square relative rotation, rad^2.
        misfit: mean square difference of robot's and camera's relative rotations at the best mounting, rad^2.
    """

    status: Int[Tensor, "*batch"]
    rotation: Float[Tensor, "*batch"]
    misfit: Float[Tensor, "*batch"]

    def __getitem__(self, rows: Tensor) -> "MotionAssessment":
        return MotionAssessment(self.status[rows], self.rotation[rows], self.misfit[rows])


def assess_motion(samples: Samples, motions: Motions) -> MotionAssessment:
    """Whether the motion can answer, before solving."""
    alpha, beta = rotation_vectors(motions.qa), rotation_vectors(motions.qb)
    profile = alpha.mT @ beta / alpha.shape[-2]
    R = project_to_so3(profile)
    agreeing = profile @ R.mT
    # Independent noise of robot and camera cancels in their product, so its eigenvalues are of real motion.
    values, axes = torch.linalg.eigh(0.5 * (agreeing + agreeing.mT))
    robot, camera = alpha.square().sum(-1).mean(-1), beta.square().sum(-1).mean(-1)
    misfit = (alpha - beta @ R.mT).square().sum(-1).mean(-1)
    rotation = torch.minimum(robot, camera).sqrt()
    off_axis = (values[..., 0] + values[..., 1]).clamp_min(0).sqrt()
    noise = OFF_AXIS_NOISE * misfit.sqrt() / len(samples) ** 0.25
    travel, along = _travel(samples, motions, axes[..., 2])
    status = torch.full(rotation.shape, int(HandEyeStatus.OK), device=rotation.device)
    # Later lines overrule earlier ones.
    one_axis = off_axis < noise.clamp_min(LEAST_OFF_AXIS_RAD)
    for condition, code in (
        (one_axis, HandEyeStatus.SINGLE_AXIS),
        (one_axis & (along < 0.02 * travel), HandEyeStatus.PLANAR),
        (misfit > LARGEST_MISFIT * (robot + camera), HandEyeStatus.ROTATIONS_DISAGREE),
        (rotation < LEAST_ROTATION_RAD, HandEyeStatus.TINY),
        (rotation < NO_ROTATION_RAD, HandEyeStatus.PURE_TRANSLATION),
        ((rotation < NO_ROTATION_RAD) & (travel < NO_TRAVEL), HandEyeStatus.IDENTICAL),
    ):
        status = torch.where(condition, int(code), status)
    return MotionAssessment(status, rotation**2, misfit)


def _travel(samples: Samples, motions: Motions, axis: Float[Tensor, "*batch 3"]) -> tuple[Tensor, Tensor]:
    """Robot's relative translations, root mean square: all, and along an axis; over the size of its poses."""
    size = samples.anchor_T_mount[..., :3, 3].square().sum(-1).mean(-1)
    size = (size + samples.camera_T_board[..., :3, 3].square().sum(-1).mean(-1)).clamp_min(1e-300)
    square = motions.ta.square().sum(-1).mean(-1)
    along = (motions.ta * axis[..., None, :]).sum(-1).square().mean(-1)
    return (square / size).sqrt(), (along / size).sqrt()


def assess_solution(samples: Samples, motion: MotionAssessment, found: Residuals) -> Int[Tensor, "*batch"]:
    """A `HandEyeStatus` for every trial, from what its solution leaves unexplained."""
    robot, camera = (
        (t - t.mean(-2, keepdim=True)).square().sum(-1).mean(-1)
        for t in (samples.anchor_T_mount[..., :3, 3], samples.camera_T_board[..., :3, 3])
    )
    shift = found.shift.square().sum(-1).mean(-1)
    # What the rotations' own misfit makes of the lever is no disagreement of translations.
    swing = 0.5 * motion.misfit * found.lever.square().sum(-1).mean(-1)
    disagree, ok = int(HandEyeStatus.TRANSLATIONS_DISAGREE), int(HandEyeStatus.OK)
    # The second test is for a robot in metres: it hardly moves, beside a camera that turns far from the board.
    largest = torch.minimum(LARGEST_SHIFT_MISFIT * (robot + camera), robot + 0.01 * camera)
    status = torch.where(shift > largest + 2 * swing, disagree, ok)
    # A relative rotation has the errors of two samples.
    turn = found.turn.square().sum(-1).mean(-1)
    poor = 2 * turn > POOR_FIT * motion.misfit + POOR_ROTATION * motion.rotation
    status = torch.where(poor, int(HandEyeStatus.POOR_FIT), status)
    return torch.where(torch.isfinite(shift), status, int(HandEyeStatus.NON_FINITE))
