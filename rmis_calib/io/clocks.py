"""The clocks of the video and of the joint log: one unit, and some time in common."""

from dataclasses import replace
from pathlib import Path

import numpy as np

from rmis_calib.errors import RecordingError
from rmis_calib.io._checks import Note
from rmis_calib.io.joints import JointLog

_UNITS = {1e-3: "milliseconds", 1e-6: "microseconds", 1e-9: "nanoseconds"}
_COVERED, _NOT_COVERED = 0.5, 0.1
"""Shares of the frames with known joints: above the first a unit fits, below the second it does not."""
_UNIX_S = 1e8
"""A time above this counts from 1970, not from the start of a recording."""
_SHORTEST_INTERVAL_S = 2e-4
"""Between frames, or between samples of joints: less is another unit."""
_HOUR_S, _DAY_S = 3600.0, 86400.0


def on_one_clock(
    frame_times_s: np.ndarray, joints: JointLog, offset_s: float, where: Path, note: Note
) -> tuple[np.ndarray, JointLog]:
    """Both clocks in seconds: stamps in another unit are recognised where with exactly one unit the joints are known at
    most frames, and in seconds at hardly any.

    Args:
        frame_times_s: (N,) as read.
        joints: the log as read.
        offset_s: joint time = frame time + this.
        where: joints.csv, for the note.
        note: told what was converted.
    """
    if _share(frame_times_s, joints, offset_s) >= _NOT_COVERED:
        return frame_times_s, joints
    fits = []
    for scale in _UNITS:
        for frames_too in (False, True):
            scaled = replace(joints, timestamps_s=joints.timestamps_s * scale, max_gap_s=np.nan)
            times = frame_times_s * scale if frames_too else frame_times_s
            if _share(times, scaled, offset_s) >= _COVERED:
                fits.append((scale, frames_too, times, scaled))
        if _share(frame_times_s * scale, joints, offset_s) >= _COVERED:
            fits.append((scale, None, frame_times_s * scale, joints))
    if len(fits) != 1:
        return frame_times_s, joints
    scale, frames_too, times, scaled = fits[0]
    whose = {False: where.name, True: f"{where.name} and the frame times", None: "the frame times"}[frames_too]
    covered = round(100 * _share(times, scaled, offset_s))
    note(f"time stamps of {whose} were read as {_UNITS[scale]}: so the joints are known at {covered} % of the frames")
    return times, scaled


def check_overlap(joints: JointLog, frame_times_s: np.ndarray, offset_s: float, where: Path) -> None:
    """Frames outside the log are data; no frame inside it is a wrong clock or a wrong file.

    Raises:
        RecordingError: with both spans, how far they are apart, and what that looks like.
    """
    times_s = frame_times_s + offset_s
    if joints.at(times_s)[1].any():
        return
    first, last = joints.timestamps_s[[0, -1]]
    expected = f"joints at the time of some frame ({stamp(times_s[0])} to {stamp(times_s[-1])} s, clock_offset_s added)"
    found = (
        f"samples from {stamp(first)} to {stamp(last)} s, none close enough to one{_likely(joints, times_s, offset_s)}"
    )
    raise RecordingError(where=str(where), expected=expected, found=found)


def stamp(time_s: float) -> str:
    """A time with milliseconds, whatever its size: of Unix times the difference must be visible."""
    return f"{time_s:.3f}".rstrip("0").rstrip(".")


def _share(times_s: np.ndarray, joints: JointLog, offset_s: float) -> float:
    """Share of the frames at which the joints are known; 0 for clocks that no camera or robot has."""
    for stamps in (times_s, joints.timestamps_s):
        if len(stamps) > 1 and float(np.median(np.diff(stamps))) < _SHORTEST_INTERVAL_S:
            return 0.0
    return float(joints.at(times_s + offset_s)[1].mean())


def _likely(joints: JointLog, times_s: np.ndarray, offset_s: float) -> str:
    """What the distance between two spans that do not meet looks like."""
    first, last = joints.timestamps_s[[0, -1]]
    if times_s[0] <= last and times_s[-1] >= first:
        return " (the log has gaps there, or is sampled too slowly to interpolate)"
    apart_s = first - times_s[-1] if first > times_s[-1] else last - times_s[0]
    start_s = first - times_s[0]
    if (first > _UNIX_S) != (times_s[0] > _UNIX_S):
        counts = (
            "the video counts from its start and the log since 1970"
            if first > _UNIX_S
            else ("the log counts from its start and the video since 1970")
        )
        return f": {counts}; if both began together, write clock_offset_s: {stamp(offset_s + start_s)}"
    longest = max(last - first, times_s[-1] - times_s[0])
    for unit_s, name in ((_DAY_S, "day"), (_HOUR_S, "hour")):
        count = round(start_s / unit_s)
        if count and abs(start_s - count * unit_s) <= longest:
            why = "another day?" if name == "day" else "another time zone?"
            apart = f"{abs(count)} {name}{'s' if abs(count) > 1 else ''} apart"
            return f": {apart} ({why}); then write clock_offset_s: {stamp(offset_s + count * unit_s)}"
    return f": {stamp(abs(apart_s))} s apart"
