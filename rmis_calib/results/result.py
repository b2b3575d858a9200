"""What a calibration answers: the transform with its uncertainty, what was used, and whether to trust it.

`CalibrationResult` is the Python object and, through `write` and `read`, the file `result.json` (format
`rmis-calib-result/1`). Unknown numbers are `None` in Python and null in the file, never NaN.
"""

import math
import platform
from dataclasses import field
from datetime import UTC, datetime
from functools import cache
from importlib import import_module, metadata
from pathlib import Path
from typing import Any, Literal

import numpy as np
from pydantic import TypeAdapter, ValidationError, computed_field
from pydantic.dataclasses import dataclass

from rmis_calib import __version__
from rmis_calib.errors import InputError
from rmis_calib.io.atomic import write_json
from rmis_calib.io.configs import load_json
from rmis_calib.io.outputs import RESULT_FORMAT
from rmis_calib.io.plain_values import FILE_PART, Covariance6, Number, Plain, Transform
from rmis_calib.io.validation import first_finding
from rmis_calib.results.checks import Consistency, PictureCheck, Tests
from rmis_calib.results.parts import (
    HeadPointError,
    Information,
    InstrumentBase,
    KinematicOffsets,
    Motions,
    Nuisance,
    Residual,
    Setup,
    ShaftEnds,
)
from rmis_calib.solver.observability import Observability
from rmis_calib.solver.settings import Method

Status = Literal["ok", "weak", "unobservable", "solver_failed", "insufficient_data"]

INSTRUMENT_BASE = "instrument_base"
"""The frame that takes the place of `arm` where the laparoscope stands still and nobody states the set-up."""

JOINT_OFFSET = "joint_offset "
"""How the name of a joint's offset among the nuisances begins; its column without the unit follows."""

INTRINSICS = {"focal": "relative", "centre_x": "focal lengths", "centre_y": "focal lengths", "lens": "k1"}
"""Corrections of a camera among the nuisances, `<name> <side>`, with units, in the order of `Camera.corrected`."""

_ANSWER = (
    *("format", "status", "message", "method", "camera_right_T_arm", "camera_left_T_arm"),
    *("camera_left_T_camera_right", "covariance", "rotation_sigma_deg", "translation_sigma_mm"),
)
"""Keys that come first in the file, in this order."""

STATUS_SENTENCES: dict[str, str] = {
    "ok": "The result passed its own checks",
    "weak": "The data constrain the transform too loosely to be trusted",
    "unobservable": "The data do not determine the transform",
    "solver_failed": "The solver did not reach a solution",
    "insufficient_data": "Too few motions with a usable shaft",
}


def package_versions() -> dict[str, str | None]:
    """Versions of this package, of Python and of the libraries that enter the numbers; None for one not installed."""
    names = ("torch", "kornia", "pytorch-kinematics", "opencv-python-headless", "numpy", "av")
    return {"rmis_calib": __version__, "python": platform.python_version()} | {name: _version(name) for name in names}


def _version(name: str) -> str | None:
    try:
        return metadata.version(name)
    except metadata.PackageNotFoundError:
        return None


def _now() -> str:
    return datetime.now(UTC).isoformat(timespec="seconds")


