"""What the solver sees: batched tensors of motions and measurements, checked once.

Axes: any leading trial batch, then the camera (0 right, 1 left) where a tensor has one, then N motions. A measurement
that is absent is NaN and not valid. Units: mm, rad, s; image coordinates are normalised and undistorted (x/z, y/z).
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, fields, replace
from typing import Any

import numpy as np
import torch
from jaxtyping import Bool, Float
from torch import Tensor

from rmis_calib.errors import InputError, InsufficientDataError, ObservationsError
from rmis_calib.geometry.rigid import rigid_inverse
from rmis_calib.solver.own_measurement import Measurement

MIN_MOTIONS = 3
CAMERAS = ("right", "left")
STILL_RAD, STILL_MM = 2e-3, 0.2
"""Reach of an arm that holds still (0.1 degrees of encoder noise, and what a hand does to it)."""


@dataclass(frozen=True)
class NoiseLevels:
    """1-sigma noise levels per trial; NaN where unknown.

    Attributes:
        image: of an image point across its line, normalised units.
        kinematics_mm: per axis, of the position of `arm_T_rcm` (right perturbation).
        kinematics_rad: per axis, of its orientation.
        camera_mm: per axis, of the pose that each camera sees, drawn anew for every motion and camera.
        camera_rad: its orientation.
        stereo_mm: per axis, of `camera_left_T_camera_right`, drawn once.
        stereo_rad: its orientation.
        edge_bias: of a shift across the line that a contour point has in every motion alike, normalised units.
        focal: of each camera's focal length, relative.
        centre: of its principal point, per axis, in focal lengths.
        lens: of its radial distortion k1.
        setup_mm: per axis, of the stated `laparoscope_base_T_instrument_base` (right perturbation).
        setup_rad: its orientation.
    """

    image: Float[Tensor, "*batch"]
    kinematics_mm: Float[Tensor, "*batch"]
    kinematics_rad: Float[Tensor, "*batch"]
    camera_mm: Float[Tensor, "*batch"]
    camera_rad: Float[Tensor, "*batch"]
    stereo_mm: Float[Tensor, "*batch"]
    stereo_rad: Float[Tensor, "*batch"]
    edge_bias: Float[Tensor, "*batch"]
    focal: Float[Tensor, "*batch"]
    centre: Float[Tensor, "*batch"]
    lens: Float[Tensor, "*batch"]
    setup_mm: Float[Tensor, "*batch"]
    setup_rad: Float[Tensor, "*batch"]


@dataclass(frozen=True)
class Problem:
    """Motions of one calibration, or of a batch of trials.

    Attributes:
        arm_T_rcm: pose of the RCM frame in the laparoscope arm's end-effector frame.
        rcm_v_axis: unit direction of the shaft, RCM to tip.
        camera_T_camera_right: identity, then (with two cameras) `camera_left_T_camera_right`.
        axis_xy: two points of the axis line, RCM side first, [camera, motion, point, xy].
        axis_sigma: 1 sigma of each of these points across the line; NaN: the image noise.
        contour_xy: [camera, motion, edge, point, xy]; edge 0 left of the axis, directed from the RCM side
            to the tip.
        contour_sigma: [camera, motion, edge].
        end_xy: the shaft's end on the axis; only its place along the axis is used.
        end_sigma: along the axis.
        head_xy: image of the head point.
        head_sigma: per coordinate.
        valid: motions in which this camera saw the shaft.
        rcm_s_end_mm: nominal coordinate of the shaft's end along the axis from the RCM, known up to a constant.
        rcm_p_head: the head point.
        radius_mm: of the shaft; NaN when unknown (contours are then not used).
        noise: levels, NaN where unknown.
        joint_derivative: displacement of the shaft as a rigid body (rotation vector, translation; in `rcm`) per unit of
            each joint's offset, [motion, 6, joint]; None when joint offsets cannot be estimated. A change of
            `rcm_v_axis` enters as v x dv, a change of the insertion as v ds.
        joint_offset_sigma: prior of each joint's offset, in its unit.
        clock_derivative: the same displacement per second of clock offset, [motion, 6].
        laparoscope_joints: how many of the joints, the first ones, are the laparoscope's.
        joint_offset_at: joint offsets at which the kinematics here were evaluated; None: zero.
        clock_at: clock offset, s, likewise.
        own: measurements of the user's own.
        laparoscope_base_T_arm: forward kinematics of the laparoscope's arm in its own base; None where the set-up
            (the pose of one arm's base in the other's) cannot be an unknown.
        laparoscope_base_T_instrument_base: the set-up at which `arm_T_rcm` was evaluated.
        setup_stated: the set-up that the user states; NaN: unknown.
    """

    arm_T_rcm: Float[Tensor, "*batch n 4 4"]
    rcm_v_axis: Float[Tensor, "*batch n 3"]
    camera_T_camera_right: Float[Tensor, "*batch c 4 4"]
    axis_xy: Float[Tensor, "*batch c n 2 2"]
    axis_sigma: Float[Tensor, "*batch c n"]
    contour_xy: Float[Tensor, "*batch c n 2 2 2"]
    contour_sigma: Float[Tensor, "*batch c n 2"]
    end_xy: Float[Tensor, "*batch c n 2"]
    end_sigma: Float[Tensor, "*batch c n"]
    head_xy: Float[Tensor, "*batch c n 2"]
    head_sigma: Float[Tensor, "*batch c n"]
    valid: Bool[Tensor, "*batch c n"]
    rcm_s_end_mm: Float[Tensor, "*batch n"]
    rcm_p_head: Float[Tensor, "*batch n 3"]
    radius_mm: Float[Tensor, "*batch"]
    noise: NoiseLevels
    joint_derivative: Float[Tensor, "*batch n 6 j"] | None = None
    joint_offset_sigma: Float[Tensor, "*batch j"] | None = None
    clock_derivative: Float[Tensor, "*batch n 6"] | None = None
    joint_offset_at: Float[Tensor, "*batch j"] | None = None
    clock_at: Float[Tensor, "*batch"] | None = None
    own: tuple[Measurement, ...] = ()
    laparoscope_base_T_arm: Float[Tensor, "*batch n 4 4"] | None = None
    laparoscope_base_T_instrument_base: Float[Tensor, "*batch 4 4"] | None = None
    setup_stated: Float[Tensor, "*batch 4 4"] | None = None
    laparoscope_joints: int = 0

    @property
    def batch_shape(self) -> torch.Size:
        return self.arm_T_rcm.shape[:-3]

    @property
    def n_motions(self) -> int:
        return self.arm_T_rcm.shape[-3]

    @property
    def n_cameras(self) -> int:
        return self.camera_T_camera_right.shape[-3]

    @property
    def n_trials(self) -> int:
        return self.batch_shape.numel()

    @property
    def instrument_base_T_rcm(self) -> Float[Tensor, "*batch n 4 4"]:
        """Forward kinematics of the instrument in its own base: what `arm_T_rcm` says at the set-up it was evaluated
        at.

        Raises:
            ObservationsError: the laparoscope's own kinematics are not told.
        """
        laparoscope, setup = self.chains
        return rigid_inverse(setup)[..., None, :, :] @ laparoscope @ self.arm_T_rcm

    @property
    def chains(self) -> tuple[Float[Tensor, "*batch n 4 4"], Float[Tensor, "*batch 4 4"]]:
        """`laparoscope_base_T_arm` and `laparoscope_base_T_instrument_base`.

        Raises:
            ObservationsError: they are not told.
        """
        if self.laparoscope_base_T_arm is None or self.laparoscope_base_T_instrument_base is None:
            raise ObservationsError(
                where="the set-up as an unknown", expected="laparoscope_base_T_arm of every motion", found="none"
            )
        return self.laparoscope_base_T_arm, self.laparoscope_base_T_instrument_base

    def at_setup(self, setup: Float[Tensor, "*batch 4 4"]) -> "Problem":
        """The problem with the instrument's arm where this `laparoscope_base_T_instrument_base` puts it.

        What the laparoscope's joints do to the shaft stays the same in `arm`, and so turns in `rcm`; the derivative for
        the clock, a mixture of both arms', stays as it is.
        """
        laparoscope, _ = self.chains
        arm_T_rcm = rigid_inverse(laparoscope) @ setup[..., None, :, :] @ self.instrument_base_T_rcm
        moved = replace(self, arm_T_rcm=arm_T_rcm, laparoscope_base_T_instrument_base=setup)
        if self.joint_derivative is None or self.laparoscope_joints == 0:
            return moved
        of_laparoscope, others = self.joint_derivative.tensor_split((self.laparoscope_joints,), dim=-1)
        before, after = self.arm_T_rcm, arm_T_rcm
        turn, shift = (before[..., :3, :3] @ part for part in of_laparoscope.tensor_split(2, dim=-2))
        shift = shift + torch.linalg.cross(turn, (after - before)[..., :3, 3:].expand_as(turn), dim=-2)
        turned = torch.cat((after[..., :3, :3].mT @ turn, after[..., :3, :3].mT @ shift), dim=-2)
        return replace(moved, joint_derivative=torch.cat((turned, others), dim=-1))

    def with_exact_setup(self) -> "Problem":
        """The problem without the laparoscope's own kinematics: its set-up is exact, and no data speak against it."""
        return replace(self, laparoscope_base_T_arm=None, laparoscope_base_T_instrument_base=None, setup_stated=None)

    def in_instrument_base(self) -> "Problem":
        """The problem with the instrument's base in the place of `arm`: what remains where the laparoscope stands still
        and nobody knows where the instrument's base is. Offsets of joints cannot be told then."""
        return replace(
            self,
            arm_T_rcm=self.instrument_base_T_rcm,  # frames: instrument_base = arm
            laparoscope_base_T_arm=None,
            laparoscope_base_T_instrument_base=None,
            setup_stated=None,
            joint_derivative=None,
            joint_offset_sigma=None,
            joint_offset_at=None,
            laparoscope_joints=0,
        )

    @property
    def laparoscope_stands_still(self) -> Bool[Tensor, "*batch"]:
        """Whether the laparoscope's own joints do not move it beyond what no calibration could use.

        Raises:
            ObservationsError: the laparoscope's own kinematics are not told.
        """
        return stands_still(self.chains[0])

    def with_own(self, own: Sequence[Measurement]) -> "Problem":
        """The problem with measurements of the user's own.

        Raises:
            InputError: two of one name, one of a camera that is not there, or values that do not fit the motions.
        """
        names = [item.name for item in own]
        if len(set(names)) < len(names):
            raise InputError(where="measurements", expected="different names", found=", ".join(names))
        for item in own:
            if item.camera == "left" and self.n_cameras < 2:
                raise InputError(
                    where=f"measurement {item.name!r}", expected="two cameras", found="the right one alone"
                )
        like = self.arm_T_rcm
        return replace(
            self, own=tuple(item.as_tensors(self.batch_shape, self.n_motions, like.dtype, like.device) for item in own)
        )

    def only(self, *kinds: str) -> "Problem":
        """The problem with these kinds of measurement alone (`axis`, `contours`, `ends`, `heads`)."""
        names = {"axis": "axis_xy", "contours": "contour_xy", "ends": "end_xy", "heads": "head_xy"}
        dropped = {
            name: torch.full_like(getattr(self, name), torch.nan) for kind, name in names.items() if kind not in kinds
        }
        return replace(self, **dropped)

    def cameras(self, count: int) -> "Problem":
        """The problem seen by the first `count` cameras."""
        start = len(self.batch_shape)
        names = (
            "camera_T_camera_right",
            "valid",
            *(f"{k}_{s}" for k in ("axis", "contour", "end", "head") for s in ("xy", "sigma")),
        )
        return replace(self, **{name: getattr(self, name).narrow(start, 0, count) for name in names})

    @property
    def end_measured(self) -> Bool[Tensor, "*batch c n"]:
        """Which shaft ends are measured, at a place that the kinematics tell."""
        known = torch.isfinite(self.rcm_s_end_mm)[..., None, :]
        return torch.isfinite(self.end_xy).all(-1) & self.valid & known

    def select_motions(self, index: Tensor | slice) -> "Problem":
        """The problem of the motions `index` (positions, a mask or a slice), the same for every trial."""
        return self._map_motions(lambda x, dim: x[(slice(None),) * dim + (index,)])

    def flatten_batch(self) -> "Problem":
        """The same with exactly one leading axis of trials."""
        k = len(self.batch_shape)

        def flat(x: Tensor) -> Tensor:
            return x.reshape(self.n_trials, *x.shape[k:])

        return _map_tensors(self, lambda x, _: flat(x))

    def detach(self) -> "Problem":
        """The same off any graph."""
        return _map_tensors(self, lambda x, _: x.detach())

    def take_trials(self, index: Tensor | slice | int) -> "Problem":
        """The problem of some trials of the only batch axis, in this order; with a number, that trial without the
        axis."""
        return _map_tensors(self, lambda x, _: x[index])

    def _map_motions(self, function: Any) -> "Problem":
        k = len(self.batch_shape)
        after_camera = {
            "axis_xy",
            "axis_sigma",
            "contour_xy",
            "contour_sigma",
            "end_xy",
            "end_sigma",
            "head_xy",
            "head_sigma",
            "valid",
        }
        constant = {"camera_T_camera_right", "radius_mm", "joint_offset_sigma", "joint_offset_at", "clock_at"}
        constant |= {"laparoscope_base_T_instrument_base", "setup_stated"}
        changed: dict[str, Any] = {}
        for field in fields(self):
            value = getattr(self, field.name)
            if isinstance(value, Tensor) and field.name not in constant:
                changed[field.name] = function(value, k + (field.name in after_camera))
        changed["own"] = tuple(own.map_tensors(lambda x: function(x, k)) for own in self.own)
        return replace(self, **changed)

    @classmethod
    def from_observations(cls, observations: Any, dtype: torch.dtype = torch.float64, device: str = "cpu") -> "Problem":
        """From an object with the keys of an observations file as attributes (`io.observations.ShaftObservations`)."""
        return cls.from_arrays({key: getattr(observations, key, None) for key in OBSERVATION_KEYS}, dtype, device)

    @classmethod
    def from_arrays(
        cls, arrays: Mapping[str, Any], dtype: torch.dtype = torch.float64, device: str = "cpu"
    ) -> "Problem":
        """From arrays in the keys of an observations file, any leading trial batch.

        Edges of contours are put into the canonical order. Missing arrays become NaN, missing noise levels NaN
        (unknown).

        Raises:
            ObservationsError: a key is missing or an array has the wrong shape. InsufficientDataError: fewer than 3
            motions.
        """
        return _Reader(arrays, dtype, device).problem()


