"""The joint log: readings by timestamp, and their interpolation at frame times. Never paired by index."""

import math
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from jaxtyping import Bool, Float

from rmis_calib.errors import RecordingError
from rmis_calib.io._checks import Note, no_note
from rmis_calib.io._csv import Table, read_table, require_columns, require_increasing
from rmis_calib.io._schemas import DEGREES, FULL_TURN_RAD, METRES
from rmis_calib.robot import Joint, Robot

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
_CONVERTED = {"deg": ("rad", math.pi / 180.0), "m": ("mm", 1000.0)}
"""Units in a column's name that are ours after a multiplication."""
_CONTINUOUS_S = 0.1
"""Median interval up to which a log is a movie of the joints, not a list of poses: only then is a jump no motion."""
_FASTEST_RAD_S, _FASTEST_MM_S = 20.0, 2000.0
"""No surgical arm turns or slides this fast (dVRK: 3 rad/s, 500 mm/s)."""
_LONGEST_SPIKE, _MOST_SPIKES = 3, 0.01
"""Samples in a row, and share of all samples, up to which wild readings are an encoder's, not the wrong file's."""
_WRAP_SLACK_RAD = 0.5
"""A jump within this of a whole turn is a wrap."""


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
    broken: np.ndarray | None = None
    """(T,) bool: whether something was left out between this sample and the next, so that nothing may be interpolated
    there; None: nowhere."""

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
        return JointLog(self.timestamps_s, columns, self.values[:, index], self.max_gap_s, self.broken)

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
        whole = np.ones(len(before), dtype=bool) if self.broken is None else ~self.broken[before]
        valid = hit | ((fraction >= 0) & (fraction <= 1) & (gap <= self.max_gap_s) & (gap > 0) & whole)
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
        stamps = self.timestamps_s
        before = (np.searchsorted(stamps, inside, side="right") - 1).clip(0, len(stamps) - 2)
        h = (stamps[before + 1] - stamps[before])[..., None]
        u = (inside - stamps[before])[..., None] / h
        y0, y1 = self.values[before], self.values[before + 1]
        m0, m1 = h * self._slope(before), h * self._slope(before + 1)
        rise = y1 - y0
        # y0 + m0 u + b u^2 + c u^3: through both samples, with both slopes.
        b, c = 3.0 * rise - 2.0 * m0 - m1, m0 + m1 - 2.0 * rise
        return y0 + u * (m0 + u * (b + u * c)), (m0 + u * (2.0 * b + 3.0 * u * c)) / h

    def _slope(self, at: np.ndarray) -> np.ndarray:
        """(*n, J) slope of the parabola through a sample and its neighbours; at the ends, of the line to the only one.

        Only where it is asked for: of millions of samples, few are near a frame.
        """
        last = len(self.timestamps_s) - 1
        left, right = np.maximum(at - 1, 0), np.minimum(at + 1, last)
        to_left = (self.timestamps_s[at] - self.timestamps_s[left])[..., None]
        to_right = (self.timestamps_s[right] - self.timestamps_s[at])[..., None]
        fall, rise = self.values[at] - self.values[left], self.values[right] - self.values[at]
        with np.errstate(divide="ignore", invalid="ignore"):
            both = (fall / to_left * to_right + rise / to_right * to_left) / (to_left + to_right)
            return np.where(to_left == 0, rise / to_right, np.where(to_right == 0, fall / to_left, both))


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
    table = _in_our_units(read_table(path, note=note), note)
    joints = robot.joints(*arms)
    columns = tuple(joints)
    _check_units(table, columns)
    _check_unused_arms(table, robot, arms)
    require_columns(table, (_TIME, *columns))
    stamps = require_increasing(table, _TIME)
    is_continuous = len(stamps) > 2 and float(np.median(np.diff(stamps))) <= _CONTINUOUS_S
    spikes = np.zeros(len(stamps), dtype=bool)
    index = [table.columns.index(column) for column in columns]
    values = table.values[:, index]
    for i, column in enumerate(columns):
        joint = joints[column]
        wrong = _spikes(stamps, values[:, i], joint) if is_continuous else np.zeros(len(stamps), dtype=bool)
        _check_readings(table, column, joint, ~wrong)
        if wrong.any():
            first = int(wrong.argmax())
            note(
                f"{table.where(first, column)}: an encoder spike ({values[first, i]:g} {joint.unit})"
                + (f", and {int(wrong.sum()) - 1} more" if wrong.sum() > 1 else "")
                + ": left out, and no joints are known beside it"
            )
            spikes |= wrong
        if is_continuous and joint.type == "revolute":
            values[:, i] = _unwrapped(values[:, i], ~wrong, column, note)
    if not spikes.any():
        return JointLog(stamps, columns, values)
    kept = np.flatnonzero(~spikes)
    broken = np.append(np.diff(kept) > 1, False)
    return JointLog(stamps[kept], columns, values[kept], broken=broken)


