"""What the summary of a batch shows of one recording: a row of plain values."""

import json
from dataclasses import asdict
from typing import TYPE_CHECKING, Any

from rmis_calib.results import Nuisance

if TYPE_CHECKING:
    from rmis_calib.io import RecordingDescription
    from rmis_calib.pipeline import CalibrationRun
    from rmis_calib.results import CalibrationResult


def row_of_run(run: "CalibrationRun", description: "RecordingDescription") -> dict[str, Any]:
    """What the summary shows of a calibration."""
    row = row_of_result(run.result)
    row |= {"frames": sum(view.source.count for view in run.views), "setup": setup_of(description)}
    for view in run.views:
        row[f"found_{view.side}"] = int(view.found.sum())
    return row


def row_of_result(result: "CalibrationResult") -> dict[str, Any]:
    """What the summary shows of a result: plain values, lengths in mm, angles in degrees."""
    clock = result.nuisances.get("clock", Nuisance(value=None, sigma=None, unit="s"))
    row: dict[str, Any] = {
        "status": result.status,
        "method": result.method,
        "rotation_sigma_deg": result.rotation_sigma_deg,
        "translation_sigma_mm": result.translation_sigma_mm,
        "working_point_sigma_mm": result.observability.working_point_sigma_mm,
        "motions": len(result.motions.used),
        "motions_used": int(result.motions.used.sum()),
        "clock_s": None if clock.value is None else round(clock.value, 9),  # rounding is no offset
        "clock_sigma_s": clock.sigma,
        "notes": list(result.notes),
    }
    for name, residual in result.residuals.items():
        row[f"residual_{name}_{residual.unit.replace(' ', '_')}"] = residual.median
    for side, error in (result.head_point_error_px or {}).items():
        row[f"head_point_{side}_px"] = error.median
    return row


def setup_of(description: "RecordingDescription") -> str:
    """Name of a robot with its cameras, arms and shaft: recordings of one set-up have one hand-eye transform, and
    share the deviation of the shaft's radius from the one that was told."""
    import hashlib

    robot, stereo, diameter_mm = description.robot, description.stereo, description.shaft_diameter_mm
    arms = {
        name: asdict(robot.arms[name]) for name in (description.laparoscope_arm, description.instrument_arm) if name
    }
    content = [robot.name, robot.dh_convention, arms, asdict(stereo), description.laparoscope_arm, diameter_mm]
    text = json.dumps(content, sort_keys=True, default=lambda array: array.tolist())
    height, width = stereo.right.image_size
    cameras = "stereo" if stereo.left is not None else "mono"
    digest = hashlib.blake2b(text.encode(), digest_size=3).hexdigest()
    return f"{robot.name}, {cameras} {width} x {height}, {diameter_mm:g} mm shaft, {digest}"
