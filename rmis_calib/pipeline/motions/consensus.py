"""The candidates that most agree on one transform: where other instruments, halves and shadows outnumber the shaft.

The two contours of a candidate and the known radius are a line in space; two such lines, with where the joints put
them, are a transform. Of the transforms of many pairs, the one is taken with which most pictures agree.
"""

from dataclasses import dataclass

import torch
from jaxtyping import Float, Int64
from torch import Tensor

from rmis_calib.geometry.lines import (
    axis_from_contours,
    contour_planes,
    plane_normal_from_points,
    point_line_distance,
)
from rmis_calib.geometry.rigid import rigid_from_rotation_translation, rigid_inverse, rotate_vectors, transform_points
from rmis_calib.geometry.rotations import rotvec_to_matrix
from rmis_calib.io import Recording
from rmis_calib.pipeline.arms.poses import MotionPoses
from rmis_calib.pipeline.motions.association import Choice, consistent_choice
from rmis_calib.pipeline.pictures.detection import View
from rmis_calib.vision import ShaftDetections

_MOTIONS, _DRAWN, _TRIED, _REFINED = 200, 40_000, 1_000, 16
_DIFFERENT = 0.1
"""Share of the pictures in which other candidates make another attempt."""
_LEAST_TURN, _TURN_ERROR = 0.07, 0.08
"""Of the directions of a pair, rad: they differ by as much as this, in the picture as in the joints to within that."""
# By these the equations of a line are weighed: the plane of its axis is seen to a pixel or so, its direction in that
# plane and its distance come from the width alone (rad, mm).
_PLANE, _PLANE_MM, _TILT, _DISTANCE_MM = 0.003, 0.5, 0.04, 2.0
_GATES = (0.04, 0.03, 0.02, 0.02)
"""Distance from the prediction, normalised units, within which a candidate agrees, step by step of the refinement."""


@dataclass(frozen=True, eq=False)
class SpaceLines:
    """Axis lines of candidates in the right camera, and where the joints put the shaft in `arm`."""

    camera_n: Float[Tensor, "*b 3"]
    """Unit normal of the plane through the optical centre and the axis."""
    camera_u: Float[Tensor, "*b 3"]
    """Unit direction to the axis' nearest point."""
    distance_mm: Float[Tensor, "*b"]
    arm_p: Float[Tensor, "*b 3"]
    """RCM, mm."""
    arm_v: Float[Tensor, "*b 3"]

    def at(self, index: Int64[Tensor, "*c"]) -> "SpaceLines":
        """The lines with these numbers."""
        return SpaceLines(**{name: value[index] for name, value in vars(self).items()})


@dataclass(frozen=True, eq=False)
class _Sight:
    """One camera's candidates whose direction is known, as one list of n."""

    camera_T_right: Float[Tensor, "4 4"]
    poses: MotionPoses
    radius_mm: float
    motion: Int64[Tensor, " n"]
    contour_xy: Float[Tensor, "n 2 2 2"]

    @classmethod
    def of(
        cls, poses: MotionPoses, found: ShaftDetections, camera_T_right: Float[Tensor, "4 4"], radius_mm: float
    ) -> "_Sight":
        """Of detections of these motions."""
        motion, rank = (found.valid & found.direction_known).nonzero(as_tuple=True)
        contour = found.contour_xy[motion, rank].to(poses.arm_T_rcm.dtype)
        return cls(camera_T_right, poses, radius_mm, motion, contour)

    def predicted(self, right_T_arm: Float[Tensor, "*h 4 4"]) -> Float[Tensor, "*h m 2 3"]:
        """Contour planes of every motion."""
        camera_T_rcm = (self.camera_T_right @ right_T_arm)[..., None, :, :] @ self.poses.arm_T_rcm
        v = rotate_vectors(camera_T_rcm, self.poses.rcm_v_axis.expand(*camera_T_rcm.shape[:-2], 3))
        return contour_planes(camera_T_rcm[..., :3, 3], v, self.radius_mm)

    def agreement(self, right_T_arm: Float[Tensor, "h 4 4"], gate: float) -> Float[Tensor, "h n"]:
        """1 for a candidate that lies where it is predicted, falling to 0 at the gate (rms of its points)."""
        line = self.predicted(right_T_arm)[:, self.motion]
        line = line / line[..., :2].norm(dim=-1, keepdim=True)
        square = point_line_distance(self.contour_xy, line[..., None, :]).square().mean((-2, -1))
        return (1 - square / gate**2).clamp(min=0.0)

    def support(self, right_T_arm: Float[Tensor, "h 4 4"]) -> Float[Tensor, " h"]:
        """How many pictures have a candidate that agrees, the better ones counting more."""
        agreement = self.agreement(right_T_arm, _GATES[-1])
        best = agreement.new_zeros(len(right_T_arm), len(self.poses.frames))
        return best.scatter_reduce(1, self.motion.expand_as(agreement), agreement, "amax").sum(1)

    def lines(self) -> SpaceLines:
        """The candidates in space."""
        edges = plane_normal_from_points(self.contour_xy[..., 0, :], self.contour_xy[..., 1, :])
        plane = axis_from_contours(edges, self.radius_mm)
        right_T_camera = rigid_inverse(self.camera_T_right)
        v = rotate_vectors(right_T_camera, torch.linalg.cross(plane.camera_n_axis, plane.camera_u))
        p = transform_points(right_T_camera, plane.camera_u * plane.distance_mm[:, None])
        # Of the left camera's line too, the plane and the point nearest to the right optical centre.
        foot = p - (p * v).sum(-1, keepdim=True) * v
        distance = foot.norm(dim=-1)
        u = foot / distance[:, None].clamp(min=1e-9)
        arm_T_rcm = self.poses.arm_T_rcm[self.motion]
        arm_v = rotate_vectors(arm_T_rcm, self.poses.rcm_v_axis[self.motion])
        return SpaceLines(torch.linalg.cross(u, v), u, distance, arm_T_rcm[:, :3, 3], arm_v)


