"""The parts of a result. Each is what its key in result.json holds; an unknown number is None, in an array NaN."""

from collections import Counter
from typing import Annotated

import numpy as np
from jaxtyping import Float
from pydantic import Field, computed_field, model_serializer, model_validator
from pydantic.dataclasses import dataclass

from rmis_calib.io.plain_values import FILE_PART, Covariance6, Flags, Indices, Number, Square, Transform, Vector


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


@dataclass(frozen=True, config=FILE_PART)
class Shift:
    """Difference of two answers for `camera_right_T_arm`."""

    # Not docstrings, which the classes below would not inherit.
    rotation_deg: Annotated[Number, Field(description="Angle between the rotations, degrees.")]
    translation_mm: Annotated[Number, Field(description="Distance between the translations, mm, in `camera_right`.")]
    sigmas: Annotated[Number, Field(description="Length of the difference in its own sigmas, 6 degrees of freedom.")]


@dataclass(frozen=True, config=FILE_PART)
class GroupShift(Shift):
    """How the answer moves when a group of neighbouring motions is left out."""

    motions: int = Field(kw_only=True)
    """Number of motions of the group."""


@dataclass(frozen=True, config=FILE_PART)
class Change(Shift):
    """The clearest difference between what comes before and after one motion."""

    before_motion: int = Field(kw_only=True)
    """Index of the first motion after the change."""


@dataclass(frozen=True, config=FILE_PART)
class ClockJump:
    """The clearest jump of the clock between video and joints."""

    jump_s: Number
    """Size of the jump in seconds: joints are read so much later after it."""
    sigmas: Number
    """Size of the jump in its own sigmas."""
    before_motion: int
    """Index of the first motion after the jump."""


@dataclass(frozen=True, eq=False, config=FILE_PART)
class Consistency:
    """Whether parts of the data agree."""

    inflation: Number
    """Factor by which sigma grew because groups of neighbouring motions disagree; 1 where they agree."""
    group_by_motion: Indices
    """Number of each motion's group, (N,); -1 for one that was not used."""
    groups: tuple[GroupShift, ...]
    """How the answer moves without each group."""
    halves: Shift
    """Difference of the answers from two halves of the motions that are far from each other in joint space."""
    change: Change
    """The clearest difference between what comes before and after one motion."""
    clock_jump: ClockJump | None = None
    """The clearest jump of the clock; absent where the clock is no unknown."""

    @model_serializer(mode="wrap")
    def _without_absent(self, plain):
        return {key: value for key, value in plain(self).items() if key != "clock_jump" or value is not None}


@dataclass(frozen=True, config=FILE_PART)
class ResidualTest:
    """Whether residuals, or answers of parts of the data, hold what the model should have told."""

    kind: str
    """What is tested. In each camera (`_right`, `_left`): `shift` and `turn` of the shaft in the picture, `width`
    between its edges, their `taper`, its `end`, the head point (`head_u`, `head_v`); a measurement of your own by its
    name; the `answer` of parts of the data; the `clock`."""
    over: str
    """What it is tested over: its `mean`; the `time`, or a `time step` at one motion; where the camera sees the shaft
    (`u`, `v`, and `r2`, the square about the centre); a joint by its column; `neighbours in time` or `neighbours in
    joint space`; `halves` of the data."""
    statistic: Number
    """Standard normal where the model is right; of an answer its distance from that of the other part, in sigmas."""
    probability: Number
    """That some test of the whole list does as badly though the model is right (corrected for their number)."""
    failed: bool
    """Whether it takes the status `ok` away: where `probability` is below the level, but for tests of neighbours, whose
    common errors the sigmas count."""
    before_motion: int | None
    """Index of the first motion after the step; null for other tests."""
    words: str
    """What is left, in words."""


@dataclass(frozen=True, config=FILE_PART)
class Tests:
    """The tests of a result, those that fail first."""

    __test__ = False  # for pytest

    level: Number
    """Probability below which a test fails."""
    tests: tuple[ResidualTest, ...]
    """Each test, by its probability."""
    causes: tuple[str, ...]
    """What is likely to be wrong, the most likely first; none where every test passes."""

    @property
    def failed(self) -> tuple[ResidualTest, ...]:
        """Those that fail."""
        return tuple(test for test in self.tests if test.failed)


@dataclass(frozen=True, eq=False, config=FILE_PART)
class PictureView:
    """Edges that the pictures of one camera show along the predicted contours of the shaft, from the picture's border
    to the shaft's end; px of the undistorted picture."""

    motions: int
    """Number of motions whose pictures were looked at."""
    stations: int
    """Number of places along both contours, in all of them."""
    edge_share: float
    """Share of these places at which the picture shows an edge, from dark to light outwards, in line with the others of
    its contour."""
    median_px: Number
    """Median distance of the edges from the predicted contours, px, positive outwards."""
    spread_px: Number
    """Robust standard deviation of it, px."""
    right_px: Number
    """Median over the motions of how far the shaft lies to the right of its prediction, px, for someone who looks
    towards the tip."""
    outward_px: Number
    """Median over the motions of how far its contours lie outside of the predicted ones, px."""
    along_right_px: Vector
    """`right_px` in stretches of the shaft, from the border to its end, px."""
    along_outward_px: Vector
    """`outward_px` in the same stretches, px."""
    bend_px: Vector
    """What a straight line along the shaft leaves of `along_right_px`, motion by motion, px."""
    lens_k1: Number
    """Change of the lens's k1 that the bend of the contours asks for; null where they do not tell."""
    lens_k1_sigma: Number
    """1 sigma of it, from the scatter of the motions."""
    by_place_right_px: tuple[Vector, ...]
    """`right_px` in parts of the picture, px, rows from the top, columns from the left; null where no shaft is."""


@dataclass(frozen=True, eq=False, config=FILE_PART)
class PictureCheck:
    """Whether the pictures show the shaft where the answer predicts it."""

    passed: bool | None
    """Whether nothing speaks against it; null where it was not looked at."""
    sentences: tuple[str, ...]
    """What speaks against it, or why it was not looked at."""
    views: dict[str, PictureView]
    """What was found, by camera (`right`, `left`)."""


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
