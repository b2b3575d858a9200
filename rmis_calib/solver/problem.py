"""What the solver sees: batched tensors of motions and measurements, checked once.

Axes: any leading trial batch, then the camera (0 right, 1 left) where a tensor has one, then N motions. A measurement
that is absent is NaN and not valid. Units: mm, rad, s; image coordinates are normalised and undistorted (x/z, y/z).
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, fields, replace
from typing import Any

import torch
from jaxtyping import Bool, Float
from torch import Tensor

from rmis_calib.errors import InputError, ObservationsError
from rmis_calib.geometry.rigid import rigid_inverse
from rmis_calib.solver.observation_arrays import ObservationArrays
from rmis_calib.solver.own_measurement import Measurement
from rmis_calib.solver.tensors import axes_of, map_tensors

KINDS = {"axis": "axis", "contours": "contour", "ends": "end", "heads": "head"}
"""Kinds of measurement, as settings name them, and what their tensors are called after."""
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
        readout: of the time from reading a row to reading the one a focal length farther down, s.
        edge_bias: of a shift across the line that a contour point has in every motion alike, normalised units.
        focal: of each camera's focal length, relative.
        centre: of its principal point, per axis, in focal lengths.
        lens: of its radial distortion k1.
        setup_mm: per axis, of the stated `laparoscope_base_T_instrument_base` (right perturbation).
        setup_rad: its orientation.
        rcm_mm: per axis across the shaft, of the distance at which its axis passes the RCM.
    """

    image: Float[Tensor, "*batch"]
    kinematics_mm: Float[Tensor, "*batch"]
    kinematics_rad: Float[Tensor, "*batch"]
    camera_mm: Float[Tensor, "*batch"]
    camera_rad: Float[Tensor, "*batch"]
    stereo_mm: Float[Tensor, "*batch"]
    stereo_rad: Float[Tensor, "*batch"]
    readout: Float[Tensor, "*batch"]
    edge_bias: Float[Tensor, "*batch"]
    focal: Float[Tensor, "*batch"]
    centre: Float[Tensor, "*batch"]
    lens: Float[Tensor, "*batch"]
    setup_mm: Float[Tensor, "*batch"]
    setup_rad: Float[Tensor, "*batch"]
    rcm_mm: Float[Tensor, "*batch"]


_NONE_UNLESS_NAMED = ("camera_mm", "camera_rad", "readout", "edge_bias", "focal", "centre", "lens")
"""Levels that are zero where the observations do not name them."""


