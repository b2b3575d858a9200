"""dVRK configuration files (JSON with comments, metres) as arms: kinematics, tools, and where a console puts the bases.

Convention: modified DH as the dVRK uses it; alpha of 1.5708 means a right angle, as the dVRK itself takes it, while
offsets keep their digits (recorded poses are reproduced to the last digit that way; tests/kinematics).
"""

import math
import re
from functools import lru_cache
from pathlib import Path
from typing import Any, Literal

import numpy as np

from rmis_calib.errors import RobotError
from rmis_calib.io._checks import Note, no_note, rigid_from_text
from rmis_calib.io.configs import read_bytes
from rmis_calib.robot import Arm, HeadPoint, Joint, Robot

Endoscope = Literal["straight", "up", "down"]
"""A straight scope, or one of 30 degrees that looks up or down."""

_LARGEST_BYTES = 4 << 20
_MM = 1000.0
_RIGHT_ANGLE_DIGITS = 1e-4
# The RCM is the origin of an arm's base frame: joints 1 and 2 meet there, and the shaft passes through it.
_RCM_FRAME = 0
_END_T_STRAIGHT_SCOPE = np.array([[0.0, 1.0, 0, 0], [-1.0, 0, 0, 0], [0, 0, 1.0, 0], [0, 0, 0, 1.0]])
_SCOPE_TILT_DEG: dict[Endoscope, float] = {"straight": 0.0, "up": -30.0, "down": 30.0}


def read_json5(path: str | Path) -> Any:
    """A dVRK file: JSON with comments; also the bare `"base-frame": {...}` that registration scripts write.

    Raises:
        FileError: the file is absent or unreadable.
        RobotError: it is neither.
    """
    try:
        text = read_bytes(path, _LARGEST_BYTES).decode("utf-8-sig")
        return _parsed(f"{{{text}}}" if text.lstrip().startswith('"') else text)
    except (ValueError, RecursionError) as problem:
        where, _, found = str(problem).partition(" ")
        place = f"{path} line {where.split(':')[1]}" if where.startswith("<string>:") else str(path)
        raise RobotError(where=place, expected="JSON (comments are fine)", found=found or str(problem)) from problem


@lru_cache(maxsize=128)
def _parsed(text: str) -> Any:
    """The content; kept, since the parser takes a tenth of a second a file. Never changed by who reads it."""
    import json5

    return json5.loads(text)


def import_dvrk(
    instrument: str | Path,
    tool: str | Path,
    ecm: str | Path | None = None,
    system: str | Path | None = None,
    endoscope: Endoscope = "straight",
    instrument_name: str | None = None,
    note: Note = no_note,
) -> Robot:
    """A robot of one instrument arm, and of the endoscope's arm where one is given.

    Args:
        instrument: kinematic/PSM.json, or arm/PSM1.json that names it. Take the arm's generation, not the tool's.
        tool: tool/NAME.json of the instrument on it.
        ecm: the same of the endoscope's arm.
        system: console or system JSON, or suj-fixed.json, that may say where the arms' bases are.
        endoscope: what looks out of the ECM.
        instrument_name: name of the arm in `system`; by default PSM1, PSM2 or PSM3 in the file's name.
        note: told what was guessed.

    Raises:
        FileError: a file is absent or unreadable.
        RobotError: a file is no such file, or describes a physical chain that has no DH table.
    """
    arm_rows = _joints(_kinematics(Path(instrument)), Path(instrument))
    tool_rows = _joints(read_json5(tool), Path(tool))
    if len(arm_rows) != 3 or not tool_rows or tool_rows[0].type != "revolute":
        found = f"{len(arm_rows)} and {len(tool_rows)}"
        expected = "an arm of 3 joints (kinematic/PSM*.json) and a tool whose first joint turns the shaft (tool/*.json)"
        raise RobotError(where=f"{instrument}, {tool}", expected=expected, found=found)
    rows = (*arm_rows, *tool_rows)
    name = instrument_name or _name_of_arm(instrument)
    bases = {} if system is None else _bases(read_json5(system), Path(system), note)
    poses = {"instrument": bases.get(name or "PSM1"), "laparoscope": bases.get("ECM")}
    if system is not None:
        poses = _on_one_base(poses, bases, name, Path(system), ecm is not None, note)
    head = HeadPoint(len(rows), (0.0, 0.0, 0.0))
    bases_known = all(placed is not None for placed in poses.values())
    if ecm is not None and not bases_known:
        poses = dict.fromkeys(poses)
        note(
            "where the arms' bases stand is not known: base_T_arm_base is left out, and estimated where the "
            "laparoscope moves; fill it in, or give --system, if you know it"
        )
    alone = np.eye(4) if ecm is None else None  # one arm's base is as good a base as any
    base = {arm: alone if placed is None else placed[1] for arm, placed in poses.items()}
    arms = {"instrument": Arm(base["instrument"], rows, np.eye(4), _RCM_FRAME, len(arm_rows) + 1, head)}
    if ecm is not None:
        ecm_rows = _joints(_kinematics(Path(ecm)), Path(ecm))
        arms = {"laparoscope": Arm(base["laparoscope"], ecm_rows, end_T_scope(endoscope))} | arms
    return Robot(f"dvrk {Path(instrument).stem} {Path(tool).stem}", "modified", arms)