def stands_still(laparoscope_base_T_arm: Float[Tensor, "*batch n 4 4"]) -> Bool[Tensor, "*batch"]:
    """Whether an arm stays within STILL_RAD and STILL_MM of where it first is."""
    first = laparoscope_base_T_arm[..., :1, :, :]
    away = laparoscope_base_T_arm - first
    turned = away[..., :3, :3].square().sum((-2, -1)).sqrt().amax(-1)
    moved = torch.linalg.vector_norm(away[..., :3, 3], dim=-1).amax(-1)
    return (turned < STILL_RAD) & (moved < STILL_MM)


OBSERVATION_KEYS = (
    "arm_T_rcm", "rcm_v_axis", "camera_left_T_camera_right", "axis_right", "axis_left", "contour_right",
    "contour_left", "shaft_radius_mm", "end_right", "end_left", "rcm_s_end_mm", "head_right", "head_left",
    "rcm_p_head", "valid_right", "valid_left", "sigma_image", "sigma_kinematics_mm", "sigma_kinematics_rad",
    "sigma_camera_mm", "sigma_camera_rad", "sigma_stereo_mm", "sigma_edge_bias", "sigma_stereo_rad",
    "sigma_focal", "sigma_centre", "sigma_lens", "sigma_setup_mm", "sigma_setup_rad", "laparoscope_base_T_arm",
    "laparoscope_base_T_instrument_base",
    "sigma_axis_right", "sigma_axis_left", "sigma_contour_right", "sigma_contour_left", "sigma_end_right",
    "sigma_end_left", "sigma_head_right", "sigma_head_left",
)  # fmt: skip