def _in_our_units(table: Table, note: Note) -> Table:
    """The table with columns that say degrees or metres turned into radians and millimetres."""
    columns, values = list(table.columns), table.values
    for i, column in enumerate(columns):
        stem, _, unit = column.rpartition("_")
        if unit in _CONVERTED and stem:
            ours, factor = _CONVERTED[unit]
            columns[i] = f"{stem}_{ours}"
            values[:, i] *= factor
            note(f"{table.path.name}: column {column} was turned into {columns[i]}")
    return Table(table.path, tuple(columns), values)


def _spikes(stamps: np.ndarray, values: np.ndarray, joint: Joint) -> np.ndarray:
    """(T,) samples of short runs that a joint cannot have reached and left again: faster than any robot moves, there
    and back. A step that stays is not one."""
    fastest = _FASTEST_RAD_S if joint.type == "revolute" else _FASTEST_MM_S
    change = np.diff(values)
    if joint.type == "revolute":  # a wrap at half a turn is no jump
        change = change - 2 * math.pi * np.round(change / (2 * math.pi))
    jumps = np.flatnonzero(np.abs(change) > fastest * np.diff(stamps))
    spikes = np.zeros(len(stamps), dtype=bool)
    start = None
    for jump in jumps.tolist():
        if start is not None and jump - start[0] <= _LONGEST_SPIKE and np.sign(change[jump]) != start[1]:
            spikes[start[0] + 1 : jump + 1] = True
            start = None
        else:
            start = (jump, np.sign(change[jump]))
    return spikes if spikes.sum() <= max(1, _MOST_SPIKES * len(stamps)) else np.zeros_like(spikes)


def _unwrapped(values: np.ndarray, good: np.ndarray, column: str, note: Note) -> np.ndarray:
    """Angles without jumps of a whole turn."""
    turns = np.zeros(len(values))
    steps = np.diff(values[good])
    wraps = np.abs(steps) > 2 * math.pi - _WRAP_SLACK_RAD
    if not wraps.any():
        return values
    note(f"column {column}: {int(wraps.sum())} jumps of a whole turn were taken for an angle that wraps")
    turns[good] = np.concatenate(([0.0], np.cumsum(np.where(wraps, -np.sign(steps), 0.0))))
    return values + 2 * math.pi * turns


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


def _check_readings(table: Table, column: str, joint: Joint, good: np.ndarray) -> None:
    values = table.values[:, table.columns.index(column)]
    size = np.abs(values)
    # One sign: a carriage at rest near zero reads noise of both.
    if joint.type == "prismatic" and size.min() > 0 and size.max() < 1.0 and np.ptp(np.sign(values)) == 0:
        found = f"all {len(values)} readings below 1 mm (largest {size.max():g})"
        raise RecordingError(METRES, where=f"{table.path} column {column}", expected="mm", found=found)
    least, most = _reading_range(joint)
    bad = good & ((values < least) | (values > most))
    if bad.any():
        row = int(bad.argmax())
        # In degrees all readings would lie in the range.
        turned = np.deg2rad(values[good])
        degrees = joint.type == "revolute" and turned.min() >= least and turned.max() <= most
        hint = DEGREES if degrees or (joint.type == "revolute" and size[row] > FULL_TURN_RAD) else ""
        expected = f"a reading of {least:.6g} to {most:.6g} {joint.unit}"
        raise RecordingError(hint, where=table.where(row, column), expected=expected, found=f"{values[row]:g}")


def _reading_range(joint: Joint) -> tuple[float, float]:
    """Limits with their tolerance; without limits one turn each way, or five metres."""
    if joint.min is not None and joint.max is not None:
        margin = _LIMIT_TOLERANCE * (joint.max - joint.min)
        return joint.min - margin, joint.max + margin
    most = FULL_TURN_RAD if joint.type == "revolute" else 5000.0
    return -most, most
