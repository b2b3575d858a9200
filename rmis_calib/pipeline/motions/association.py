"""Which candidate of each picture is the instrument's shaft: at first as a prior has it, as the user points or each
instrument in turn, then by where a first calibration puts it.
"""

from dataclasses import dataclass
from pathlib import Path

import numpy as np
import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor

from rmis_calib.config import CalibrationConfig
from rmis_calib.errors import InputError
from rmis_calib.geometry import RigidTransform
from rmis_calib.geometry.lines import point_line_distance
from rmis_calib.io import Recording
from rmis_calib.io.reference import read_reference
from rmis_calib.pipeline.arms.poses import MotionPoses, predict_contours
from rmis_calib.pipeline.pictures.detection import View
from rmis_calib.vision import ShaftDetections

# Share of the motions that must show several shafts at once before instruments are told apart: single false candidates
# are left to the solver's outlier test.
_SEVERAL = 0.1
_ROUNDS = 12


# Half the width of a shaft of 8 mm at 150 mm: no error of a few degrees is ruled out for motions not yet used.
_LEAST_REACH = 0.027
_PRIOR_REACH = 0.05
"""How far off a shaft may be from where a prior puts it, normalised units, where pictures show several: 3 deg, or 5 mm
at 100 mm. Farther off lie other instruments, and halves and shadows of shafts."""


@dataclass(frozen=True, eq=False)
class Choice:
    """Which candidate of each motion's frame is taken for the instrument's shaft.

    Attributes:
        candidate: (M,) index; -1 for none.
        reversed: (M,) whether RCM side and tip side (and so the two edges) are exchanged.
    """

    candidate: Int[Tensor, " m"]
    reversed: Bool[Tensor, " m"]

    @property
    def taken(self) -> Bool[Tensor, " m"]:
        return self.candidate >= 0

    def where(self, known: Bool[Tensor, " m"]) -> "Choice":
        """This choice in the motions that are known, none in the others."""
        return Choice(torch.where(known, self.candidate, -1), self.reversed & known)

    def at(self, rows: Int[Tensor, " k"]) -> "Choice":
        """This choice in some of the motions."""
        return Choice(self.candidate[rows], self.reversed[rows])

    def same_as(self, other: "Choice") -> bool:
        return torch.equal(self.candidate, other.candidate) and torch.equal(self.reversed, other.reversed)


def read_prior(config: CalibrationConfig) -> RigidTransform | None:
    """The prior, if there is one: to be read before any picture is, as mistakes should be told at once.

    Raises:
        FileError, InputError: `config.prior` holds no transform.
    """
    return None if config.prior is None else read_reference(Path(config.prior)).camera_right_T_arm


def associate(
    recording: Recording,
    config: CalibrationConfig,
    poses: MotionPoses,
    views: tuple[View, ...],
    prior: RigidTransform | None,
) -> tuple[list[tuple[Choice, ...]], bool]:
    """The choices to solve with at first (`first_choices`), and whether the pictures show several instruments."""
    detections = tuple(view.at(poses.frames) for view in views)
    instruments = choices_by_instrument(detections)
    return first_choices(recording, config, poses, detections, instruments, prior), bool(instruments)


def first_choices(
    recording: Recording,
    config: CalibrationConfig,
    poses: MotionPoses,
    detections: tuple[ShaftDetections, ...],
    instruments: list[tuple[Choice, ...]],
    prior: RigidTransform | None,
) -> list[tuple[Choice, ...]]:
    """Candidates to solve with at first, one entry an attempt: as a prior or `config.instrument_at` has it; else the
    surest ones and, where pictures show several instruments, each of these.

    Args:
        recording: for the cameras.
        config: what is known beforehand.
        poses: kinematics of the motions.
        detections: of the motions, one entry a camera.
        instruments: from `choices_by_instrument`.
        prior: from `read_prior`.

    Raises:
        InputError: there is no shaft where `config.instrument_at` points, or not enough of it to tell which one it is.
    """
    if prior is not None:
        return [_near_prior(recording, prior, poses, detections, several=bool(instruments))]
    surest = tuple(first_choice(found) for found in detections)
    if config.instrument_at is None:
        others = [choices for choices in instruments if not all(map(Choice.same_as, choices, surest))]
        return [surest, *others]
    frame, u, v = config.instrument_at
    motion = np.flatnonzero(poses.frames == frame)
    xy, _ = recording.stereo.right.undistort_points(torch.tensor([u, v], dtype=torch.float64))
    shown = pointed_at(detections[0].of_frames(torch.as_tensor(motion)), xy) if len(motion) else -1
    if shown < 0:
        found = f"none there in frame {frame}"
        raise InputError(
            where="instrument_at", expected="a point on a shaft that is detected (see `detect`)", found=found
        )
    if not instruments:
        return [surest]
    own = [choices for choices in instruments if int(choices[0].candidate[motion[0]]) == shown]
    if not own:
        expected = "a shaft that enters the picture, its tip's side in view"
        raise InputError(where="instrument_at", expected=expected, found=f"another strip in frame {frame}")
    return own


