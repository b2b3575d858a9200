"""Pictures in `right` and `left`, and one table of joints whose columns are mapped to a robot's."""

from dataclasses import replace
from pathlib import Path

import numpy as np

from rmis_calib.convert.files import take, take_pictures
from rmis_calib.convert.joints import robot_arms
from rmis_calib.convert.material import NS, ArmLog, Job, Logs, Material
from rmis_calib.convert.settings import ConvertSettings
from rmis_calib.errors import RecordingError
from rmis_calib.io._csv import Table, read_table
from rmis_calib.io.folders import natural_order
from rmis_calib.io.readers import PICTURE_SUFFIXES, open_reader
from rmis_calib.io.robot import load_robot
from rmis_calib.io.tables import read_frame_times
from rmis_calib.robot import Joint, joint_column

_ANGLE = {"rad": 1.0, "deg": np.pi / 180.0}
_LENGTH_M = {"mm": 1e-3, "m": 1.0, "cm": 1e-2, "um": 1e-6}
_TIME = {"s": 1.0, "ms": 1e-3, "us": 1e-6, "ns": 1e-9}


def convert_table(job: Job, settings: ConvertSettings) -> tuple[Material, ConvertSettings]:
    """All of a recording from a folder with right, left (folders of pictures, or videos) and one .csv.

    A table with as many rows as there are pictures has a row for each. Otherwise pictures need times of their own:
    frame_times.csv, those of a video, or --rate-hz.

    Raises:
        RecordingError: no robot was named, a column is missing, or pictures and rows do not go together.
    """
    require_robot(job, settings)
    table = read_table(_only_table(job.source), note=job.note)
    names, count, own_ns = _pictures(job)
    row_ns = _row_ns(table, settings, count, job)
    logs, settings = logs_of_table(table, row_ns, settings, job)
    frame_ns = _frame_ns(job, settings, count, own_ns, row_ns)
    return Material(logs, None, frame_ns, names["right"], names.get("left")), settings


def require_robot(job: Job, settings: ConvertSettings) -> str:
    """The robot that was named.

    Raises:
        RecordingError: none was.
    """
    if settings.robot is None:
        expected = "--robot, whose joints the table's columns are (see `rmis-calib robots list`)"
        raise RecordingError(where=str(job.source), expected=expected, found="nothing")
    return settings.robot


def logs_of_table(
    table: Table, row_ns: np.ndarray, settings: ConvertSettings, job: Job
) -> tuple[Logs, ConvertSettings]:
    """Logs of the instrument's arm and, where the table has its columns, of the laparoscope's; and the settings that
    name both.

    Raises:
        RecordingError: no robot was named, a column is missing, or of an unknown unit.
    """
    robot = load_robot(require_robot(job, settings))
    instrument, laparoscope = robot_arms(robot)
    instrument = settings.instrument or instrument
    laparoscope = settings.laparoscope or laparoscope
    arms = {}
    for name in (instrument, laparoscope):
        if name is None or name == "none" or name not in robot.arms:
            continue
        values = [_column(table, joint, joint_column(name, joint), settings) for joint in robot.arms[name].joints]
        if name == laparoscope and settings.laparoscope is None and all(value is None for value in values):
            laparoscope = None
            job.note("laparoscope: none of its joints are in the table; the camera is taken to stand still")
            continue
        missing = [joint_column(name, j) for j, v in zip(robot.arms[name].joints, values, strict=True) if v is None]
        if missing:
            expected = (
                f"columns {', '.join(missing)}, or --map COLUMN NAME:UNIT for each, or a --robot file of yours whose "
                "arms have only the joints that are logged"
            )
            raise RecordingError(where=str(table.path), expected=expected, found=", ".join(table.columns))
        log = ArmLog(name, joint_names=tuple(joint.name for joint in robot.arms[name].joints))
        log.joint_ns = [int(ns) for ns in row_ns]
        log.joints = list(np.stack([value for value in values if value is not None], axis=1))
        arms[name] = log
    return Logs(arms), replace(settings, instrument=instrument, laparoscope=laparoscope or "none")


