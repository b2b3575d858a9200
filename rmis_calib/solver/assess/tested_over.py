"""What residuals are tested over: time, the picture, joints, and places, where motions at one place count as one."""

from dataclasses import dataclass, replace

import torch
from jaxtyping import Float, Int
from torch import Tensor

from rmis_calib.solver.assess.groups import LEVER_MM, where_motions_are
from rmis_calib.solver.model.measurement_rows import MeasurementRows
from rmis_calib.solver.model.packing import pack
from rmis_calib.solver.problem import Problem
from rmis_calib.solver.settings import NoiseSettings
from rmis_calib.solver.solution import Solution
from rmis_calib.solver.test_list import MEAN, PICTURE, TIME

STEPS, MOTIONS_A_STEP = 12, 6
"""Borders at which a change in time is looked for, and motions between two of them at least."""
POSE = ("angle 1", "angle 2", "insertion", "rcm x", "rcm y", "rcm z")
"""What is tested over where joints are not known: the instrument's angles and insertion, and the RCM in `arm`, which
moves with the laparoscope."""


NOISE_ALONE = 4.0
"""Scatter of the RCM in `arm`, in the noise of its position, below which it stands still."""


@dataclass(frozen=True)
class Over:
    """What residuals are tested over, of motions in the order of time.

    Attributes:
        motions: of the whole recording, of which these may be a sample.
        number: of each of these motions.
        borders: numbers of the motions before which a change is looked for.
        picture: the middle of the line that each camera measured, normalised image coordinates.
        joints: readings, or where they are not known what the poses say instead (POSE).
        place: of the shaft: `groups.where_motions_are`, and the insertion, mm.
        cluster: number of the place, ascending in time: motions at one place have one number.
    """

    motions: int
    number: Int[Tensor, " n"]
    borders: tuple[int, ...]
    picture: Float[Tensor, "2 c b n"]
    joints: Float[Tensor, "j b n"]
    joint_names: tuple[str, ...]
    place: Float[Tensor, "b n 10"]
    cluster: Int[Tensor, "b n"]

    @property
    def names(self) -> tuple[str, ...]:
        """Of the patterns but the steps in time, which are the last ones."""
        return (MEAN, *PICTURE, *self.joint_names, TIME)

    def take(self, trials: Int[Tensor, " k"]) -> "Over":
        """Of some trials."""
        return replace(
            self,
            picture=self.picture[:, :, trials],
            joints=self.joints[:, trials],
            place=self.place[trials],
            cluster=self.cluster[trials],
        )


def over_of(
    measured: MeasurementRows,
    levels: tuple[Float[Tensor, " b"], Float[Tensor, " b"]],
    joints: Float[Tensor, "b n j"] | None,
    number: Int[Tensor, " n"] | None = None,
    motions: int | None = None,
) -> Over:
    """What residuals are tested over.

    Args:
        measured: motions in the order of time.
        levels: noise of the kinematics, 1 sigma per axis, mm and rad: motions nearer to each other are at one place.
        joints: readings, where they are known.
        number: of each motion among `motions`, where these are a sample.
    """
    motions = measured.motions if motions is None else motions
    number = torch.arange(motions, device=measured.p.device) if number is None else number
    count = max(min(STEPS + 1, motions // MOTIONS_A_STEP), 1)
    ok, (sigma_mm, sigma_rad) = measured.line_ok, levels
    middle = torch.where(ok, measured.line_xy, 0.0).sum(1) / ok.sum(0).clamp_min(1)
    place = torch.cat((where_motions_are(measured), measured.s_end[..., None]), dim=-1)
    # An RCM that stands still in `arm` only shows its noise, which the residuals hold too.
    moves = measured.p.std(-1, keepdim=True) > NOISE_ALONE * sigma_mm[:, None]
    pose = torch.cat((measured.pose, torch.where(moves, measured.p, 0.0)))
    return Over(
        motions=motions,
        number=number,
        borders=tuple((k * motions + count - 1) // count for k in range(1, count)),
        picture=middle,
        joints=pose if joints is None else joints.permute(2, 0, 1),
        joint_names=POSE if joints is None else tuple(f"joint {index}" for index in range(joints.shape[-1])),
        place=place,
        cluster=clusters(place, sigma_mm.square() + (LEVER_MM * sigma_rad).square()),
    )


def over_of_solution(solution: Solution, problem: Problem, settings: NoiseSettings) -> Over:
    """What residuals of a solve are tested over; `solution.tests.joined(residual_tests(...))` adds further ones.

    Args:
        solution: of `joint`.
        problem: what it is of.
        settings: of its noise.
    """
    flat = problem.flatten_batch()
    mm, rad = (solution.noise[name].reshape(-1) for name in ("kinematics_mm", "kinematics_rad"))
    return over_of(pack(flat, settings), (mm, rad), flat.joints)


def clusters(place: Float[Tensor, "b n 10"], variance: Float[Tensor, " b"]) -> Int[Tensor, "b n"]:
    """Number of each motion's place: a new one begins each time the shaft has gone as far as the noise reaches, whose
    variance per axis this is."""
    size = (3.0 * variance).sqrt()[:, None].clamp_min(1e-9)
    step = torch.linalg.vector_norm(place.diff(dim=1), dim=-1) / size
    way = torch.nn.functional.pad(step.cumsum(-1), (1, 0)).floor()
    return torch.nn.functional.pad((way.diff(dim=1) > 0).long(), (1, 0)).cumsum(-1)