def _near_prior(
    recording: Recording,
    prior: RigidTransform,
    poses: MotionPoses,
    detections: tuple[ShaftDetections, ...],
    several: bool,
) -> tuple[Choice, ...]:
    """The candidates nearest to where a prior puts the shaft."""
    camera_T_arm = [prior.matrix]
    extrinsics = recording.stereo.camera_left_T_camera_right
    if extrinsics is not None and len(detections) == 2:
        camera_T_arm.append(extrinsics.matrix @ camera_T_arm[0])
    reach = _PRIOR_REACH if several else torch.inf
    radius_mm = recording.shaft_diameter_mm / 2
    return tuple(
        consistent_choice(found, predict_contours(matrix.to(poses.arm_T_rcm), poses, radius_mm), reach)
        for found, matrix in zip(detections, camera_T_arm, strict=True)
    )


def first_choice(detections: ShaftDetections) -> Choice:
    """The most confident candidate whose tip side is known."""
    usable = detections.valid & detections.direction_known
    candidate = torch.where(usable.any(-1), usable.int().argmax(-1), -1)
    return Choice(candidate, torch.zeros_like(usable[:, 0]))


def consistent_choice(
    detections: ShaftDetections, predicted_n_contour: Float[Tensor, "m 2 3"], reach: float = torch.inf
) -> Choice:
    """The candidate nearest to where a first calibration and the kinematics put the shaft.

    A candidate whose tip side the picture does not show is taken in the direction that fits. Whether the nearest one
    is near enough is the solver's outlier test, which knows the noise; but where other instruments are all that many
    pictures show, there would be more outliers than shafts.

    Args:
        detections: of the motions, in one camera.
        predicted_n_contour: contour planes there.
        reach: what lies farther off, normalised units, is another instrument.
    """
    distance, back = _distances(detections, predicted_n_contour)
    best = distance.argmin(dim=-1)
    reached = distance.gather(-1, best[:, None])[:, 0] < reach
    turned = back.gather(-1, best[:, None])[:, 0]
    return Choice(torch.where(reached, best, -1), turned & reached)


def association_gate(
    choice: Choice, detections: ShaftDetections, predicted_n_contour: Float[Tensor, "m 2 3"], used: Bool[Tensor, " m"]
) -> float:
    """How far off a shaft may be and still be the one that a calibration predicts, normalised units: well beyond the
    candidates that it was made from."""
    distance, _ = _distances(detections, predicted_n_contour)
    own = distance.gather(-1, choice.candidate.clamp(min=0)[:, None])[:, 0][used & choice.taken]
    own = own[torch.isfinite(own)]
    return max(_LEAST_REACH, 3.0 * float(own.quantile(0.9))) if len(own) else torch.inf


def choices_by_instrument(views: tuple[ShaftDetections, ...]) -> list[tuple[Choice, ...]]:
    """One choice for each instrument that the pictures seem to show, or none where they show one at a time.

    An instrument comes from its own side: its candidates are alike in direction and place, in all cameras and over the
    recording, more than they are like another's (k-means from the picture in which they are farthest apart).

    Args:
        views: detections of the motions, one entry a camera.
    """
    usable = torch.stack([view.valid & view.direction_known for view in views])  # (v, m, k)
    alike = torch.stack([_likeness(view) for view in views])  # (v, m, k, 3)
    together = usable.sum(-1)
    shares = [float((together >= count).double().mean()) for count in (2, 3)]
    count = 1 + sum(share > _SEVERAL for share in shares)
    if count == 1:
        return []
    centres = _farthest_apart(alike.flatten(0, 1), usable.flatten(0, 1), count)
    points, weight = alike.reshape(-1, 3), usable.reshape(-1)
    for _ in range(_ROUNDS):
        nearest = torch.cdist(points, centres).argmin(-1)
        member = torch.nn.functional.one_hot(nearest, count).to(points.dtype) * weight[:, None]
        size = member.sum(0)[:, None]
        centres = torch.where(size > 0, member.mT @ points / size.clamp(min=1.0), centres)
    group = torch.cdist(alike.reshape(-1, 3), centres).argmin(-1).reshape(usable.shape)
    choices = []
    for own in range(count):
        # Candidates are in the order of their confidence: the first one of the group is its surest.
        mine = usable & (group == own)
        candidate = torch.where(mine.any(-1), mine.int().argmax(-1), -1)
        choices.append(tuple(Choice(c, torch.zeros_like(c, dtype=torch.bool)) for c in candidate))
    return choices


