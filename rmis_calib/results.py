"""What a calibration answers: the transform with its uncertainty, what was used, and whether to trust it.

`CalibrationResult` is the Python object and, through `write` and `read`, the file `result.json` (format
`rmis-calib-result/1`). Unknown numbers are `None` in Python and null in the file, never NaN.
"""

import math
import platform
from collections import Counter
from dataclasses import dataclass, field
from datetime import UTC, datetime
from importlib import import_module, metadata
from pathlib import Path
from typing import Any, Literal

import numpy as np

from rmis_calib import __version__
from rmis_calib.errors import InputError
from rmis_calib.geometry.rigid import RigidTransform
from rmis_calib.io.atomic import write_json
from rmis_calib.io.configs import load_json
from rmis_calib.io.outputs import RESULT_FORMAT

Status = Literal["ok", "weak", "unobservable", "solver_failed", "insufficient_data"]

JOINT_OFFSET = "joint_offset "
"""How the name of a joint's offset among the nuisances begins; its column without the unit follows."""

INTRINSICS = {"focal": "relative", "centre_x": "focal lengths", "centre_y": "focal lengths", "lens": "k1"}
"""Corrections of a camera among the nuisances, `<name> <side>`, with units, in the order of `Camera.corrected`."""

STATUS_SENTENCES: dict[str, str] = {
    "ok": "The result passed its own checks",
    "weak": "The data constrain the transform too loosely to be trusted",
    "unobservable": "The data cannot tell the transform",
    "solver_failed": "The solver did not reach a solution",
    "insufficient_data": "Too few motions with a usable shaft",
}


@dataclass(frozen=True)
class Motions:
    """Which motions carried the result.

    Attributes:
        used: (N,) whether the motion entered the estimate.
        reasons: (N,) why a motion did not enter; empty for a used one.
        timestamps_s: (N,) frame times, where known.
    """

    used: np.ndarray
    reasons: tuple[str, ...]
    timestamps_s: np.ndarray | None = None

    @property
    def rejected_by_reason(self) -> dict[str, int]:
        return dict(Counter(reason for reason, used in zip(self.reasons, self.used, strict=True) if not used))

    def to_dict(self) -> dict[str, Any]:
        return {
            "total": len(self.used),
            "used": int(self.used.sum()),
            "rejected": self.rejected_by_reason,
            "used_by_motion": self.used.tolist(),
            "reason_by_motion": list(self.reasons),
            "timestamps_s": None if self.timestamps_s is None else self.timestamps_s.tolist(),
        }

    @classmethod
    def from_dict(cls, raw: dict[str, Any]) -> "Motions":
        times = raw.get("timestamps_s")
        return cls(
            np.asarray(raw["used_by_motion"], dtype=bool),
            tuple(raw["reason_by_motion"]),
            None if times is None else np.asarray(times, dtype=float),
        )


@dataclass(frozen=True)
class KinematicOffsets:
    """What was found to be off in the logged kinematics; zero where it was not estimated.

    Attributes:
        joints: offset of each joint that has one, by its column (`<arm>.<joint>_rad` or `_mm`), added to its readings.
        clock_s: added to the times at which the joints are read, beside the recording's own offset.
        rcm_mm: of the shaft's axis from the nominal RCM, along two directions across it that are fixed to `rcm`.
    """

    joints: dict[str, float]
    clock_s: float
    rcm_mm: tuple[float, float]


@dataclass(frozen=True, eq=False)
class Information:
    """What a recording tells of the transform and of the unknowns that all recordings of a set-up share, for pooling.

    Attributes:
        shared_names: the unknowns beside the transform (`radius`, `stereo_rotation[0]`, ...), s of them.
        shared_prior_sigma: (s,) their priors, which `matrix` does not contain.
        matrix: (6 + s, 6 + s) inverse covariance: rotation and translation as in the result's covariance, then their
            deviations from the nominal values, in units as among the nuisances.
        vector: (6 + s,) `matrix` times the estimate of these that the data alone give, the transform at the result's.
    """

    shared_names: tuple[str, ...]
    shared_prior_sigma: np.ndarray
    matrix: np.ndarray
    vector: np.ndarray

    def transform_covariance(self) -> np.ndarray:
        """(6, 6) covariance of the transform that this and the priors give."""
        full = self.matrix.copy()
        full[np.diag_indices(len(full))] += np.concatenate([np.zeros(6), self.shared_prior_sigma**-2.0])
        root = np.diagonal(full) ** -0.5
        return (np.linalg.inv(full * root[:, None] * root) * root[:, None] * root)[:6, :6]

    def to_dict(self) -> dict[str, Any]:
        return {
            "shared_names": list(self.shared_names),
            "shared_prior_sigma": self.shared_prior_sigma.tolist(),
            "matrix": self.matrix.tolist(),
            "vector": self.vector.tolist(),
        }

    @classmethod
    def from_dict(cls, raw: dict[str, Any]) -> "Information":
        names = tuple(raw["shared_names"])
        size = 6 + len(names)
        sigma = np.asarray(raw["shared_prior_sigma"], dtype=float).reshape(len(names))
        matrix = np.asarray(raw["matrix"], dtype=float).reshape(size, size)
        return cls(names, sigma, matrix, np.asarray(raw["vector"], dtype=float).reshape(size))


