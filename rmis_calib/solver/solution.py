"""What a solve returns: the estimate, its uncertainty, a status with a sentence, and what the data cannot see."""

from dataclasses import dataclass, field, fields, is_dataclass, replace
from typing import Any

import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor

from rmis_calib.solver.model.motion_covariance import NoiseModel
from rmis_calib.solver.model.parameters import ParameterLayout
from rmis_calib.solver.model.state import State
from rmis_calib.solver.observability import ObservabilityTensors, Verdict
from rmis_calib.solver.settings import Method
from rmis_calib.solver.status import SolveStatus
from rmis_calib.solver.tensors import map_tensors
from rmis_calib.solver.test_list import TestList


@dataclass(frozen=True)
class Nuisance:
    """An unknown that was estimated beside the transform: value, 1 sigma, unit, whether the data could not tell it
    (held), how many sigmas of its prior it was pulled from its nominal value, and the projection onto its combinations
    that the data do not see, in units of the priors."""

    value: Float[Tensor, "*batch k"]
    sigma: Float[Tensor, "*batch k"]
    unit: str
    held: Bool[Tensor, "*batch k"]
    pull: Float[Tensor, "*batch k"]
    unseen: Float[Tensor, "*batch k k"]


@dataclass(frozen=True)
class SetupEstimate:
    """The set-up, where it was an unknown.

    Attributes:
        laparoscope_base_T_instrument_base: the estimate; mm.
        covariance: of both transforms together: `camera_right_T_arm` first, then the set-up; each rotation first, with
            R = exp(dphi) R^ and t = t^ + dt; rad and mm.
        from_stated: rotation vector and translation from the stated set-up, in `instrument_base`; rad and mm; NaN
            where none was stated.
    """

    laparoscope_base_T_instrument_base: Float[Tensor, "*batch 4 4"]
    covariance: Float[Tensor, "*batch 12 12"]
    from_stated: Float[Tensor, "*batch 6"]


@dataclass(frozen=True)
class InstrumentBase:
    """The pose of the instrument's base in the camera, where a laparoscope stands still, with its covariance as that of
    `camera_right_T_arm`: the data tell it whatever the set-up is."""

    camera_right_T_instrument_base: Float[Tensor, "*batch 4 4"]
    covariance: Float[Tensor, "*batch 6 6"]


@dataclass(frozen=True)
class AlternativeModel:
    """The answer of another model of the same data, and the probability that it is that model which is right."""

    camera_right_T_arm: Float[Tensor, "*batch 4 4"]
    covariance: Float[Tensor, "*batch 6 6"]
    probability: Float[Tensor, "*batch"]


@dataclass(frozen=True)
class Posterior:
    """The estimate of every unknown and what is known about it, flat over trials: what further motions add to.

    Attributes:
        state: the estimate.
        layout: the unknowns, with their priors.
        noise: variances, as large as the residuals say.
        information: inverse covariance of the unknowns, priors included.
    """

    state: State
    layout: ParameterLayout
    noise: NoiseModel
    information: Float[Tensor, "b p p"]


@dataclass(frozen=True)
class GroupCheck:
    """How the answer depends on groups of neighbouring motions, per trial.

    Attributes:
        group: number of each motion's group; -1 for motions that were not used. All -1: too few for groups.
        count: number of groups.
        shift: of the transform when a group is left out, [rotation vector, translation], rad and mm.
        sigmas: length of each shift in the sigmas that noise alone would give it; 6 degrees of freedom.
        growth: factor on the variances of the transform, 1 or more, by direction: covariance -> T covariance T^T.
        inflation: root of the mean factor on the variance.
        first_half: whether each group is in the first of two halves, on either side of where motions spread most.
        halves: difference of the answers of these halves.
        halves_sigmas: the same in their grown sigmas; 6 degrees of freedom.
        change: the clearest difference between what comes before and after some motion; change_sigmas: in sigmas;
            change_at: that motion, the first of a block.
    """

    group: Int[Tensor, "b n"]
    count: int
    shift: Float[Tensor, "b k 6"]
    sigmas: Float[Tensor, "b k"]
    growth: Float[Tensor, "b 6 6"]
    inflation: Float[Tensor, " b"]
    first_half: Bool[Tensor, "b k"]
    halves: Float[Tensor, "b 6"]
    halves_sigmas: Float[Tensor, " b"]
    change: Float[Tensor, "b 6"]
    change_sigmas: Float[Tensor, " b"]
    change_at: Int[Tensor, " b"]

    @classmethod
    def none(cls, motions: int, like: Float[Tensor, "b 3"]) -> "GroupCheck":
        """Where motions are too few for groups."""
        b, zero = len(like), torch.zeros_like(like[:, 0])
        return cls(
            group=torch.full((b, motions), -1, dtype=torch.int64, device=like.device),
            count=0,
            shift=like.new_zeros(b, 0, 6),
            sigmas=like.new_zeros(b, 0),
            growth=torch.eye(6, dtype=like.dtype, device=like.device).expand(b, 6, 6),
            inflation=torch.ones_like(zero),
            first_half=torch.zeros(b, 0, dtype=torch.bool, device=like.device),
            halves=like.new_zeros(b, 6),
            halves_sigmas=zero,
            change=like.new_zeros(b, 6),
            change_sigmas=zero,
            change_at=torch.zeros_like(zero, dtype=torch.int64),
        )

    def grown(self, covariance: Float[Tensor, "b 6 6"]) -> Float[Tensor, "b 6 6"]:
        """The covariance that says how far parts of the data are apart."""
        return self.growth @ covariance @ self.growth.mT


