"""Which parameters a joint estimate has, and their priors."""

import math
from dataclasses import dataclass, replace

import torch
from jaxtyping import Float
from torch import Tensor

from rmis_calib.geometry.rigid import rigid_inverse, rigid_log
from rmis_calib.solver.model.compliance import COUNT, FUNCTIONS, PRIORS, SHIFTS, TURNS
from rmis_calib.solver.model.measurement_rows import MeasurementRows
from rmis_calib.solver.model.packing import line_points
from rmis_calib.solver.model.state import State
from rmis_calib.solver.problem import Problem
from rmis_calib.solver.settings import NoiseSettings, UnknownSettings

GIVEN_WAY = "given_way"
"""Block of a folded layout."""
UNITS = {
    "stereo_rotation": "rad",
    "stereo_translation": "mm",
    "radius": "mm",
    "end_offset": "mm",
    "end_gap": "mm",
    "rcm_offset": "mm",
    "joint_offset": "rad or mm",
    "clock": "s",
    "clock_rate": "relative",
    "readout": "s a focal length",
    "edge_bias": "focal lengths",
    "intrinsics": "relative, focal lengths, k1",
    "setup": "rad, mm",
    "compliance": "rad, mm",
}
"""Unit of each nuisance block."""


TRANSLATION_SIGMA_MM = 2000.0
"""Prior of the hand-eye translation about zero: no arm is longer. It moves a translation of 200 mm known to 1 mm by
5e-5 mm, and keeps one that the data cannot see within the operating theatre."""


@dataclass(frozen=True)
class ParameterLayout:
    """Blocks of the parameter vector, with the priors.

    Attributes:
        blocks: name -> slice; `rotation` and `translation` of the hand-eye transform come first.
        sigma: prior 1 sigma of every parameter; infinite for the hand-eye rotation.
        origin: state that the priors are centred on.
    """

    blocks: dict[str, slice]
    sigma: Float[Tensor, "b p"]
    origin: State

    @property
    def size(self) -> int:
        return self.sigma.shape[-1]

    @property
    def folded(self) -> "ParameterLayout":
        """The same with the components of what gives way, under the name GIVEN_WAY, in the place of their products with
        the functions of the pose."""
        if "compliance" not in self.blocks:
            return self
        blocks, sigma, start = {}, [], 0
        for name, part in self.blocks.items():
            each = self.sigma[:, part]
            if name == "compliance":
                name, each = GIVEN_WAY, each[:, ::FUNCTIONS]
            blocks[name] = slice(start, start + each.shape[-1])
            sigma.append(each)
            start += each.shape[-1]
        return ParameterLayout(blocks, torch.cat(sigma, dim=-1), self.origin)

    def step(self, delta: Float[Tensor, "b p"]) -> dict[str, Tensor]:
        """A parameter vector cut into blocks."""
        return {name: delta[:, part] for name, part in self.blocks.items()}

    def take(self, index: Tensor | slice) -> "ParameterLayout":
        return ParameterLayout(self.blocks, self.sigma[index], self.origin.take(index))

    def prior(self, state: State) -> tuple[Float[Tensor, "b p"], Float[Tensor, "b p"]]:
        """Deviation of the state from the priors' centre, and their weights 1/sigma^2.

        The stereo rotation's deviation is the vector of (R - R^T)/2, its sine: within 1e-5 of the angle up to half a
        degree.
        """
        zero, origin = torch.zeros_like(state.t), self.origin
        turned = origin.stereo_R.mT @ state.stereo_R
        (_, yx, zx), (xy, _, zy), (xz, yz, _) = (column.unbind(-1) for column in turned.unbind(-1))
        shifted = (origin.stereo_R.mT @ (state.stereo_t - origin.stereo_t)[..., None])[..., 0]
        deviation = {
            "rotation": zero,
            "translation": state.t,
            "stereo_rotation": 0.5 * torch.stack((zy - yz, xz - zx, yx - xy), dim=-1),
            "stereo_translation": shifted,
            "radius": (state.radius - origin.radius)[:, None],
            "end_offset": (state.end_offset - origin.end_offset)[:, None],
            "end_gap": (state.end_gap - origin.end_gap)[:, None],
            "rcm_offset": state.rcm_offset - origin.rcm_offset,
            "joint_offset": state.joint_offset - origin.joint_offset,
            "clock": (state.clock - origin.clock)[:, :1],
            "clock_rate": (state.clock - origin.clock)[:, 1:],
            "readout": (state.readout - origin.readout)[:, None],
            "edge_bias": (state.edge_bias - origin.edge_bias).flatten(1),
            "intrinsics": (state.intrinsics - origin.intrinsics).flatten(1),
            "setup": state.setup - origin.setup,
            "compliance": state.compliance - origin.compliance,
        }
        return torch.cat([deviation[name] for name in self.blocks], dim=-1), self.sigma.square().reciprocal()