@dataclass(frozen=True)
class CalibrationResult:
    """The hand-eye transform, how sure it is, and what it rests on.

    Attributes:
        status: "ok" only for a result that passed its own checks.
        message: one line: why it is, or is not, to be trusted.
        method: `paper`, `global` or `joint`.
        camera_right_T_arm: pose of the laparoscope arm's end-effector frame in the right camera, mm; None without a
            solution.
        camera_left_T_camera_right: stereo extrinsics as used (refined where the method does); None for one camera.
        covariance: (6, 6), rotation first: R = exp(dphi) R^ in the camera frame, t = t^ + dt; rad and mm.
        observability: verdict, predicted error at the working point, and what the data cannot see, in words.
        motions: used and rejected motions.
        residuals: per measurement kind `{unit, median, rms, by_motion}`; by_motion is (N,), None where not
            measured.
        nuisances: other unknowns and settings estimated with it: name -> `{value, sigma, unit}`.
        head_point_error_px: per camera `{median, rms, max, count}`, where head points are known.
        config: the resolved configuration.
        versions: of this package and of what it computes with.
        notes: what was guessed or mended while the input was read, a sentence each.
        consistency: whether parts of the data agree: groups of neighbouring motions left out in turn (`inflation` of
            sigma, `groups` with their shift of the answer), and two halves against each other; None for `paper` and
            `global`, and for few motions.
        information: what pooling with other recordings needs beside the covariance; None for `paper` and `global`.
    """

    status: Status
    message: str
    method: str
    camera_right_T_arm: RigidTransform | None
    camera_left_T_camera_right: RigidTransform | None
    covariance: np.ndarray | None
    observability: dict[str, Any]
    motions: Motions
    residuals: dict[str, dict[str, Any]] = field(default_factory=dict)
    nuisances: dict[str, dict[str, Any]] = field(default_factory=dict)
    head_point_error_px: dict[str, dict[str, Any]] | None = None
    config: dict[str, Any] = field(default_factory=dict)
    versions: dict[str, str | None] = field(default_factory=lambda: package_versions())
    notes: tuple[str, ...] = ()
    consistency: dict[str, Any] | None = None
    information: Information | None = None
    created: str = field(default_factory=lambda: datetime.now(UTC).isoformat(timespec="seconds"))

    @property
    def trustworthy(self) -> bool:
        return self.status == "ok"

    @property
    def kinematic_offsets(self) -> KinematicOffsets:
        """The offsets among the nuisances: what a prediction must apply to the logged kinematics."""

        def value(name: str) -> float:
            return float(self.nuisances.get(name, {"value": 0.0})["value"] or 0.0)

        joints = {
            f"{name.removeprefix(JOINT_OFFSET)}_{entry['unit']}": value(name)
            for name, entry in self.nuisances.items()
            if name.startswith(JOINT_OFFSET)
        }
        return KinematicOffsets(joints, value("clock"), (value("rcm_offset[0]"), value("rcm_offset[1]")))

    def intrinsic_correction(self, side: str) -> tuple[float, float, float, float]:
        """What was found to be off in a camera (`right`, `left`), for `Camera.corrected`; zero where not estimated."""
        entries = [self.nuisances.get(f"{name} {side}", {"value": 0.0}) for name in INTRINSICS]
        focal, x, y, lens = (float(entry["value"]) for entry in entries)
        return focal, x, y, lens

    @property
    def camera_left_T_arm(self) -> RigidTransform | None:
        """The same arm seen from the left camera."""
        if self.camera_right_T_arm is None or self.camera_left_T_camera_right is None:
            return None
        return self.camera_left_T_camera_right @ self.camera_right_T_arm

    @property
    def rotation_sigma_deg(self) -> float | None:
        """Root of the trace of the rotation block, degrees."""
        return None if self.covariance is None else math.degrees(math.sqrt(np.trace(self.covariance[:3, :3])))

    @property
    def translation_sigma_mm(self) -> float | None:
        """Root of the trace of the translation block, mm."""
        return None if self.covariance is None else math.sqrt(np.trace(self.covariance[3:, 3:]))

    def to_dict(self) -> dict[str, Any]:
        """The result as plain JSON values, every number finite or None."""
        record = {
            "format": RESULT_FORMAT,
            "status": self.status,
            "message": self.message,
            "method": self.method,
            "camera_right_T_arm": _transform_dict(self.camera_right_T_arm),
            "camera_left_T_arm": _transform_dict(self.camera_left_T_arm),
            "camera_left_T_camera_right": _transform_dict(self.camera_left_T_camera_right),
            "covariance": self.covariance,
            "rotation_sigma_deg": self.rotation_sigma_deg,
            "translation_sigma_mm": self.translation_sigma_mm,
            "observability": self.observability,
            "motions": self.motions.to_dict(),
            "residuals": self.residuals,
            "nuisances": self.nuisances,
            "head_point_error_px": self.head_point_error_px,
            "config": self.config,
            "versions": self.versions,
            "notes": list(self.notes),
            "consistency": self.consistency,
            "information": None if self.information is None else self.information.to_dict(),
            "created": self.created,
        }
        return finite_or_none(record)

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
        try:
            return cls.from_dict(raw)
        except (KeyError, TypeError, ValueError, AttributeError) as error:
            raise InputError(
                where=str(path), expected="every key of a result", found=f"a missing or odd one ({_key_of(error)})"
            ) from error

    @classmethod
    def from_dict(cls, raw: dict[str, Any]) -> "CalibrationResult":
        """Inverse of `to_dict`."""
        covariance = raw["covariance"]
        return cls(
            status=raw["status"],
            message=raw["message"],
            method=raw["method"],
            camera_right_T_arm=_transform(raw["camera_right_T_arm"]),
            camera_left_T_camera_right=_transform(raw["camera_left_T_camera_right"]),
            covariance=None if covariance is None else np.asarray(covariance, dtype=float),
            observability=raw["observability"],
            motions=Motions.from_dict(raw["motions"]),
            residuals=raw["residuals"],
            nuisances=raw["nuisances"],
            head_point_error_px=raw["head_point_error_px"],
            config=raw["config"],
            versions=raw["versions"],
            notes=tuple(raw.get("notes") or ()),
            consistency=raw.get("consistency"),
            information=None if raw.get("information") is None else Information.from_dict(raw["information"]),
            created=raw["created"],
        )