@dataclass(frozen=True)
class ClockJump:
    """The clearest step of the clock's offset in time, flat over trials.

    Attributes:
        jump_s: added to the times at which the joints are read, from the motion `at` on.
        sigmas: the same in its own sigmas.
        at: number of the first motion after it.
    """

    jump_s: Float[Tensor, " b"]
    sigmas: Float[Tensor, " b"]
    at: Int[Tensor, " b"]


@dataclass(frozen=True)
class Solution:
    """Estimates for every trial of the batch.

    Attributes:
        method: `paper`, `global` or `joint`.
        camera_right_T_arm: the estimate; translation in mm.
        camera_left_T_camera_right: as used, refined or not; None with one camera.
        covariance: rotation first; R = exp(dphi) R^ in `camera_right`, t = t^ + dt; rad and mm.
        status: `SolveStatus` codes.
        cheirality: part of the measured lines that lie in front of their camera with the tip on the imaged side.
        iterations: accepted steps.
        chi2_per_dof: weighted squared residuals over degrees of freedom; about 1 when the noise levels are right. NaN
            where unknown.
        residual_lines, residual_ends, residual_heads: rms per camera and motion, normalised units; NaN where not
            measured.
        residual_own: the same of the user's own measurements, by name, in their unit.
        ends: number of measured shaft ends, [kind, place]: of unknown kind, the tube's, a ring's; at the place of most,
            at the second one, left out as they are at neither. None for `paper` and `global`.
        distance: Mahalanobis distance of each motion over the root of its rows; NaN where not measured.
        reason: `MotionReason` codes.
        noise: levels that were used, name -> value (`image`, `ends`, `heads` as factors on the nominal ones).
        nuisances: by name.
        bias: correction that was subtracted from (rotation, translation); zero when none.
        observability: what the data can see, flat over trials; its `describe(trial)` puts one trial into words.
        posterior: what further motions would add to (assess/information.py); None for methods that estimate no noise.
        groups: what leaving out groups of neighbouring motions says, flat over trials; None for `paper` and `global`.
        clock_jump: the clearest jump of the clock, flat over trials; None where the clock is no unknown.
        tests: all tests of residuals and answers, flat over trials; None for `paper` and `global`.
        causes: what each usual cause of failed tests would lower chi^2 by, less the price of its unknowns
            (assess/causes.py), flat over trials; empty where all pass.
        history: cost of accepted iterates of the refinement.
        frame: what `arm` is: `arm`, the laparoscope's; or `instrument_base` where the set-up is unknown and the
            laparoscope stands still: the pose of the instrument's base in the camera is then all there is to know.
        setup: the pose of one arm's base in the other's and the joint covariance, where it was estimated.
        instrument_base: what the data tell of a laparoscope that stands still, where the set-up is believed.
        evidence: chance of what the data say if an unknown that was left out were nominal, by name
            (assess/evidence.py); of the first solve.
        doubt: what the covariance allows for, by name, as an unknown that was left out may not be nominal; of the last
            solve.
        information_kept: part of the information (per parameter, geometric mean) that thinning kept; 1 without.
    """

    method: Method
    camera_right_T_arm: Float[Tensor, "*batch 4 4"]
    camera_left_T_camera_right: Float[Tensor, "*batch 4 4"] | None
    covariance: Float[Tensor, "*batch 6 6"]
    status: Int[Tensor, "*batch"]
    cheirality: Float[Tensor, "*batch"]
    iterations: Int[Tensor, "*batch"]
    chi2_per_dof: Float[Tensor, "*batch"]
    residual_lines: Float[Tensor, "*batch c n"]
    residual_ends: Float[Tensor, "*batch c n"]
    residual_heads: Float[Tensor, "*batch c n"]
    distance: Float[Tensor, "*batch n"]
    reason: Int[Tensor, "*batch n"]
    noise: dict[str, Float[Tensor, "*batch"]]
    nuisances: dict[str, Nuisance]
    bias: Float[Tensor, "*batch 6"]
    observability: ObservabilityTensors
    residual_own: dict[str, Float[Tensor, "*batch n"]] = field(default_factory=dict)
    ends: Int[Tensor, "*batch 3 3"] | None = None
    posterior: Posterior | None = None
    groups: GroupCheck | None = None
    clock_jump: ClockJump | None = None
    tests: TestList | None = None
    causes: dict[str, Float[Tensor, " b"]] = field(default_factory=dict)
    history: tuple[Float[Tensor, "..."], ...] = ()
    frame: str = "arm"
    setup: SetupEstimate | None = None
    instrument_base: InstrumentBase | None = None
    evidence: dict[str, Float[Tensor, "*batch"]] = field(default_factory=dict)
    doubt: dict[str, Float[Tensor, "*batch 6 6"]] = field(default_factory=dict)
    information_kept: float = 1.0

    @property
    def ends_elsewhere(self) -> Int[Tensor, "*batch"] | None:
        """Number of measured shaft ends that were left out as they are at no place that many share."""
        return None if self.ends is None else self.ends[..., 2].sum(-1)

    @property
    def rotation_sigma_deg(self) -> Float[Tensor, "*batch"]:
        """Root of the trace of the rotation block."""
        return torch.rad2deg(self.covariance[..., :3, :3].diagonal(dim1=-2, dim2=-1).sum(-1).sqrt())

    @property
    def translation_sigma_mm(self) -> Float[Tensor, "*batch"]:
        """Root of the trace of the translation block."""
        return self.covariance[..., 3:, 3:].diagonal(dim1=-2, dim2=-1).sum(-1).sqrt()

    @property
    def verdict(self) -> Int[Tensor, "*batch"]:
        """Codes of `Verdict`; a solve that did not converge is never better than unobservable."""
        verdict = self.observability.verdict.view_as(self.status)
        if self.tests is not None:
            failed = self.tests.against.any(-1).view_as(verdict)
            verdict = torch.where(failed, verdict.clamp_min(Verdict.WEAK.code), verdict)
        return torch.where(self.converged, verdict, Verdict.UNOBSERVABLE.code)

    @property
    def converged(self) -> Bool[Tensor, "*batch"]:
        return self.status == SolveStatus.CONVERGED


