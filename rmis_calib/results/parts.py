"""The parts of a result. Each is what its key in result.json holds; an unknown number is None, in an array NaN."""

from collections import Counter
from dataclasses import field
from typing import Annotated

import numpy as np
from jaxtyping import Float
from pydantic import Field, computed_field, model_serializer, model_validator
from pydantic.dataclasses import dataclass

from rmis_calib.io.plain_values import FILE_PART, Covariance6, Flags, Number, Square, Transform, Vector


@dataclass(frozen=True, eq=False, config=FILE_PART)
class Motions:
    """Which motions carried the result."""

    used: Annotated[Flags, Field(alias="used_by_motion")]
    """Whether each motion entered the estimate, (N,)."""
    reasons: Annotated[tuple[str, ...], Field(alias="reason_by_motion")]
    """Why each motion did not enter, N texts; empty for one that was used without reservation."""
    timestamps_s: Vector | None = None
    """Time of each motion's frame in seconds, (N,), null where unknown; null without frame times."""

    @computed_field
    @property
    def total(self) -> int:
        """Number of motions."""
        return len(self.used)

    @computed_field(alias="used")
    @property
    def used_count(self) -> int:
        """Number of motions that entered the estimate."""
        return int(self.used.sum())

    @computed_field(alias="rejected")
    @property
    def rejected_by_reason(self) -> dict[str, int]:
        """Number of motions that did not enter, by reason."""
        return dict(Counter(self.reasons[motion] for motion in np.flatnonzero(~self.used).tolist()))


@dataclass(frozen=True, eq=False, config=FILE_PART)
class Residual:
    """Residuals of one kind of measurement, in one camera."""

    unit: str
    """Unit of the numbers, `px` where there is a camera."""
    median: Number
    """Median over the used motions; null when none was measured."""
    rms: Number
    """Root mean square over the used motions; null when none was measured."""
    by_motion: Vector
    """Residual of each motion, (N,), null where not measured."""


@dataclass(frozen=True, config=FILE_PART)
class Nuisance:
    """An unknown or noise level that was estimated, or assumed, beside the transform."""

    value: Number
    """The estimate, in `unit`."""
    sigma: Number
    """1 sigma of it, in `unit`; null for a noise level."""
    unit: str
    """Unit of value and sigma."""
    held: bool | None = None
    """Whether the data could not tell it, so that its prior holds it; absent for a noise level."""

    @model_serializer(mode="wrap")
    def _without_absent(self, plain):
        return {key: value for key, value in plain(self).items() if key != "held" or value is not None}


@dataclass(frozen=True, config=FILE_PART)
class EndCounts:
    """Measured shaft ends of one kind, by the place of the instrument where they are."""

    first_place: int
    """Number at the place of most."""
    second_place: int
    """Number at the second place; 0 where there is one place only."""
    left_out: int
    """Number that is at neither and was not used."""


@dataclass(frozen=True, config=FILE_PART)
class ShaftEnds:
    """At which places of the instrument its shaft ends were measured, both cameras together."""

    by_kind: dict[str, EndCounts]
    """By what the detector took them for: `tube`, `ring`, or `unknown` where it does not say."""
    gap_mm: Number
    """How far beyond the first place the second one lies, mm; null where there is one place only."""
    gap_sigma_mm: Number
    """1 sigma of it, mm; null likewise."""
    not_measured: dict[str, int] = field(default_factory=dict)
    """Shafts that were taken but whose end was not measured, by what they end at in the picture: `border` (they leave
    it), `hidden` (something covers the end), or `unclear`. Only from `calibrate`."""

    @property
    def first_place(self) -> int:
        """Number of ends at the place of most."""
        return sum(counts.first_place for counts in self.by_kind.values())

    @property
    def second_place(self) -> int:
        """Number of ends at the second place."""
        return sum(counts.second_place for counts in self.by_kind.values())

    @property
    def used(self) -> int:
        """Number of ends that were used."""
        return self.first_place + self.second_place

    @property
    def left_out(self) -> int:
        """Number of ends that are at no such place."""
        return sum(counts.left_out for counts in self.by_kind.values())


@dataclass(frozen=True, config=FILE_PART)
class HeadPointError:
    """Distance of the labelled head points of one camera from where the result puts them."""

    median: Number
    """Median distance, px."""
    rms: Number
    """Root mean square distance, px."""
    max: Number
    """Largest distance, px."""
    count: int
    """Number of labelled head points."""


