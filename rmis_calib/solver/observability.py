"""What the data can see of the transform, as numbers for every trial and in words for one.

Directions are ranked by what they do where the instrument works (assess/observability.py): the components of a
direction are (lever * rotation, displacement of the working point).
"""

from dataclasses import dataclass
from enum import IntFlag, StrEnum

import torch
from jaxtyping import Float, Int
from pydantic import model_serializer
from pydantic.dataclasses import dataclass as pydantic_dataclass
from torch import Tensor

from rmis_calib.io.plain_values import FILE_PART, Number

NEAR_AXIS_COS = 0.8
"""Cosine from which a direction is called by the name of an axis (37 degrees)."""


class Verdict(StrEnum):
    """Whether the predicted error at the working point is small enough to use the result."""

    TRUSTWORTHY = "trustworthy"
    WEAK = "weak"
    UNOBSERVABLE = "unobservable"

    @property
    def code(self) -> int:
        """What stands for it in tensors: the worse, the larger."""
        return list(Verdict).index(self)

    @classmethod
    def of(cls, code: Int[Tensor, ""]) -> "Verdict":
        """The verdict that a code in a tensor stands for."""
        return list(cls)[int(code)]


class Degeneracy(IntFlag):
    """Classical degenerate cases; `sentences` puts them into words."""

    NONE = 0
    STATIC_LAPAROSCOPE = 1
    NO_DEPTH_CUE = 2
    SINGLE_AXIS_MOTION = 4
    ONE_PLANE = 8
    MOTION_BELOW_NOISE = 16
    SHORT_BASELINE = 32
    NO_ALONG_AXIS_CUE = 64
    SETUP_AND_TRANSFORM = 128


_SENTENCES = {
    Degeneracy.STATIC_LAPAROSCOPE: "the laparoscope did not move",
    Degeneracy.NO_DEPTH_CUE: "no shaft radius is known",
    Degeneracy.SINGLE_AXIS_MOTION: "the shaft turned about a single axis only",
    Degeneracy.ONE_PLANE: "all positions of the shaft lie in one plane",
    Degeneracy.MOTION_BELOW_NOISE: "the motion is below the noise of the kinematics",
    Degeneracy.SHORT_BASELINE: "the stereo baseline is too short to determine depth",
    Degeneracy.NO_ALONG_AXIS_CUE: "nothing shows the position along the shaft",
    Degeneracy.SETUP_AND_TRANSFORM: (
        "the laparoscope did not turn about two axes, so its transform cannot be separated from the unknown set-up"
    ),
}


_REMEDIES = {
    Degeneracy.STATIC_LAPAROSCOPE: "move the laparoscope's arm as well, with its joints logged",
    Degeneracy.NO_DEPTH_CUE: "state the shaft's diameter, so that its width in the image gives its distance",
    Degeneracy.SINGLE_AXIS_MOTION: "turn the instrument about a second axis",
    Degeneracy.ONE_PLANE: "move the instrument out of the plane that it stayed in",
    Degeneracy.MOTION_BELOW_NOISE: "move farther: several degrees and centimetres",
    Degeneracy.SHORT_BASELINE: "use the shaft's diameter for the distance, as with one camera",
    Degeneracy.SETUP_AND_TRANSFORM: (
        "turn the laparoscope about two axes by 10 degrees each, or state where the arms' bases are (base_T_arm_base)"
    ),
    Degeneracy.NO_ALONG_AXIS_CUE: "keep the end of the dark shaft in view, or label head points",
}


@pydantic_dataclass(frozen=True, config=FILE_PART)
class Direction:
    """A principal direction of the transform's uncertainty."""

    sigma_at_working_point_mm: Number
    """1 sigma along it, mm at the working point; null where it is not bounded."""
    words: str
    """What it is: a rotation or a translation, and about or along what."""


@pydantic_dataclass(frozen=True, config=FILE_PART)
class NextMotion:
    """A further motion that is advised, and what it would gain together with those before it."""

    words: str
    """What to do."""
    joints: dict[str, float] | None
    """Readings to move to by column (`<arm>.<joint>_rad` or `_mm`); null where no joints are known."""
    weakest_sigma_mm: Number
    """Predicted 1 sigma of the weakest direction, mm at the working point."""
    working_point_sigma_mm: Number
    """Predicted error at the working point, mm, root of the trace."""


_ASSESSED = ("working_point_mm", "working_point_sigma_mm", "directions", "named_cases")
_ADVISED = ("advice", "next_motions")