def take_solved(solution: Solution, index: Int[Tensor, " k"]) -> Solution:
    """The trials `index` of the only batch axis, in this order; without the history, which all trials share."""
    return map_tensors(replace(solution, history=()), lambda x: x[index])


def concatenate(groups: list[Solution]) -> Solution:
    """The solution of all trials from those of groups of them.

    An unknown that a group does not have is NaN there, and held; the posterior is None where unknowns differ.
    """
    names = dict.fromkeys(name for group in groups for name in group.nuisances)
    nuisances = {name: _joined([_nuisance(name, group, groups) for group in groups]) for name in names}
    setups = [group.setup for group in groups]
    if any(setup is not None for setup in setups):
        setups = [_no_setup(group) if group.setup is None else group.setup for group in groups]
    evidence = {
        name: torch.cat([group.evidence.get(name, torch.full_like(group.cheirality, torch.nan)) for group in groups])
        for name in dict.fromkeys(name for group in groups for name in group.evidence)
    }
    causes = {
        name: torch.cat([group.causes.get(name, torch.full_like(group.cheirality, torch.nan)) for group in groups])
        for name in dict.fromkeys(name for group in groups for name in group.causes)
    }
    doubt = {
        name: torch.cat([group.doubt.get(name, torch.zeros_like(group.covariance)) for group in groups])
        for name in dict.fromkeys(name for group in groups for name in group.doubt)
    }
    tests = dict.fromkeys(name for group in groups if group.tests is not None for name in group.tests.names)
    same = all(group.nuisances.keys() == names.keys() and group.posterior is not None for group in groups)
    still = all(group.instrument_base is not None for group in groups)
    parts = [
        replace(
            group,
            nuisances={},
            evidence={},
            doubt={},
            causes={},
            tests=None if group.tests is None else group.tests.among(tuple(tests)),
            setup=setup,
            posterior=group.posterior if same else None,
            instrument_base=group.instrument_base if still else None,
        )
        for group, setup in zip(groups, setups, strict=True)
    ]
    return replace(_joined(parts), nuisances=nuisances, evidence=evidence, doubt=doubt, causes=causes)


def _no_setup(group: Solution) -> SetupEstimate:
    """NaN for every trial of a group that has no set-up among its unknowns."""
    like = group.camera_right_T_arm
    covariance = like.new_full((len(like), 12, 12), torch.nan)
    return SetupEstimate(torch.full_like(like, torch.nan), covariance, covariance[:, 0, :6].clone())


def _joined(parts: list[Any]) -> Any:
    """Tensors concatenated along the trials, wherever they are; everything else as in the first part."""
    first = parts[0]
    if isinstance(first, Tensor):
        return torch.cat(parts)
    if isinstance(first, dict):
        return {key: _joined([part[key] for part in parts]) for key in first}
    if is_dataclass(first) and not isinstance(first, type):
        names = [field.name for field in fields(first)]
        return replace(first, **{name: _joined([getattr(part, name) for part in parts]) for name in names})
    return first


def _nuisance(name: str, group: Solution, groups: list[Solution]) -> Nuisance:
    """An unknown of a group; all NaN where only other groups have it."""
    if name in group.nuisances:
        return group.nuisances[name]
    other = next(each.nuisances[name] for each in groups if name in each.nuisances)
    empty = other.value.new_full((len(group.status), other.value.shape[-1]), torch.nan)
    none_seen = torch.eye(empty.shape[-1], dtype=empty.dtype, device=empty.device).repeat(len(empty), 1, 1)
    return Nuisance(empty, empty, other.unit, torch.ones_like(empty, dtype=torch.bool), empty, none_seen)
