"""The joint log: readings by timestamp, and their interpolation at frame times. Never paired by index."""

import math
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import Bool, Float

from rmis_calib.errors import RecordingError
from rmis_calib.io._checks import Note, no_note
from rmis_calib.io._csv import Table, read_table, require_columns, require_increasing
from rmis_calib.io._schemas import DEGREES, FULL_TURN_RAD, METRES
from rmis_calib.io.robot import Joint, Robot

# A frame this close to a sample takes it as it is: timestamps printed with four decimals count as equal, and a tool at
# 100 mm/s moves 0.01 mm in it.
_SAME_TIME_S = 1e-4
# Noise aside, a straight line over a gap g is wrong by at most acceleration * g^2 / 8, and the cubic is not worse. At
# 0.05 s that is 0.03 mm for a brisk 100 mm/s^2; at 0.5 s it is 0.6 mm for a slow 20 mm/s^2. So a log may lose a few
# samples in a row (5), but one sampled slower than 2 Hz is a list of poses: true at its samples, unknown between them.
_MIN_GAP_S, _MAX_GAP_S, _GAP_SAMPLES = 0.05, 0.5, 5.0
# Encoders overshoot a soft limit a little; more than this part of the range is another joint, unit or robot.
_LIMIT_TOLERANCE = 0.02
_TIME = "timestamp_s"


@dataclass(frozen=True, eq=False)
class JointLog:
    """Readings of some joints over time; rad and mm, without the offsets of the DH table.

    Raises:
        RecordingError: shapes that do not fit, a value that is not finite, or timestamps that do not increase.
    """

    timestamps_s: np.ndarray
    """(T,), strictly increasing."""
    columns: tuple[str, ...]
    """J names, `<arm>.<joint>_rad` or `_mm`."""
    values: np.ndarray
    """(T, J)."""
    max_gap_s: float = math.nan
    """Widest interval to interpolate across; NaN: five median sample intervals, at least 0.05 s and at most 0.5 s."""

    def __post_init__(self) -> None:
        expected = (len(self.timestamps_s), len(self.columns))
        if self.values.shape != expected or not expected[0]:
            found = f"{self.values.shape} for {expected[0]} timestamps and {expected[1]} columns"
            raise RecordingError(where="joint log", expected="values of shape (T, J), T > 0", found=found)
        if not (np.isfinite(self.timestamps_s).all() and np.isfinite(self.values).all()):
            raise RecordingError(where="joint log", expected="finite numbers", found="NaN or infinity")
        intervals = np.diff(self.timestamps_s)
        if (intervals <= 0).any():
            found = f"no increase after {self.timestamps_s[int((intervals <= 0).argmax())]:.9g} s"
            raise RecordingError(where="joint log", expected="timestamps that increase", found=found)
        if math.isnan(self.max_gap_s):
            usual = _GAP_SAMPLES * float(np.median(intervals)) if len(intervals) else 0.0
            object.__setattr__(self, "max_gap_s", min(max(usual, _MIN_GAP_S), _MAX_GAP_S))

    def select(self, columns: tuple[str, ...]) -> "JointLog":
        """The log of some columns, in the order asked for.

        Raises:
            RecordingError: no such column.
        """
        missing = [column for column in columns if column not in self.columns]
        if missing:
            expected = f"columns of {', '.join(self.columns)}"
            raise RecordingError(where="joint log", expected=expected, found=", ".join(missing))
        index = [self.columns.index(column) for column in columns]
        return JointLog(self.timestamps_s, columns, self.values[:, index], self.max_gap_s)

    def at(self, times_s: Float[np.ndarray, " n"]) -> tuple[Float[np.ndarray, "n j"], Bool[np.ndarray, " n"]]:
        """Readings at some times, interpolated, and where they are known.

        Not valid, and NaN: before the first sample, after the last, and inside an interval wider than `max_gap_s`. A
        time that hits a sample (within 0.1 ms) is always valid.

        Args:
            times_s: on the clock of the log, in any order: frame time + clock offset.
        """
        stamps = self.timestamps_s
        after = np.searchsorted(stamps, times_s, side="right").clip(1, max(len(stamps) - 1, 1))
        before, after = after - 1, np.minimum(after, len(stamps) - 1)
        start, gap = stamps[before], stamps[after] - stamps[before]
        # A log of one sample has before == after.
        fraction = (times_s - start) / np.where(gap > 0, gap, 1.0)
        nearest = np.where(fraction > 0.5, after, before)
        hit = np.abs(times_s - stamps[nearest]) <= _SAME_TIME_S
        valid = hit | ((fraction >= 0) & (fraction <= 1) & (gap <= self.max_gap_s) & (gap > 0))
        values, _ = self.interpolate(np.where(hit & (gap > self.max_gap_s), stamps[nearest], times_s))
        return np.where(valid[:, None], values, np.nan), valid

    def interpolate(self, times_s: Float[np.ndarray, "*n"]) -> tuple[np.ndarray, np.ndarray]:
        """Readings and their velocities (unit per second), each (*n, J), at times held within those of the log.

        A cubic between neighbouring samples, with the slope of the parabola through each sample and its neighbours:
        smooth, so that a clock offset has a derivative.
        """
        inside = np.nan_to_num(times_s, nan=self.timestamps_s[0]).clip(self.timestamps_s[0], self.timestamps_s[-1])
        if len(self.timestamps_s) < 3:
            steps = np.diff(self.values, axis=0) / np.diff(self.timestamps_s)[:, None]
            slope = steps.sum(axis=0)  # of the one interval, or none
            return self.values[0] + slope * (inside - self.timestamps_s[0])[..., None], slope + 0.0 * inside[..., None]
        position, velocity = self._cubic
        return position(inside), velocity(inside)

    @cached_property
    def _cubic(self) -> tuple[Any, Any]:
        from scipy.interpolate import CubicHermiteSpline

        slopes = np.gradient(self.values, self.timestamps_s, axis=0)
        spline = CubicHermiteSpline(self.timestamps_s, self.values, slopes)
        return spline, spline.derivative()