def end_T_scope(endoscope: Endoscope) -> np.ndarray:
    """(4, 4): the tip of an endoscope in the last frame of the ECM."""
    c, s = math.cos(math.radians(_SCOPE_TILT_DEG[endoscope])), math.sin(math.radians(_SCOPE_TILT_DEG[endoscope]))
    tilt = np.array([[1.0, 0, 0, 0], [0, c, -s, 0], [0, s, c, 0], [0, 0, 0, 1.0]])
    return _END_T_STRAIGHT_SCOPE @ tilt


def _kinematics(path: Path) -> Any:
    """The content of a kinematic file, or of the one that an arm file names."""
    raw = read_json5(path)
    if not isinstance(raw, dict) or "DH" in raw or not isinstance(raw.get("kinematic"), str):
        return raw
    for folder in (path.parent, *path.parents[1:3]):
        if (folder / raw["kinematic"]).is_file():
            return read_json5(folder / raw["kinematic"])
    raise RobotError(where=f"{path}: kinematic", expected="a file beside it", found=raw["kinematic"])


def _joints(raw: Any, path: Path) -> tuple[Joint, ...]:
    """The rows of a DH table in mm."""
    table = raw.get("DH") if isinstance(raw, dict) else None
    table = table if isinstance(table, dict) else {}
    rows = table.get("joints") or table.get("links")
    if not isinstance(rows, list) or not rows:
        raise RobotError(
            where=str(path), expected="DH.joints or DH.links of a dVRK kinematic or tool file", found="none"
        )
    if table.get("convention") != "modified":
        expected = "DH convention modified (PSM, ECM and tools; MTMs are not part of a calibration)"
        raise RobotError(where=f"{path}: DH.convention", expected=expected, found=table.get("convention"))
    return tuple(_joint(row, f"{path}: DH joint {number}") for number, row in enumerate(rows, start=1))