class _Reader:
    """Turns a mapping of arrays into tensors of known shapes."""

    def __init__(self, arrays: Mapping[str, Any], dtype: torch.dtype, device: str) -> None:
        self.arrays, self.dtype, self.device = arrays, dtype, device
        self.poses = self.tensor("arm_T_rcm")
        if self.poses.ndim < 3 or self.poses.shape[-2:] != (4, 4):
            raise ObservationsError(where="arm_T_rcm", expected="shape (..., N, 4, 4)", found=tuple(self.poses.shape))
        self.batch, self.n = self.poses.shape[:-3], self.poses.shape[-3]
        if self.n < MIN_MOTIONS:
            raise InsufficientDataError(where="arm_T_rcm", expected=f"at least {MIN_MOTIONS} motions", found=self.n)
        self.sides = (
            CAMERAS if arrays.get("camera_left_T_camera_right") is not None and self._seen("left") else CAMERAS[:1]
        )

    def _seen(self, side: str) -> bool:
        return any(self.arrays.get(f"{kind}_{side}") is not None for kind in ("axis", "contour", "end", "head"))

    def tensor(self, key: str) -> Tensor:
        value = self.arrays.get(key)
        if value is None:
            raise ObservationsError(where=key, expected="an array", found="nothing")
        if isinstance(value, np.ndarray) and not value.flags.writeable:
            value = value.copy()  # torch cannot share read-only memory
        return torch.as_tensor(value, dtype=self.dtype, device=self.device)

    def filled(self, key: str, *tail: int) -> Tensor:
        """The array broadcast to (*batch, *tail), or NaN."""
        shape = (*self.batch, *tail)
        if self.arrays.get(key) is None:
            return torch.full(shape, torch.nan, dtype=self.dtype, device=self.device)
        value = self.tensor(key)
        if value.ndim == 0 or (not tail and value.shape == ()):
            return value.expand(shape).clone()
        if value.shape != shape:
            raise ObservationsError(where=key, expected=f"shape {shape}", found=tuple(value.shape))
        return value

    def both(self, name: str, *tail: int) -> Tensor:
        return torch.stack([self.filled(name.format(side), self.n, *tail) for side in self.sides], dim=len(self.batch))

    def noise(self) -> NoiseLevels:
        levels = {field.name: self.filled(f"sigma_{field.name}") for field in fields(NoiseLevels)}
        for name in ("camera_mm", "camera_rad", "edge_bias", "focal", "centre", "lens"):
            levels[name] = torch.nan_to_num(levels[name], nan=0.0)
        return NoiseLevels(**levels)

    def problem(self) -> Problem:
        axis, contour = self.both("axis_{}", 2, 2), self.both("contour_{}", 2, 2, 2)
        valid = torch.stack([self._valid(side) for side in self.sides], dim=len(self.batch))
        eye = torch.eye(4, dtype=self.dtype, device=self.device).expand(*self.batch, 4, 4)
        cameras = [eye] + ([self.filled("camera_left_T_camera_right", 4, 4)] if len(self.sides) == 2 else [])
        self.tensor("rcm_v_axis")  # required
        v = self.filled("rcm_v_axis", self.n, 3)
        unknown = torch.isnan(self.poses).flatten(-2).any(-1) | torch.isnan(v).any(-1)  # motions without kinematics
        if bool(unknown.all(-1).any()):
            raise ObservationsError(where="arm_T_rcm", expected="finite poses", found="NaN in every motion")
        # They take the place of the first known motion, where they change nothing that is told from the poses.
        first = (~unknown).int().argmax(-1, keepdim=True)
        poses = torch.where(
            unknown[..., None, None], torch.take_along_dim(self.poses, first[..., None, None], -3), self.poses
        )
        v = torch.where(unknown[..., None], torch.take_along_dim(v, first[..., None], -2), v)
        valid = valid & ~unknown[..., None, :]
        length = torch.linalg.vector_norm(v, dim=-1)
        if not bool((torch.isfinite(length) & (length > 1e-9)).all()):
            raise ObservationsError(
                where="rcm_v_axis", expected="finite unit directions", found="a zero or infinite one"
            )
        problem = Problem(
            arm_T_rcm=poses,
            rcm_v_axis=v / length[..., None],
            camera_T_camera_right=torch.stack(cameras, dim=-3),
            axis_xy=axis,
            axis_sigma=self.both("sigma_axis_{}"),
            contour_xy=_canonical_edges(contour, axis),
            contour_sigma=self.both("sigma_contour_{}", 2),
            end_xy=self.both("end_{}", 2),
            end_sigma=self.both("sigma_end_{}"),
            head_xy=self.both("head_{}", 2),
            head_sigma=self.both("sigma_head_{}"),
            valid=valid,
            rcm_s_end_mm=self.filled("rcm_s_end_mm", self.n),
            rcm_p_head=self.filled("rcm_p_head", self.n, 3),
            radius_mm=self.filled("shaft_radius_mm"),
            noise=self.noise(),
        )
        return self._with_chains(problem, first, unknown)

    def _with_chains(self, problem: Problem, first: Tensor, unknown: Tensor) -> Problem:
        """The laparoscope's own kinematics and the set-up, where they are told; unknown motions as for `arm_T_rcm`."""
        if self.arrays.get("laparoscope_base_T_arm") is None:
            return problem
        poses = self.filled("laparoscope_base_T_arm", self.n, 4, 4)
        poses = torch.where(unknown[..., None, None], torch.take_along_dim(poses, first[..., None, None], -3), poses)
        stated = self.filled("laparoscope_base_T_instrument_base", 4, 4)
        eye = torch.eye(4, dtype=self.dtype, device=self.device).expand(*self.batch, 4, 4)
        return replace(
            problem,
            laparoscope_base_T_arm=poses,
            laparoscope_base_T_instrument_base=torch.where(torch.isnan(stated), eye, stated),
            setup_stated=stated,
        )

    def _valid(self, side: str) -> Tensor:
        value = self.arrays.get(f"valid_{side}")
        if value is None:
            return torch.ones((*self.batch, self.n), dtype=torch.bool, device=self.device)
        if isinstance(value, np.ndarray):
            value = value.astype(bool)  # a copy: torch cannot share read-only memory
        return torch.as_tensor(value, dtype=torch.bool, device=self.device).expand(*self.batch, self.n)