def _only_table(folder: Path) -> Path:
    tables = [path for path in sorted(folder.glob("*.csv")) if path.name not in ("frame_times.csv", "head_points.csv")]
    if len(tables) != 1:
        found = ", ".join(path.name for path in tables) or "none"
        raise RecordingError(where=str(folder), expected="one table of joints (.csv)", found=found)
    return tables[0]


def _pictures(job: Job) -> tuple[dict[str, str], int, np.ndarray | None]:
    """Names in the recording by side, how many there are, and the times of a video's."""
    names: dict[str, str] = {}
    counts, own_ns = {}, None
    for side in ("right", "left"):
        found = [path for path in sorted(job.source.iterdir()) if path.stem == side and path.suffix != ".csv"]
        if not found:
            continue
        path = found[0]
        if path.is_dir():
            files = [file for file in path.iterdir() if file.suffix.lower() in PICTURE_SUFFIXES]
            take_pictures(sorted(files, key=lambda file: natural_order(file.name)), job.folder / side)
            names[side], counts[side] = side, len(files)
        else:
            reader = open_reader(path)
            if side == "right" and reader.times_s is not None:
                own_ns = np.round(reader.times_s * NS).astype(np.int64)
            take(path, job.folder / f"{side}{path.suffix}")
            names[side], counts[side] = f"{side}{path.suffix}", reader.count
    if len(set(counts.values())) != 1 or not counts.get("right"):
        raise RecordingError(where=str(job.source), expected="as many pictures in left as in right", found=counts)
    return names, counts["right"], own_ns


def _column(table: Table, joint: Joint, ours: str, settings: ConvertSettings) -> np.ndarray | None:
    """A joint's readings in rad or m; None where the table does not have it."""
    said, _, unit = settings.map.get(ours, ours).partition(":")
    if said not in table.columns:
        if ours in settings.map:
            raise RecordingError(where=f"--map {ours}", expected=f"a column of {', '.join(table.columns)}", found=said)
        return None
    factors = _ANGLE if joint.type == "revolute" else _LENGTH_M
    unit = unit or joint.unit
    if unit not in factors:
        raise RecordingError(where=f"--map {ours}", expected=f"a unit of {', '.join(factors)}", found=unit)
    return table.values[:, table.columns.index(said)] * factors[unit]


def _row_ns(table: Table, settings: ConvertSettings, count: int, job: Job) -> np.ndarray:
    """(T,) ns of the table's rows: its time column, else the frames that the rows belong to."""
    said, _, unit = settings.map.get("timestamp_s", "timestamp_s").partition(":")
    if said in table.columns:
        if (unit or "s") not in _TIME:
            raise RecordingError(where="--map timestamp_s", expected=f"a unit of {', '.join(_TIME)}", found=unit)
        return np.round(table.values[:, table.columns.index(said)] * _TIME[unit or "s"] * NS).astype(np.int64)
    if len(table.values) != count:
        expected = f"a time column (--map timestamp_s NAME), or a row for each of the {count} pictures"
        raise RecordingError(where=str(table.path), expected=expected, found=f"{len(table.values)} rows without times")
    job.note(f"{table.path.name}: no times; row i belongs to picture i")
    return np.round(np.arange(count) * NS / (settings.rate_hz or 1.0)).astype(np.int64)


def _frame_ns(
    job: Job, settings: ConvertSettings, count: int, own_ns: np.ndarray | None, row_ns: np.ndarray
) -> np.ndarray:
    listed = job.source / "frame_times.csv"
    if listed.is_file():
        frame_ns = np.round(read_frame_times(listed) * NS).astype(np.int64)
        if len(frame_ns) != count:
            raise RecordingError(where=str(listed), expected=f"{count} frames", found=len(frame_ns))
        return frame_ns
    if len(row_ns) == count:
        job.note("as many rows as pictures: row i belongs to picture i")
        return row_ns
    if own_ns is not None:
        job.note("frame times are those of the video, from its start")
        return own_ns
    if settings.rate_hz is not None:
        job.note(f"frame times are those of {settings.rate_hz:g} pictures a second, from the table's first row")
        return row_ns[0] + np.round(np.arange(count) * NS / settings.rate_hz).astype(np.int64)
    expected = f"frame_times.csv, --rate-hz, or a row for each of the {count} pictures"
    raise RecordingError(where=str(job.source), expected=expected, found=f"{len(row_ns)} rows")