def with_consensus(
    recording: Recording, poses: MotionPoses, views: tuple[View, ...], attempts: list[tuple[Choice, ...]]
) -> list[tuple[Choice, ...]]:
    """The attempts, and the candidates of most support where these are others than the first attempt's.

    Args:
        recording: for the cameras and the shaft.
        poses: of the motions; where nobody states the set-up they tell nothing of where the shaft is.
        views: detections of every frame.
        attempts: from `associate`.
    """
    extrinsics = recording.stereo.camera_left_T_camera_right
    if not poses.setup_is_stated or (len(views) == 2 and extrinsics is None):
        return attempts
    camera_T_right = [torch.eye(4, dtype=torch.float64)]
    if len(views) == 2 and extrinsics is not None:
        camera_T_right.append(extrinsics.matrix)
    detections = tuple(view.at(poses.frames) for view in views)
    choices = choices_by_consensus(poses, detections, tuple(camera_T_right), recording.shaft_diameter_mm / 2)
    if choices is None or _alike(choices, attempts[0]):
        return attempts
    return [*attempts, choices]


def _alike(these: tuple[Choice, ...], others: tuple[Choice, ...]) -> bool:
    """Whether nearly all of what both take are the same candidates, and neither takes much more."""
    mine, theirs = (torch.cat([choice.candidate for choice in choices]) for choices in (these, others))
    differ = (mine != theirs).sum()
    return float(differ) < _DIFFERENT * float(((mine >= 0) | (theirs >= 0)).sum())