def _canonical_edges(
    contour_xy: Float[Tensor, "*batch 2 2 2"], axis_xy: Float[Tensor, "*batch 2 2"]
) -> Float[Tensor, "*batch 2 2 2"]:
    """Edges swapped where edge 0 does not lie on the left-hand side (x right, y down) of the direction from the RCM
    side to the tip."""
    along = torch.where(
        torch.isfinite(axis_xy).all(-1).all(-1)[..., None], axis_xy[..., 1, :] - axis_xy[..., 0, :], torch.nan
    )
    own = (contour_xy[..., 1, :] - contour_xy[..., 0, :]).sum(-2)
    along = torch.where(torch.isfinite(along), along, own)
    across = contour_xy[..., 0, :, :].mean(-2) - contour_xy[..., 1, :, :].mean(-2)
    turn = along[..., 0] * across[..., 1] - along[..., 1] * across[..., 0]
    return torch.where((turn > 0)[..., None, None, None], contour_xy.flip(-3), contour_xy)


def _map_tensors(value: Any, function: Any) -> Any:
    """A dataclass with `function(tensor, name)` applied to every tensor in it."""
    changed = {}
    for field in fields(value):
        item = getattr(value, field.name)
        if isinstance(item, Tensor):
            changed[field.name] = function(item, field.name)
        elif isinstance(item, NoiseLevels):
            changed[field.name] = _map_tensors(item, function)
        elif isinstance(item, tuple):
            changed[field.name] = tuple(own.map_tensors(lambda x: function(x, "own")) for own in item)
    return replace(value, **changed)