def _joint(row: dict[str, Any], where: str) -> Joint:
    if row.get("mode", "active") != "active":
        expected = "active joints only (of the virtual chain: PSM_Si.json, not PSM_Si_physical.json)"
        raise RobotError(where=where, expected=expected, found=f"a {row['mode']} one")
    if row.get("type") not in ("revolute", "prismatic"):
        raise RobotError(where=where, expected="type revolute or prismatic", found=row.get("type"))

    def number(key: str) -> float:
        value = row.get(key)
        if not isinstance(value, int | float) or not math.isfinite(value):
            raise RobotError(where=f"{where}.{key}", expected="a finite number", found=value)
        return float(value)

    if "offset" not in row:
        expected = "an offset (kinematics of the virtual chain have one: PSM_Si.json, not PSM_Si_physical.json)"
        raise RobotError(where=where, expected=expected, found="none")
    is_prismatic = row["type"] == "prismatic"

    def reading(key: str) -> float:
        return _mm(number(key)) if is_prismatic else number(key)

    limits = [reading(key) if key in row else None for key in ("qmin", "qmax")]
    name = re.sub(r"\W", "_", str(row.get("name") or "")).removeprefix("outer_")
    return Joint(
        name, row["type"], _right_angle(number("alpha")), _mm(number("A")), number("theta"), _mm(number("D")),
        reading("offset"), limits[0], limits[1],
    )  # fmt: skip


def _mm(metres: float) -> float:
    """To a picometre: 0.3829 m is 382.9 mm, not 382.90000000000003."""
    return round(_MM * metres, 9)


def _right_angle(angle: float) -> float:
    """The angle, or the right angle that four decimals of it mean."""
    exact = math.copysign(math.pi / 2, angle)
    return exact if abs(angle - exact) < _RIGHT_ANGLE_DIGITS else angle


def _name_of_arm(path: str | Path) -> str | None:
    found = re.search(r"PSM\d", Path(path).stem)
    return found[0] if found else None


def _bases(raw: Any, path: Path, note: Note) -> dict[str, tuple[str, np.ndarray]]:
    """Reference frame and pose (mm) of the base of each arm that a file places."""
    arms = raw.get("arms") if isinstance(raw, dict) else None
    if not isinstance(arms, list):
        raise RobotError(where=str(path), expected="arms of a dVRK system, console or suj-fixed file", found="none")
    found = {}
    for number, arm in enumerate(arms):
        if not isinstance(arm, dict):
            continue
        frame = arm.get("base_frame") or arm.get("base-frame") or {}
        rows = frame.get("transform") or arm.get("measured_cp")
        name = str(arm.get("name"))
        if rows is None:
            if "component" in frame:
                note(f"{path}: the base of {name} comes from the set-up joints, which the file does not hold")
            continue
        reference = str(frame.get("reference_frame") or frame.get("reference-frame") or "SUJ")
        pose = rigid_from_text(_rows(rows, f"{path}: arms[{number}]"), f"{path}: arms[{number}]", RobotError, note)
        pose[:3, 3] *= _MM
        found[name] = (reference, pose)
    return found


def _rows(value: Any, where: str) -> list[list[float]]:
    try:
        matrix = np.asarray(value, dtype=np.float64)
    except (TypeError, ValueError):
        matrix = np.empty((0, 0))
    if matrix.shape != (4, 4) or not np.isfinite(matrix).all():
        raise RobotError(where=where, expected="a transform of 4 rows of 4 finite numbers", found="something else")
    return [[float(value) for value in row] for row in matrix]


def _on_one_base(
    poses: dict[str, Any], bases: dict[str, Any], name: str | None, path: Path, has_ecm: bool, note: Note
) -> dict[str, Any]:
    """The poses, where all of them refer to one frame."""
    psms = [arm for arm in bases if arm.startswith("PSM")]
    if name is None and psms:
        poses = {**poses, "instrument": bases[psms[0]] if len(psms) == 1 else None}
        said = f"taken for {psms[0]}" if len(psms) == 1 else f"not placed: name one of {', '.join(psms)}"
        note(f"{path}: the instrument's arm is {said}")
    if has_ecm and all(poses.values()) and poses["instrument"][0] != poses["laparoscope"][0]:
        frames = f"{poses['instrument'][0]} and {poses['laparoscope'][0]}"
        note(f"{path}: the two arms' bases refer to different frames ({frames}) and were not used")
        return dict.fromkeys(poses)
    return poses