def choices_by_consensus(
    poses: MotionPoses,
    detections: tuple[ShaftDetections, ...],
    camera_T_right: tuple[Float[Tensor, "4 4"], ...],
    radius_mm: float,
) -> tuple[Choice, ...] | None:
    """The candidates nearest to the transform with which most agree; None where no two differ enough to give one.

    Args:
        poses: of the motions.
        detections: of the same motions, one entry a camera.
        camera_T_right: pose of the right camera in each, mm.
        radius_mm: of the shaft.
    """
    few = torch.zeros(len(poses.frames), dtype=torch.bool, device=poses.arm_T_rcm.device)
    few[:: -(-len(few) // _MOTIONS)] = True
    sights, all_sights = (
        [
            _Sight.of(some, found.of_frames(which), transform.to(some.arm_T_rcm), radius_mm)
            for found, transform in zip(detections, camera_T_right, strict=True)
        ]
        for some, which in ((poses.select(few), few), (poses, torch.ones_like(few)))
    )
    each = [vars(sight.lines()).values() for sight in sights]
    lines = SpaceLines(*(torch.cat(values) for values in zip(*each, strict=True)))
    pairs = _pairs(lines)
    if not len(pairs):
        return None
    tried = _through_pairs(lines.at(pairs))
    support = torch.stack([sight.support(tried) for sight in sights]).sum(0)
    best = tried[support.topk(min(_REFINED, len(tried))).indices]
    for gate in _GATES:
        weight = torch.cat([sight.agreement(best, gate) for sight in sights], 1)
        for _ in range(3):
            best = _step(best, lines, weight)
    right_T_arm = best[torch.stack([sight.support(best) for sight in sights]).sum(0).argmax()]
    return tuple(
        consistent_choice(found, sight.predicted(right_T_arm), _GATES[0])
        for found, sight in zip(detections, all_sights, strict=True)
    )


def _pairs(lines: SpaceLines) -> Int64[Tensor, "h 2"]:
    """Numbers of two lines that differ in direction by what the joints say, drawn with a fixed seed."""
    count = len(lines.distance_mm)
    if count < 2:
        return torch.zeros(0, 2, dtype=torch.int64, device=lines.distance_mm.device)
    drawn = torch.randint(count, (_DRAWN, 2), generator=torch.Generator().manual_seed(0)).to(lines.arm_v.device)
    camera_v = torch.linalg.cross(lines.camera_n, lines.camera_u)
    seen, told = (_angle(v[drawn[:, 0]], v[drawn[:, 1]]) for v in (camera_v, lines.arm_v))
    return drawn[(told > _LEAST_TURN) & ((seen - told).abs() < _TURN_ERROR)][:_TRIED]


def _angle(a: Float[Tensor, "h 3"], b: Float[Tensor, "h 3"]) -> Float[Tensor, " h"]:
    return torch.atan2(torch.linalg.cross(a, b).norm(dim=-1), (a * b).sum(-1))


def _through_pairs(pairs: SpaceLines) -> Float[Tensor, "h 4 4"]:
    """The transform that takes both lines of each pair to where they are seen, as well as can be."""

    def frame(v: Float[Tensor, "h 2 3"]) -> Float[Tensor, "h 3 3"]:
        both = torch.nn.functional.normalize(v.sum(1), dim=-1)
        across = torch.nn.functional.normalize(torch.linalg.cross(v[:, 0], v[:, 1]), dim=-1)
        return torch.stack([both, across, torch.linalg.cross(both, across)], -1)

    camera_v = torch.linalg.cross(pairs.camera_n, pairs.camera_u)
    R = frame(camera_v) @ frame(pairs.arm_v).mT
    start = rigid_from_rotation_translation(R, R.new_zeros(len(R), 3))
    weight = pairs.distance_mm.new_ones(pairs.distance_mm.shape)
    for _ in range(4):
        start = _step(start, pairs, weight)
    return start


def _step(
    right_T_arm: Float[Tensor, "h 4 4"], lines: SpaceLines, weight: Float[Tensor, "h n"]
) -> Float[Tensor, "h 4 4"]:
    """One Gauss-Newton step on the four equations of each line: its axis lies in the plane that is seen (n . v = 0,
    n . p = 0), across the view (u . v = 0) and at its distance (u . p = D)."""
    R, t = right_T_arm[:, :3, :3], right_T_arm[:, :3, 3]
    v, p = ((R[:, None] @ each[..., None])[..., 0] for each in (lines.arm_v, lines.arm_p))
    n, u = lines.camera_n.expand_as(v), lines.camera_u.expand_as(v)
    zero = torch.zeros_like(n)
    rows = torch.stack(
        [
            torch.cat([torch.linalg.cross(v, n), zero], -1) / _PLANE,
            torch.cat([torch.linalg.cross(p, n), n], -1) / _PLANE_MM,
            torch.cat([torch.linalg.cross(v, u), zero], -1) / _TILT,
            torch.cat([torch.linalg.cross(p, u), u], -1) / _DISTANCE_MM,
        ],
        -2,
    )  # (h, n, 4, 6)
    at = p + t[:, None]
    off = torch.stack(
        [
            (n * v).sum(-1) / _PLANE,
            (n * at).sum(-1) / _PLANE_MM,
            (u * v).sum(-1) / _TILT,
            ((u * at).sum(-1) - lines.distance_mm) / _DISTANCE_MM,
        ],
        -1,
    )
    weighted = rows * weight[..., None, None]
    normal = torch.einsum("hnri,hnrj->hij", weighted, rows) + 1e-3 * torch.eye(6, dtype=R.dtype, device=R.device)
    step = -torch.linalg.solve(normal, torch.einsum("hnri,hnr->hi", weighted, off))
    return rigid_from_rotation_translation(rotvec_to_matrix(step[:, :3]) @ R, t + step[:, 3:])