def pointed_at(detections: ShaftDetections, xy: Float[Tensor, " 2"]) -> int:
    """Of one picture's candidates, the one that a point lies on, or within its width of the axis; -1 for none.

    Args:
        detections: of the picture, one frame.
        xy: normalised undistorted coordinates.
    """
    start, along = detections.axis_xy[0, :, 0], detections.axis_xy[0, :, 1] - detections.axis_xy[0, :, 0]
    relative = xy.to(start) - start
    off = (relative[:, 0] * along[:, 1] - relative[:, 1] * along[:, 0]).abs() / along.norm(dim=-1)
    width = (detections.contour_xy[0, :, 0] - detections.contour_xy[0, :, 1]).mean(1).norm(dim=-1)
    off = torch.where(detections.valid[0] & (off < width), off, torch.inf)
    return int(off.argmin()) if bool(torch.isfinite(off).any()) else -1


def distance_to(detections: ShaftDetections, predicted_n_contour: Float[Tensor, "m 2 3"]) -> Float[Tensor, "m k"]:
    """How far candidates lie from a prediction, normalised units; infinite for none."""
    return _distances(detections, predicted_n_contour)[0]


def _distances(
    detections: ShaftDetections, predicted_n_contour: Float[Tensor, "m 2 3"]
) -> tuple[Float[Tensor, "m k"], Bool[Tensor, "m k"]]:
    """How far candidates lie from the prediction, infinite for none; and which are nearer when walked back, where the
    picture leaves that open."""
    forward = _distance(detections.contour_xy, predicted_n_contour)
    backward = _distance(reversed_direction(detections.contour_xy), predicted_n_contour)
    backward = torch.where(detections.direction_known, torch.inf, backward)
    distance = torch.where(detections.valid, torch.minimum(forward, backward), torch.inf)
    return distance, backward < forward


def _likeness(view: ShaftDetections) -> Float[Tensor, "m k 3"]:
    """Direction towards the tip, and lateral place of the axis in normalised units; 0 for none."""
    along = torch.nn.functional.normalize(view.axis_xy[:, :, 1] - view.axis_xy[:, :, 0], dim=-1)
    middle = view.axis_xy.mean(2)
    lateral = middle[..., 0] * along[..., 1] - middle[..., 1] * along[..., 0]
    return torch.nan_to_num(torch.cat([along, lateral[..., None]], -1).double())


def _farthest_apart(alike: Float[Tensor, "m k 3"], usable: Bool[Tensor, "m k"], count: int) -> Float[Tensor, "count 3"]:
    """The first `count` candidates of the picture in which the nearest two of them are farthest apart."""
    order = usable.int().argsort(dim=-1, descending=True, stable=True)[:, :count]
    few = alike.gather(1, order[..., None].expand(-1, -1, 3))
    apart = torch.cdist(few, few) + torch.diag(few.new_full((count,), torch.inf))
    least = torch.where(usable.sum(-1) >= count, apart.flatten(1).amin(-1), -1.0)
    return few[least.argmax()]


def reversed_direction(contour_xy: Float[Tensor, "*batch 2 2 2"]) -> Float[Tensor, "*batch 2 2 2"]:
    """The same contours with the line directed the other way: the edges change sides and the points change order."""
    return contour_xy.flip(-3).flip(-2)


def _distance(
    contour_xy: Float[Tensor, "m k 2 2 2"], predicted_n_contour: Float[Tensor, "m 2 3"]
) -> Float[Tensor, "m k"]:
    """Root mean square distance of the four contour points from the predicted lines, normalised units."""
    line = predicted_n_contour / predicted_n_contour[..., :2].norm(dim=-1, keepdim=True)
    distance = point_line_distance(contour_xy.to(line.dtype), line[:, None, :, None, :])
    return distance.square().mean(dim=(-2, -1)).sqrt()
