"""What a result says of its own checks: agreement of its parts, tests of its residuals, the pictures."""

from typing import Annotated

from pydantic import Field, model_serializer
from pydantic.dataclasses import dataclass

from rmis_calib.io.plain_values import FILE_PART, Indices, Number, Vector


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