@dataclass(frozen=True)
class Problem:
    """Motions of one calibration, or of a batch of trials; the annotations say which axes a tensor has.

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
        end_kind: what a detector takes it for: 0 the tube's own end, 1 a ring that closes it; NaN: it does not say.
        end_sureness: how probable the detector holds that; NaN: it does not say.
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
        clock_derivative: the same displacement per second of clock offset, and per unit by which the joints' clock runs
            faster than the video's (which is that times the time from the recording's middle), [motion, 6, 2].
        laparoscope_joints: how many of the joints, the first ones, are the laparoscope's.
        joints: their readings, in their units, which residuals are tested over; None where they are not known.
        joint_offset_at: joint offsets at which the kinematics here were evaluated; None: zero.
        clock_at: clock offset, s, and rate, likewise.
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
    end_kind: Float[Tensor, "*batch c n"]
    end_sureness: Float[Tensor, "*batch c n"]
    head_xy: Float[Tensor, "*batch c n 2"]
    head_sigma: Float[Tensor, "*batch c n"]
    valid: Bool[Tensor, "*batch c n"]
    rcm_s_end_mm: Float[Tensor, "*batch n"]
    rcm_p_head: Float[Tensor, "*batch n 3"]
    radius_mm: Float[Tensor, "*batch"]
    noise: NoiseLevels
    joint_derivative: Float[Tensor, "*batch n 6 j"] | None = None
    joint_offset_sigma: Float[Tensor, "*batch j"] | None = None
    clock_derivative: Float[Tensor, "*batch n 6 2"] | None = None
    joint_offset_at: Float[Tensor, "*batch j"] | None = None
    clock_at: Float[Tensor, "*batch 2"] | None = None
    own: tuple[Measurement, ...] = ()
    laparoscope_base_T_arm: Float[Tensor, "*batch n 4 4"] | None = None
    laparoscope_base_T_instrument_base: Float[Tensor, "*batch 4 4"] | None = None
    setup_stated: Float[Tensor, "*batch 4 4"] | None = None
    laparoscope_joints: int = 0
    joints: Float[Tensor, "*batch n j"] | None = None

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
        dropped = [f"{name}_xy" for kind, name in KINDS.items() if kind not in kinds]
        return replace(self, **{name: torch.full_like(getattr(self, name), torch.nan) for name in dropped})

    def cameras(self, count: int) -> "Problem":
        """The problem seen by the first `count` cameras."""
        k = len(self.batch_shape)
        seen = [name for name, axes in axes_of(Problem).items() if "c" in axes]
        return replace(self, **{name: getattr(self, name).narrow(k, 0, count) for name in seen})

    @property
    def end_measured(self) -> Bool[Tensor, "*batch c n"]:
        """Which shaft ends are measured, at a place that the kinematics tell."""
        known = torch.isfinite(self.rcm_s_end_mm)[..., None, :]
        return torch.isfinite(self.end_xy).all(-1) & self.valid & known

    def select_motions(self, index: Tensor | slice) -> "Problem":
        """The problem of the motions `index` (positions, a mask or a slice), the same for every trial."""
        k = len(self.batch_shape)

        def selected(x: Tensor, dim: int) -> Tensor:
            return x[(slice(None),) * dim + (index,)]

        changed: dict[str, Any] = {"own": map_tensors(self.own, lambda x: selected(x, k))}
        for name, axes in axes_of(Problem).items():
            value = getattr(self, name)
            if value is not None and "n" in axes:
                changed[name] = selected(value, k + axes.index("n"))
        return replace(self, **changed)

    def flatten_batch(self) -> "Problem":
        """The same with exactly one leading axis of trials."""
        k = len(self.batch_shape)
        return map_tensors(self, lambda x: x.reshape(self.n_trials, *x.shape[k:]))

    def detach(self) -> "Problem":
        """The same off any graph."""
        return map_tensors(self, Tensor.detach)

    def take_trials(self, index: Tensor | slice | int) -> "Problem":
        """The problem of some trials of the only batch axis, in this order; with a number, that trial without the
        axis."""
        return map_tensors(self, lambda x: x[index])

    @classmethod
    def from_observations(cls, observations: Any, dtype: torch.dtype = torch.float64, device: str = "cpu") -> "Problem":
        """From an object with the keys of an observations file as attributes (`io.observations.ShaftObservations`)."""
        return cls.from_arrays(vars(observations), dtype, device)

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
        read = ObservationArrays(arrays, dtype, device)
        levels = {field.name: read.filled(f"sigma_{field.name}") for field in fields(NoiseLevels)}
        for name in _NONE_UNLESS_NAMED:
            levels[name] = torch.nan_to_num(levels[name], nan=0.0)
        return cls(**read.motions(), **read.chains(), noise=NoiseLevels(**levels))


def stands_still(laparoscope_base_T_arm: Float[Tensor, "*batch n 4 4"]) -> Bool[Tensor, "*batch"]:
    """Whether an arm stays within STILL_RAD and STILL_MM of where it first is."""
    first = laparoscope_base_T_arm[..., :1, :, :]
    away = laparoscope_base_T_arm - first
    turned = away[..., :3, :3].square().sum((-2, -1)).sqrt().amax(-1)
    moved = torch.linalg.vector_norm(away[..., :3, 3], dim=-1).amax(-1)
    return (turned < STILL_RAD) & (moved < STILL_MM)