def load_joints(path: str | Path, robot: Robot, arms: tuple[str, ...], note: Note = no_note) -> JointLog:
    """The joint log of the arms in use.

    Args:
        path: joints.csv.
        robot: names, units and limits of the joints.
        arms: arms whose joints the log must hold, all of them and no others.
        note: told what was mended.

    Raises:
        FileError: the file is absent or unreadable.
        RecordingError: a column is missing, unexpected or in another unit; an entry is not a finite number or out of
            the joint's range; time does not increase. Names line and column.
    """
    table = read_table(path)
    columns = tuple(column for arm in arms for column in robot.columns(arm))
    _check_units(table, columns)
    _check_unused_arms(table, robot, arms)
    require_columns(table, (_TIME, *columns))
    stamps = require_increasing(table, _TIME)
    for arm in arms:
        for joint, column in zip(robot.arms[arm].joints, robot.columns(arm), strict=True):
            _check_readings(table, column, joint)
    index = [table.columns.index(column) for column in columns]
    return JointLog(stamps, columns, table.values[:, index])


def _check_units(table: Table, expected: tuple[str, ...]) -> None:
    """The right joint in another unit, or without one, gets a message of its own."""
    wanted = {column.rpartition("_")[0]: column for column in expected if column not in table.columns}
    for column in table.columns:
        right = wanted.get(column) or wanted.get(column.rpartition("_")[0])
        if right is not None:
            unit = "radians" if right.endswith("_rad") else "millimetres"
            raise RecordingError("wrong unit", where=f"{table.path} line 1", expected=f"{right} ({unit})", found=column)


def _check_unused_arms(table: Table, robot: Robot, arms: tuple[str, ...]) -> None:
    for column in table.columns:
        arm = column.partition(".")[0]
        if arm in robot.arms and arm not in arms:
            expected = f"columns of the arms in use ({', '.join(arms)})"
            found = f"{column}, whose arm recording.yaml does not use"
            raise RecordingError(where=f"{table.path} line 1", expected=expected, found=found)


def _check_readings(table: Table, column: str, joint: Joint) -> None:
    values = table.values[:, table.columns.index(column)]
    size = np.abs(values)
    # One sign: a carriage at rest near zero reads noise of both.
    if joint.type == "prismatic" and size.min() > 0 and size.max() < 1.0 and np.ptp(np.sign(values)) == 0:
        found = f"all {len(values)} readings below 1 mm (largest {size.max():g})"
        raise RecordingError(METRES, where=f"{table.path} column {column}", expected="mm", found=found)
    least, most = _reading_range(joint)
    bad = (values < least) | (values > most)
    if bad.any():
        row = int(bad.argmax())
        hint = DEGREES if joint.type == "revolute" and size[row] > FULL_TURN_RAD else ""
        expected = f"a reading of {least:.6g} to {most:.6g} {joint.unit}"
        raise RecordingError(hint, where=table.where(row, column), expected=expected, found=f"{values[row]:g}")


def _reading_range(joint: Joint) -> tuple[float, float]:
    """Limits with their tolerance; without limits one turn each way, or five metres."""
    if joint.min is not None and joint.max is not None:
        margin = _LIMIT_TOLERANCE * (joint.max - joint.min)
        return joint.min - margin, joint.max + margin
    most = FULL_TURN_RAD if joint.type == "revolute" else 5000.0
    return -most, most