@dataclass(frozen=True, eq=False, config=FILE_PART)
class Information:
    """What a recording tells of the transform and of the unknowns that recordings of one set-up share, for pooling."""

    shared_names: tuple[str, ...]
    """The s unknowns beside the transform (`radius`, `stereo_rotation[0]`, ...)."""
    shared_prior_sigma: Vector
    """1 sigma of the prior of each, (s,), in units as among the nuisances; `matrix` does not contain the priors."""
    matrix: Square
    """(6 + s, 6 + s) inverse covariance: rotation (rad) and translation (mm) as in the result's covariance, then the
    unknowns' deviations from their nominal values, in units as among the nuisances."""
    vector: Vector
    """(6 + s,) `matrix` times the estimate of these that the data alone give, the transform at the result's."""

    @model_validator(mode="after")
    def _of_one_size(self) -> "Information":
        size = len(self.shared_names)
        shapes = (self.shared_prior_sigma.shape, self.matrix.shape, self.vector.shape)
        if shapes != ((size,), (6 + size, 6 + size), (6 + size,)):
            raise ValueError(f"a vector and a matrix of 6 and the {size} shared_names")
        return self

    def transform_covariance(self) -> np.ndarray:
        """(6, 6) covariance of the transform that this and the priors give."""
        full = self.matrix.copy()
        full[np.diag_indices(len(full))] += np.concatenate([np.zeros(6), self.shared_prior_sigma**-2.0])
        return covariance_of(full)[:6, :6]


def covariance_of(information: Float[np.ndarray, "n n"]) -> Float[np.ndarray, "n n"]:
    """Inverse of an information matrix, scaled to a unit diagonal: its units differ by many powers of ten."""
    root = np.diagonal(information) ** -0.5
    return np.linalg.inv(information * root[:, None] * root) * root[:, None] * root


@dataclass(frozen=True, eq=False, config=FILE_PART)
class Setup:
    """The pose of the instrument's base in the laparoscope's, where it was estimated."""

    laparoscope_base_T_instrument_base: Transform
    """The estimate, mm."""
    rotation_sigma_deg: Number
    """Root of the trace of its covariance's rotation block, degrees."""
    translation_sigma_mm: Number
    """Root of the trace of the translation block, mm."""
    from_stated_deg: Number
    """Angle from what `base_T_arm_base` states, degrees; null where nothing states it."""
    from_stated_mm: Number
    """Distance of the instrument's base from where it is stated, mm; null likewise."""
    covariance: Square
    """(12, 12) of `camera_right_T_arm`, then of this transform: each rotation first, R = exp(dphi) R^, t = t^ + dt; rad
    and mm."""


@dataclass(frozen=True, eq=False, config=FILE_PART)
class InstrumentBase:
    """Where the instrument's base is in the camera, where the laparoscope stood still: the data tell that whatever
    `base_T_arm_base` says, while `camera_right_T_arm` is only as right as that."""

    camera_right_T_instrument_base: Transform
    """The estimate, mm; it holds as long as the laparoscope stays there."""
    rotation_sigma_deg: Number
    """Root of the trace of its covariance's rotation block, degrees."""
    translation_sigma_mm: Number
    """Root of the trace of the translation block, mm."""
    covariance: Covariance6
    """(6, 6), rotation first, R = exp(dphi) R^, t = t^ + dt; rad and mm."""


@dataclass(frozen=True, config=FILE_PART)
class KinematicOffsets:
    """What was found to be off in the logged kinematics; zero where it was not estimated."""

    joints: dict[str, float]
    """Offset of each joint that has one, by its column (`<arm>.<joint>_rad` or `_mm`), added to its readings."""
    clock_s: float
    """Added to the times at which the joints are read, beside the recording's own offset."""
    rcm_mm: tuple[float, float]
    """Of the shaft's axis from the nominal RCM, along two directions across it that are fixed to `rcm`."""
    setup: Transform | None = None
    """`laparoscope_base_T_instrument_base`, mm; None where it was not estimated."""
    clock_rate: float = 0.0
    """Added to these times a second from the middle of the recording."""
    arm_is_instrument_base: bool = False
    """Whether the instrument's base takes the place of `arm`."""

    @property
    def clock(self) -> tuple[float, float]:
        """Offset, s, and rate of the clock."""
        return self.clock_s, self.clock_rate