@dataclass(frozen=True, eq=False, config=FILE_PART)
class CalibrationResult:
    """The hand-eye transform, how sure it is, and what it rests on.

    `a_T_b` maps coordinates in frame b to coordinates in frame a. Millimetres, radians, pixels and seconds, where a key
    does not name another unit. A number that is not known is null.
    """

    status: Status
    """`ok` only for a result that passed its own checks."""
    message: str
    """One line: why the result is, or is not, to be trusted."""
    method: Method
    """Method of estimation."""
    camera_right_T_arm: Transform | None
    """Pose of the laparoscope arm's end-effector frame in the right camera, mm; null without a solution."""
    camera_left_T_camera_right: Transform | None
    """Stereo extrinsics as used, mm (refined where the method does); null for one camera."""
    covariance: Covariance6 | None
    """(6, 6) of `camera_right_T_arm`, rotation first: R = exp(dphi) R^ in `camera_right`, t = t^ + dt; rad and mm."""
    observability: Observability
    """Verdict, predicted error at the working point, and what the data cannot see, in words."""
    motions: Motions
    """Used and rejected motions."""
    residuals: dict[str, Residual] = field(default_factory=dict)
    """Residuals by kind of measurement and camera (`contour_right`, `end_left`, ...)."""
    nuisances: dict[str, Nuisance] = field(default_factory=dict)
    """Other unknowns and noise levels that were estimated with the transform, by name."""
    head_point_error_px: dict[str, HeadPointError] | None = None
    """By camera (`right`, `left`), px; null without labelled head points."""
    config: Plain = field(default_factory=dict)
    """The resolved configuration."""
    versions: dict[str, str | None] = field(default_factory=package_versions)
    """Versions of this package and of what it computes with."""
    notes: tuple[str, ...] = ()
    """What was guessed or mended while the input was read, a sentence each."""
    consistency: Consistency | None = None
    """Groups of neighbouring motions left out in turn, and parts of the data against each other; null for `paper` and
    `global`, and for few motions."""
    tests: Tests | None = None
    """Tests of what the model leaves in the residuals, and likely causes; absent for `paper` and `global`."""
    setup: Setup | None = None
    """The pose of one arm's base in the other's with the covariance of both transforms; absent where it was not
    estimated."""
    instrument_base: InstrumentBase | None = None
    """The pose of the instrument's base in the camera, where the laparoscope stood still and the set-up was believed;
    absent elsewhere."""
    ends: ShaftEnds | None = None
    """At which places of the instrument its shaft ends were measured; absent where none was, and for `paper` and
    `global`."""
    information: Information | None = None
    """What pooling with other recordings needs beside the covariance; null for `paper` and `global`."""
    picture: PictureCheck | None = None
    """Whether the pictures show the shaft where the answer predicts it; absent without pictures (`solve`) and without
    an answer."""
    created: str = field(default_factory=_now)
    """When the result was made, ISO 8601, UTC."""

    @computed_field
    @property
    def format(self) -> Literal["rmis-calib-result/1"]:
        """Name of this format."""
        return RESULT_FORMAT

    @property
    def trustworthy(self) -> bool:
        return self.status == "ok"

    @property
    def kinematic_offsets(self) -> KinematicOffsets:
        """The offsets among the nuisances: what a prediction must apply to the logged kinematics."""
        joints = {
            f"{name.removeprefix(JOINT_OFFSET)}_{entry.unit}": self.nuisance(name)
            for name, entry in self.nuisances.items()
            if name.startswith(JOINT_OFFSET)
        }
        rcm_mm = (self.nuisance("rcm_offset[0]"), self.nuisance("rcm_offset[1]"))
        setup = None if self.setup is None else self.setup.laparoscope_base_T_instrument_base
        found = self.camera_right_T_arm
        in_base = found is not None and found.src == INSTRUMENT_BASE
        clock_rate = self.nuisance("clock_rate")
        return KinematicOffsets(joints, self.nuisance("clock"), rcm_mm, setup, clock_rate, in_base)

    def nuisance(self, name: str, otherwise: float = 0.0) -> float:
        """Value of a nuisance in its unit; `otherwise` where it was not estimated."""
        value = self.nuisances[name].value if name in self.nuisances else None
        return otherwise if value is None else value

    def residual(self, kind: str, motion: int) -> float | None:
        """Residual of one motion in one kind of measurement and camera (`contour_right`); None where not measured."""
        value = float(self.residuals[kind].by_motion[motion]) if kind in self.residuals else math.nan
        return value if math.isfinite(value) else None

    def intrinsic_correction(self, side: str) -> tuple[float, float, float, float]:
        """What was found to be off in a camera (`right`, `left`), for `Camera.corrected`; zero where not estimated."""
        focal, x, y, lens = (self.nuisance(f"{name} {side}") for name in INTRINSICS)
        return focal, x, y, lens

    @computed_field
    @property
    def camera_left_T_arm(self) -> Transform | None:
        """The same frame in the left camera, mm; null without a solution, and for one camera."""
        if self.camera_right_T_arm is None or self.camera_left_T_camera_right is None:
            return None
        return self.camera_left_T_camera_right @ self.camera_right_T_arm

    @computed_field
    @property
    def rotation_sigma_deg(self) -> Number:
        """Root of the trace of the covariance's rotation block, degrees."""
        return None if self.covariance is None else math.degrees(math.sqrt(np.trace(self.covariance[:3, :3])))

    @computed_field
    @property
    def translation_sigma_mm(self) -> Number:
        """Root of the trace of the covariance's translation block, mm."""
        return None if self.covariance is None else math.sqrt(np.trace(self.covariance[3:, 3:]))

    def to_dict(self) -> dict[str, Any]:
        """The result as plain JSON values, every number finite or None; the answer first."""
        record = record_type().dump_python(self, mode="json", by_alias=True)
        for name in ("setup", "instrument_base", "tests", "picture", "ends"):  # as in results of before
            if record[name] is None:
                del record[name]
        return {key: record[key] for key in (*_ANSWER, *record)}

    def write(self, path: str | Path) -> None:
        """Write `result.json`, whole or not at all; an earlier result there is replaced.

        Raises:
            OutputError: another file is there, or it cannot be written.
        """
        write_json(Path(path), self.to_dict())

    def export(self, to: str, out: str | Path, **options: Any) -> Path:
        """Write the result as another program reads it: `rc.export` with its `options` (recording, settings, ...).

        Raises:
            CalibrationFailed, InputError, OutputError: as `rc.export`.
        """
        # By name: what results are made into lies above them, and they know nothing of it.
        return import_module("rmis_calib.exports").export(self, to, out, **options)

    @classmethod
    def read(cls, path: str | Path) -> "CalibrationResult":
        """Read a `result.json`.

        Raises:
            FileError: the file cannot be read.
            InputError: it is not a result of this format.
        """
        raw = load_json(path)
        if raw.get("format") != RESULT_FORMAT:
            raise InputError(where=str(path), expected=f"format {RESULT_FORMAT}", found=raw.get("format", "none"))
        return cls.from_dict(raw, where=str(path))

    @classmethod
    def from_dict(cls, raw: dict[str, Any], where: str = "result") -> "CalibrationResult":
        """Inverse of `to_dict`.

        Raises:
            InputError: a key is missing, or its value is none that it can have; `where` names the file.
        """
        try:
            result = record_type().validate_python(raw)
        except ValidationError as problem:
            raise first_finding(problem, cls, where, InputError) from None
        for key in ("versions", "created"):  # else filled in as for a result that is made now
            if key not in raw:
                raise InputError(where=f"{where}: {key}", expected="this key", found="nothing")
        return result


@cache
def record_type() -> TypeAdapter:
    """What reads and writes a result as plain values."""
    return TypeAdapter(CalibrationResult)