@dataclass(frozen=True)
class NuisancePriors:
    """What a problem gives once a trial: the nominal values of the unknowns beside the transform, and their priors
    where the data name them.

    Attributes:
        stereo: `camera_T_camera_right` of the last camera.
        radius: mm; 0 where unknown.
        stereo_mm, stereo_rad: given noise of the stereo extrinsics; NaN where unknown.
        joint_offset_sigma: prior of each joint offset (no joints: none can be estimated).
        joint_offset_at, clock_at: where the kinematics were evaluated.
        readout: prior of the time from row to row; 0 where there is none.
        edge_bias: prior of the shift of each line row; 0 where there is none.
        intrinsics: prior of each camera's corrections; 0 where there is none.
        setup_at: where the kinematics were evaluated, from the stated set-up (from none: the identity); as
            `State.setup`.
        setup_mm, setup_rad: given sigmas of the stated set-up; NaN where unknown, 0 where it is exact.
        rcm_mm: given sigma of the shaft's offset from the RCM, likewise.
    """

    stereo: Float[Tensor, "b 4 4"]
    radius: Float[Tensor, " b"]
    stereo_mm: Float[Tensor, " b"]
    stereo_rad: Float[Tensor, " b"]
    joint_offset_sigma: Float[Tensor, "b j"]
    joint_offset_at: Float[Tensor, "b j"]
    clock_at: Float[Tensor, "b 2"]
    readout: Float[Tensor, " b"]
    edge_bias: Float[Tensor, "b l c"]
    intrinsics: Float[Tensor, "b c 4"]
    setup_at: Float[Tensor, "b 6"]
    setup_mm: Float[Tensor, " b"]
    setup_rad: Float[Tensor, " b"]
    rcm_mm: Float[Tensor, " b"]

    @classmethod
    def of(cls, problem: Problem) -> "NuisancePriors":
        """Of a problem with one trial axis."""
        level = problem.noise
        intrinsics = torch.stack((level.focal, level.centre, level.centre, level.lens), dim=-1)
        none, still = (problem.radius_mm.new_zeros(problem.n_trials, width) for width in (0, 2))
        sigma = none if problem.joint_offset_sigma is None else problem.joint_offset_sigma
        return cls(
            stereo=problem.camera_T_camera_right[:, -1],
            radius=torch.nan_to_num(problem.radius_mm),
            stereo_mm=problem.noise.stereo_mm,
            stereo_rad=problem.noise.stereo_rad,
            joint_offset_sigma=sigma,
            joint_offset_at=torch.zeros_like(sigma) if problem.joint_offset_at is None else problem.joint_offset_at,
            clock_at=still if problem.clock_at is None else problem.clock_at,
            readout=level.readout,
            edge_bias=problem.noise.edge_bias[:, None, None].expand(-1, line_points(problem), problem.n_cameras),
            intrinsics=intrinsics[:, None].expand(-1, problem.n_cameras, -1),
            setup_at=_setup_at(problem),
            setup_mm=level.setup_mm,
            setup_rad=level.setup_rad,
            rcm_mm=level.rcm_mm,
        )

    def repeat(self, part: slice, times: int) -> "NuisancePriors":
        """Of some trials, each repeated."""
        return NuisancePriors(**{name: value[part].repeat_interleave(times, 0) for name, value in vars(self).items()})


def _setup_at(problem: Problem) -> Float[Tensor, "b 6"]:
    """Where the kinematics were evaluated, from the stated set-up."""
    at, stated = problem.laparoscope_base_T_instrument_base, problem.setup_stated
    if at is None or stated is None:
        return problem.radius_mm.new_zeros(problem.n_trials, 6)
    known = torch.isfinite(stated).flatten(1).all(-1)[:, None, None]
    eye = torch.eye(4, dtype=at.dtype, device=at.device)
    return rigid_log(rigid_inverse(torch.where(known, stated, eye)) @ at)


def initial_state(nominal: NuisancePriors, R: Float[Tensor, "b 3 3"], t: Float[Tensor, "b 3"]) -> State:
    """The hand-eye transform with every other unknown at its nominal value."""
    zero = t[:, 0] * 0.0
    return State(
        R=R,
        t=t,
        stereo_R=nominal.stereo[:, :3, :3],
        stereo_t=nominal.stereo[:, :3, 3],
        radius=nominal.radius,
        end_offset=zero,
        end_gap=zero,
        rcm_offset=zero[:, None].expand(-1, 2),
        joint_offset=torch.zeros_like(nominal.joint_offset_at),
        clock=torch.zeros_like(nominal.clock_at),
        readout=zero,
        edge_bias=torch.zeros_like(nominal.edge_bias),
        intrinsics=torch.zeros_like(nominal.intrinsics),
        setup=torch.zeros_like(nominal.setup_at),
        compliance=zero[:, None].expand(-1, COUNT),
    )


