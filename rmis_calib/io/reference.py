"""A transform to start from or to compare with, and its uncertainty: from a YAML file, or from another result."""

import math
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import torch

from rmis_calib.errors import InputError
from rmis_calib.geometry.rigid import RigidTransform
from rmis_calib.io._checks import no_note, rigid_from_text
from rmis_calib.io.configs import load_json, load_yaml


@dataclass(frozen=True)
class Reference:
    """A transform to compare with.

    Attributes:
        camera_right_T_arm: the transform.
        covariance: (6, 6) as in a result; None for one that counts as exact.
    """

    camera_right_T_arm: RigidTransform
    covariance: np.ndarray | None = None


def read_reference(path: Path) -> Reference:
    """A reference from a YAML file (`camera_right_T_arm`, 4x4 rows, mm) or from a result.json.

    Its uncertainty, where it has any: `covariance` (6x6 rows, rotation first, rad and mm: R = exp(dphi) R^ in the
    camera frame, t = t^ + dt), or `sigma_deg` and `sigma_mm`, 1 sigma of each axis.

    Raises:
        FileError: the file cannot be read.
        InputError: it holds no such transform, or an uncertainty that cannot be one.
    """
    raw = (load_json if path.suffix.lower() == ".json" else load_yaml)(path, InputError)
    if "camera_right_T_arm" not in raw:
        raise InputError(where=str(path), expected="a key camera_right_T_arm", found=", ".join(raw))
    rows = raw["camera_right_T_arm"]
    where = f"{path}: camera_right_T_arm"
    numbers = _numbers(rows["matrix"] if isinstance(rows, dict) and "matrix" in rows else rows, (4, 4), where)
    matrix = rigid_from_text(numbers.tolist(), where, InputError, no_note)
    transform = RigidTransform("camera_right", "arm", torch.from_numpy(matrix))
    return Reference(transform, _reference_covariance(raw, path))


def _reference_covariance(raw: dict[str, Any], path: Path) -> np.ndarray | None:
    if raw.get("covariance") is not None:
        C = _numbers(raw["covariance"], (6, 6), f"{path}: covariance")
        scale = np.sqrt(np.abs(np.diag(C)).clip(1e-300))
        unit = C / np.outer(scale, scale)
        if np.abs(unit - unit.T).max() > 1e-6 or np.linalg.eigvalsh(0.5 * (unit + unit.T)).min() < -1e-9:
            expected = "a symmetric matrix without a negative eigenvalue"
            raise InputError(where=f"{path}: covariance", expected=expected, found="another one")
        return 0.5 * (C + C.T)
    stated = {key: raw[key] for key in ("sigma_deg", "sigma_mm") if raw.get(key) is not None}
    if not stated:
        return None
    if len(stated) == 1:
        raise InputError(
            where=str(path), expected="sigma_deg and sigma_mm together", found=f"only {next(iter(stated))}"
        )
    for key, value in stated.items():
        if isinstance(value, bool) or not isinstance(value, int | float) or not 0 < value < math.inf:
            raise InputError(where=f"{path}: {key}", expected="a positive number", found=repr(value))
    turn, shift = math.radians(stated["sigma_deg"]), float(stated["sigma_mm"])
    return np.diag([turn**2] * 3 + [shift**2] * 3)


def _numbers(value: Any, shape: tuple[int, int], where: str) -> np.ndarray:
    try:
        array = np.array(value, dtype=np.float64)
    except (TypeError, ValueError):
        array = np.empty(0)
    if array.shape != shape or not np.isfinite(array).all():
        raise InputError(where=where, expected=f"{shape[0]}x{shape[1]} rows of finite numbers", found="something else")
    return array