@pydantic_dataclass(frozen=True, config=FILE_PART)
class Observability:
    """What the data can and cannot see of the transform. What was not assessed, or not advised, is absent in a file."""

    verdict: Verdict | None = None
    """Whether the predicted errors are small enough to use the result; null where they were not assessed."""
    sentences: tuple[str, ...] = ()
    """What the data can and cannot see, in words, most important first."""
    working_point_mm: tuple[Number, Number, Number] | None = None
    """Where the error counts: a point in `camera_right`, mm."""
    working_point_sigma_mm: Number = None
    """Predicted error there, mm: root of the trace of its covariance."""
    directions: tuple[Direction, ...] = ()
    """The principal directions of the uncertainty, worst first."""
    named_cases: tuple[str, ...] = ()
    """Names of the classical degenerate cases that were recognised."""
    advice: tuple[str, ...] = ()
    """What to record next, in words; absent where none is wanted or none can be predicted."""
    next_motions: tuple[NextMotion, ...] = ()
    """The same as values, in their order."""

    @model_serializer(mode="wrap")
    def _without_absent(self, plain):
        record = plain(self)
        for keys in (_ASSESSED, _ADVISED):
            if not any(record[key] for key in keys):
                record = {key: value for key, value in record.items() if key not in keys}
        return record


@dataclass(frozen=True)
class ObservabilityTensors:
    """Observability of every trial, as tensors.

    Attributes:
        working_point_mm: where the error counts, in `camera_right`.
        working_point_sigma_mm: predicted error there, root of the trace.
        rotation_sigma_deg: predicted rotation error, root of the trace.
        sigma_mm: 1 sigma along the principal directions, worst first.
        directions: principal directions of (lever * dphi, displacement of the working point).
        verdict: codes of `Verdict`.
        degeneracy: flags (`Degeneracy`).
        shaft_direction: mean direction of the shaft, in `camera_right`.
    """

    working_point_mm: Float[Tensor, "b 3"]
    working_point_sigma_mm: Float[Tensor, " b"]
    rotation_sigma_deg: Float[Tensor, " b"]
    sigma_mm: Float[Tensor, "b 6"]
    directions: Float[Tensor, "b 6 6"]
    verdict: Int[Tensor, " b"]
    degeneracy: Int[Tensor, " b"]
    shaft_direction: Float[Tensor, "b 3"]

    def remedies(self, trial: int = 0) -> tuple[str, ...]:
        """What would end each degenerate case that was recognised in one trial, in words."""
        return tuple(_REMEDIES[flag] for flag in Degeneracy if flag and int(self.degeneracy[trial]) & flag)

    def describe(self, trial: int = 0) -> Observability:
        """One trial in words."""
        names = [_direction_name(d, self.shaft_direction[trial]) for d in self.directions[trial]]
        verdict = Verdict.of(self.verdict[trial])
        flags = [flag for flag in Degeneracy if flag and int(self.degeneracy[trial]) & flag]
        reasons = [_SENTENCES[flag] for flag in flags]
        at_point, rotation = float(self.working_point_sigma_mm[trial]), float(self.rotation_sigma_deg[trial])
        if verdict is Verdict.TRUSTWORTHY:
            sentence = f"predicted error {at_point:.2f} mm at the working point, {rotation:.2f} deg"
        else:
            word = "is not observable" if verdict is Verdict.UNOBSERVABLE else "is only weakly observable"
            size = f"{min(at_point, 9999.0):.1f} mm at the working point, {min(rotation, 180.0):.1f} deg"
            sentence = f"{names[0]} {word} (predicted error {size})"
            sentence += f": {_joined(reasons)}" if reasons else ""
        x, y, z = self.working_point_mm[trial].tolist()
        return Observability(
            verdict=verdict,
            sentences=(sentence,),
            working_point_mm=(x, y, z),
            working_point_sigma_mm=at_point,
            directions=tuple(map(Direction, self.sigma_mm[trial].tolist(), names)),
            named_cases=tuple(flag.name or "" for flag in flags),
        )


def _joined(parts: list[str]) -> str:
    return parts[0] if len(parts) == 1 else ", ".join(parts[:-1]) + " and " + parts[-1]


def _direction_name(direction: Float[Tensor, "6"], shaft: Float[Tensor, "3"]) -> str:
    """A principal direction in plain words."""
    turn, shift = direction[:3], direction[3:]
    rotating = float(turn.norm()) > float(shift.norm())
    axis = (turn if rotating else shift) / max(float((turn if rotating else shift).norm()), 1e-12)
    eye = torch.eye(3, dtype=axis.dtype, device=axis.device)
    named = {
        "the viewing direction": eye[2],
        "the shaft": shaft,
        "the picture's horizontal": eye[0],
        "the picture's vertical": eye[1],
    }
    cosines = {name: abs(float(axis @ other)) for name, other in named.items()}
    best = max(cosines, key=lambda name: cosines[name])
    if cosines[best] < NEAR_AXIS_COS:
        x, y, z = (float(value) for value in axis)
        best = f"the direction ({x:+.2f}, {y:+.2f}, {z:+.2f})"
    return f"{'rotation about' if rotating else 'translation along'} {best}"
