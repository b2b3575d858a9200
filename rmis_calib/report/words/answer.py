"""The answer in print: the transform in both directions, and how sure it is."""

import math
from dataclasses import dataclass

import numpy as np
from jaxtyping import Float

from rmis_calib.geometry.rigid import RigidTransform
from rmis_calib.report.words.formatting import UNKNOWN, finite, fixed, significant
from rmis_calib.results import CalibrationResult

AXES = ("x, right", "y, down", "z, forward")


@dataclass(frozen=True)
class Pose:
    """A rigid transform in print.

    Attributes:
        name: `dst_T_src`.
        dst: frame it maps to.
        src: frame it maps from.
        rows: 4 x 4 cells.
        quat_wxyz: four numbers.
        translation_mm: three numbers.
        code: the same at full precision, as Python.
    """

    name: str
    dst: str
    src: str
    rows: tuple[tuple[str, ...], ...]
    quat_wxyz: tuple[str, ...]
    translation_mm: tuple[str, ...]
    code: str


@dataclass(frozen=True)
class AxisRow:
    """Uncertainty along one axis of the camera: 1 sigma of rotation about it and of translation along it."""

    axis: str
    rotation_deg: str
    translation_mm: str


@dataclass(frozen=True)
class Uncertainty:
    """1 sigma of the transform: the roots of the traces, the working point, and each axis."""

    rotation_deg: str
    translation_mm: str
    working_point_mm: str
    axes: tuple[AxisRow, ...]


def pose(name: str, transform: RigidTransform | None) -> Pose | None:
    """A transform in print, or None where there is none."""
    if transform is None:
        return None
    record = transform.to_dict()
    matrix = np.asarray(record["matrix"], dtype=float).reshape(4, 4)
    rows = [(*(fixed(cell, 6) for cell in row[:3]), fixed(row[3], 3)) for row in matrix[:3]]
    quat = np.asarray(record["quat_wxyz"], dtype=float).reshape(4)
    translation = np.asarray(record["translation_mm"], dtype=float).reshape(3)
    return Pose(
        name=name,
        dst=str(record["dst"]),
        src=str(record["src"]),
        rows=(*rows, ("0", "0", "0", "1")),
        quat_wxyz=tuple(fixed(value, 6) for value in quat),
        translation_mm=tuple(fixed(value, 3) for value in translation),
        code=_code(name, str(record["src"]), str(record["dst"]), matrix, quat),
    )


def _code(name: str, src: str, dst: str, matrix: np.ndarray, quat: np.ndarray) -> str:
    rows = "\n".join("    [" + ", ".join(f"{cell: .9f}" for cell in row) + "]," for row in matrix)
    return (
        f"# maps coordinates in {src} to coordinates in {dst}; translation in mm\n"
        f"{name} = [\n{rows}\n]\n"
        f"quat_wxyz = [{', '.join(f'{value:.9f}' for value in quat)}]\n"
        f"translation_mm = [{', '.join(f'{value:.6f}' for value in matrix[:3, 3])}]"
    )


def uncertainty(result: CalibrationResult) -> Uncertainty:
    """The covariance in degrees and millimetres; "unknown" wherever it is absent or not a covariance."""
    covariance = np.full((6, 6), math.nan) if result.covariance is None else np.asarray(result.covariance, dtype=float)
    variances = np.diag(covariance)
    variances = np.where(variances >= 0.0, variances, np.nan)
    sigmas = np.sqrt(variances)
    degrees = np.degrees(sigmas[:3])
    return Uncertainty(
        rotation_deg=significant(math.sqrt(np.sum(degrees**2)), 2),
        translation_mm=significant(math.sqrt(np.sum(variances[3:])), 2),
        working_point_mm=significant(result.observability.working_point_sigma_mm, 2),
        axes=tuple(
            AxisRow(axis, significant(degrees[index], 2), significant(sigmas[3 + index], 2))
            for index, axis in enumerate(AXES)
        ),
    )


def back_sigma_mm(result: CalibrationResult) -> str:
    """1 sigma of the inverse's translation, root of the trace; "unknown" without a covariance."""
    if result.covariance is None or result.camera_right_T_arm is None:
        return UNKNOWN
    covariance = np.asarray(result.covariance, dtype=float)
    if not np.isfinite(covariance).all():
        return UNKNOWN
    trace = float(np.trace(inverse_covariance(result.camera_right_T_arm, covariance)[3:, 3:]))
    return significant(math.sqrt(trace) if trace >= 0.0 else None, 2)


def inverse_covariance(transform: RigidTransform, covariance: Float[np.ndarray, "6 6"]) -> Float[np.ndarray, "6 6"]:
    """Covariance of the inverse transform, perturbed as in results: R' = exp(dphi') R^', t' = t^' + dt'.

    With R = exp(dphi) R^ and t = t^ + dt the inverse is R' = R^^T exp(-dphi), t' = -R' (t^ + dt), so that to first
    order dphi' = -R^^T dphi and dt' = -R^^T (dt + t^ x dphi).
    """
    R = transform.matrix[:3, :3].cpu().numpy()
    x, y, z = transform.t.tolist()
    skew = np.array([[0.0, -z, y], [z, 0.0, -x], [-y, x, 0.0]])
    J = np.zeros((6, 6))
    J[:3, :3], J[3:, :3], J[3:, 3:] = -R.T, -R.T @ skew, -R.T
    return J @ covariance @ J.T


def covariance_text(covariance: np.ndarray | None) -> str:
    """The covariance as six aligned lines, empty where there is none."""
    if covariance is None:
        return ""
    return "\n".join("  ".join(_covariance_cell(cell) for cell in row) for row in covariance)


def _covariance_cell(value: object) -> str:
    number = finite(value)
    return f"{UNKNOWN:>10}" if number is None else f"{number: .3e}"