def _key_of(error: Exception) -> str:
    return str(error.args[0]) if isinstance(error, KeyError) else "of another type"


def _transform_dict(transform: RigidTransform | None) -> dict[str, Any] | None:
    return None if transform is None else transform.to_dict()


def _transform(raw: dict[str, Any] | None) -> RigidTransform | None:
    return None if raw is None else RigidTransform.from_dict(raw)


def finite_or_none(value: Any) -> Any:
    """Plain JSON values: arrays as lists, numbers that are not finite as None."""
    if isinstance(value, dict):
        return {str(key): finite_or_none(item) for key, item in value.items()}
    if isinstance(value, np.ndarray):
        return finite_or_none(value.tolist())
    if isinstance(value, (list, tuple)):
        return [finite_or_none(item) for item in value]
    if isinstance(value, np.generic):
        return finite_or_none(value.item())
    if isinstance(value, float) and not math.isfinite(value):
        return None
    if isinstance(value, Path):
        return str(value)
    return value


def package_versions() -> dict[str, str | None]:
    """Versions of this package, of Python and of the libraries that enter the numbers; None for one not installed."""
    names = ("torch", "kornia", "pytorch-kinematics", "opencv-python-headless", "numpy", "av")
    return {"rmis_calib": __version__, "python": platform.python_version()} | {name: _version(name) for name in names}


def _version(name: str) -> str | None:
    try:
        return metadata.version(name)
    except metadata.PackageNotFoundError:
        return None
