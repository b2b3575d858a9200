"""Tables that the dVRK recorder's `extract` makes of topics: a row a message, fields flattened with dots."""

import csv
import json
import re
from pathlib import Path

import numpy as np

from rmis_calib.convert.material import NS, ArmLog, Logs, Placing, PoseLog
from rmis_calib.errors import RecordingError
from rmis_calib.io._checks import Note

_ARM = re.compile(r"(PSM\d|ECM\d?)", re.IGNORECASE)
_NOT_MEASURED = ("setpoint", "jaw", "goal", "servo", "move")
_POSES = {"pose.position": "pose.orientation", "transform.translation": "transform.rotation"}
Row = dict[str, str]


def read_topic_table(path: Path, folder: Path, logs: Logs, note: Note) -> None:
    """Add a table to the logs, if it is of an arm's joints, tip or base; others are passed over.

    Args:
        path: the table; its name, and those of its folders within `folder`, tell topic and arm.
        folder: the session.
        logs: what was read so far.
        note: told what it was taken for.

    Raises:
        RecordingError: a cell is missing or no number.
    """
    name = str(path.relative_to(folder)).lower()
    arm = _ARM.search(name)
    if arm is None or any(word in name for word in _NOT_MEASURED):
        return
    try:
        with path.open(newline="", encoding="utf-8-sig") as file:
            rows = list(csv.DictReader(file))
        if rows:
            _add_rows(rows, name, arm[1].upper(), logs, lambda said: note(f"{path.name}: {len(rows)} {said}"))
    except (KeyError, ValueError, TypeError, IndexError, csv.Error) as problem:
        expected = "numbers in every row, with header.stamp.sec and .nanosec, or timestamp"
        raise RecordingError(where=str(path), expected=expected, found=str(problem)[:100]) from problem


def _add_rows(rows: list[Row], name: str, arm: str, logs: Logs, note: Note) -> None:
    columns = list(rows[0])
    positions = [column for column in columns if re.fullmatch(r"position[._\[]?\d+\]?", column)]
    pose = next((fields for fields in _POSES.items() if f"{fields[0]}.x" in columns), None)
    is_local, is_base = "local" in name, "suj" in name
    if ("js" in name or "joint" in name) and (positions or "position" in columns) and not is_base:
        log = logs.arms.setdefault(arm, ArmLog(arm))
        if not log.has_joints:
            log.joints = [_position(row, positions) for row in rows]
            log.joint_ns = [_row_ns(row) for row in rows]
            note(f"readings of {arm}")
    elif pose is not None and "cp" in name:
        fields = [f"{pose[0]}.{axis}" for axis in "xyz"] + [f"{pose[1]}.{axis}" for axis in "xyzw"]
        ns, poses = [_row_ns(row) for row in rows], [np.array([float(row[field]) for field in fields]) for row in rows]
        frame = (rows[0].get("header.frame_id") or "").strip("/")
        logs.placings.setdefault(Placing(arm, "base" if is_base else "tip", is_local), PoseLog(frame, ns, poses))
        of_what = (
            f"{arm}, its base in {frame or 'the cart'}"
            if is_base
            else f"{arm} relative to its RCM"
            if is_local
            else arm
        )
        note(f"poses of {of_what}")
        log = logs.arms.setdefault(arm, ArmLog(arm))
        if not is_base and (not log.poses or (is_local and not log.is_local)):
            log.pose_ns, log.poses, log.pose_frame, log.is_local = ns, poses, frame, is_local


def _position(row: Row, columns: list[str]) -> np.ndarray:
    if columns:
        return np.array([float(row[column]) for column in columns])
    return np.array(json.loads(row["position"].replace("(", "[").replace(")", "]")), dtype=np.float64)


def _row_ns(row: Row) -> int:
    seconds, nanoseconds = row.get("header.stamp.sec"), row.get("header.stamp.nanosec") or row.get("header.stamp.nsec")
    if seconds and nanoseconds and int(seconds) > 0:
        return int(seconds) * NS + int(nanoseconds)
    value = row["timestamp"]
    return int(value) if float(value) > 1e17 else round(float(value) * NS)