def make_layout(
    nominal: NuisancePriors, measured: MeasurementRows, origin: State, settings: UnknownSettings, noise: NoiseSettings
) -> ParameterLayout:
    """The parameters that the settings ask for and the measurements can carry.

    Offsets of a state count from where the kinematics were evaluated, their priors from zero.
    """
    b, like = origin.t.shape[0], origin.t
    stereo_rad = torch.nan_to_num(nominal.stereo_rad, nan=noise.stereo_deg * torch.pi / 180.0)
    stereo_mm = torch.nan_to_num(nominal.stereo_mm, nan=noise.stereo_mm)
    infinite = torch.full_like(like[:, 0], torch.inf)
    far = torch.full_like(infinite, TRANSLATION_SIGMA_MM)
    entries: list[tuple[str, int, Tensor]] = [("rotation", 3, infinite), ("translation", 3, far)]
    if settings.stereo and measured.cameras == 2:
        entries += [("stereo_rotation", 3, stereo_rad), ("stereo_translation", 3, stereo_mm)]
    if settings.radius and measured.has_contours:
        entries.append(("radius", 1, settings.radius_sigma_relative * origin.radius))
    if settings.end_offset and measured.has_ends:
        entries.append(("end_offset", 1, torch.full_like(infinite, settings.end_offset_sigma_mm)))
    if measured.has_second_place:
        entries.append(("end_gap", 1, torch.full_like(infinite, settings.end_gap_sigma_mm)))
    if settings.rcm_offset == "always":
        # One that is stated to be none, and yet to be estimated, is one.
        rcm_mm = torch.where(nominal.rcm_mm > 0, nominal.rcm_mm, settings.rcm_offset_sigma_mm)
        entries.append(("rcm_offset", 2, rcm_mm))
    if settings.joint_offsets != "never" and measured.joint is not None and nominal.joint_offset_sigma.shape[1] > 0:
        entries.append(("joint_offset", measured.joint.shape[1], nominal.joint_offset_sigma))
    if settings.clock and measured.clock is not None:
        entries.append(("clock", 1, torch.full_like(infinite, settings.clock_sigma_s)))
        if settings.clock_rate == "always":
            entries.append(("clock_rate", 1, torch.full_like(infinite, settings.clock_rate_sigma)))
    if settings.readout == "always" and measured.clock is not None:
        entries.append(("readout", 1, nominal.readout))
    if settings.edge_bias:
        entries.append(("edge_bias", origin.edge_bias[0].numel(), nominal.edge_bias.flatten(1)))
    if settings.intrinsics:
        entries.append(("intrinsics", origin.intrinsics[0].numel(), nominal.intrinsics.flatten(1)))
    if settings.setup != "known" and measured.setup is not None:
        entries.append(("setup", 6, _setup_sigma(nominal, settings)))
    if settings.compliance == "always":
        turn, shift = math.radians(settings.compliance_sigma_deg), settings.compliance_sigma_mm
        each = like.new_tensor([size * prior for size in (*[turn] * TURNS, *[shift] * SHIFTS) for prior in PRIORS])
        entries.append(("compliance", COUNT, each.expand(b, -1)))
    entries = [entry for entry in entries if bool((entry[2] > 0).any())]
    blocks, sigmas, start = {}, [], 0
    for name, width, sigma in entries:
        blocks[name] = slice(start, start + width)
        sigmas.append(sigma if sigma.ndim == 2 else sigma[:, None].expand(b, width))
        start += width
    centre = replace(origin, joint_offset=-nominal.joint_offset_at, clock=-nominal.clock_at, setup=-nominal.setup_at)
    return ParameterLayout(blocks, torch.cat(sigmas, dim=-1).clamp_min(1e-12), centre)


def _setup_sigma(nominal: NuisancePriors, settings: UnknownSettings) -> Float[Tensor, "b 6"]:
    """Prior of the set-up: rotation, then translation."""
    if settings.setup == "free":
        rad, mm = torch.full_like(nominal.setup_rad, torch.inf), torch.full_like(nominal.setup_mm, TRANSLATION_SIGMA_MM)
    else:
        # One that is stated to be exact, and yet to be estimated, is none.
        rad = torch.where(nominal.setup_rad > 0, nominal.setup_rad, math.radians(settings.setup_sigma_deg))
        mm = torch.where(nominal.setup_mm > 0, nominal.setup_mm, settings.setup_sigma_mm)
    return torch.stack((rad, rad, rad, mm, mm, mm), dim=-1)
