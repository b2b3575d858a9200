"""Stamps in other units, other zones and other epochs: recognised where only one reading fits, else named."""

import numpy as np
import pytest
from breaking import edit
from recording_files import COLUMNS, FPS, FRAMES, RecordingFolder, joint_rows

from rmis_calib.errors import RecordingError
from rmis_calib.io.recording import load_recording

UNIX_S = 1_764_180_000.0


def with_clocks(folder: RecordingFolder, joint_scale: float, joint_start: float, frame_start: float) -> None:
    """Joint stamps in units of `joint_scale` seconds from `joint_start` on, frame times in seconds."""
    rows = joint_rows()
    rows[:, 0] = (rows[:, 0] + joint_start) / joint_scale
    lines = [",".join(COLUMNS), *(",".join(map(repr, row)) for row in rows.tolist())]
    (folder.path / "joints.csv").write_text("\n".join(lines))
    times = frame_start + np.arange(FRAMES) / FPS
    text = "frame,timestamp_s\n" + "\n".join(f"{i},{t!r}" for i, t in enumerate(times.tolist()))
    (folder.path / "frame_times.csv").write_text(text)
    edit("recording.yaml", frame_times="frame_times.csv")(folder)


@pytest.mark.parametrize(("scale", "unit"), [(1e-3, "milliseconds"), (1e-6, "microseconds"), (1e-9, "nanoseconds")])
@pytest.mark.parametrize("start", [0.0, UNIX_S])
def test_stamps_in_another_unit_are_recognised(folder, scale: float, unit: str, start: float) -> None:
    with_clocks(folder, 1.0, 0.0, 0.0)
    plain, _ = load_recording(folder.path).joints_at_frames("instrument")
    with_clocks(folder, scale, start, start)
    recording = load_recording(folder.path)
    read, known = recording.joints_at_frames("instrument")
    assert known.all()
    np.testing.assert_allclose(read, plain, atol=1e-4)  # a double holds a Unix time to 0.2 us
    assert any(f"were read as {unit}" in note for note in recording.notes)


def test_seconds_stay_seconds_without_a_note(folder) -> None:
    with_clocks(folder, 1.0, UNIX_S, UNIX_S)
    assert not load_recording(folder.path).notes


@pytest.mark.parametrize(
    ("joint_start", "frame_start", "words"),
    [
        (UNIX_S + 3600.0, UNIX_S, "1 hour apart (another time zone?); then write clock_offset_s: 3600.02"),
        (UNIX_S, UNIX_S + 86400.0, "1 day apart (another day?); then write clock_offset_s: -86399.98"),
        (UNIX_S, 0.0, f"the video counts from its start and the log since 1970; if both began together, write "
                      f"clock_offset_s: {UNIX_S:.0f}"),
        (UNIX_S + 7.25, UNIX_S, "6.79 s apart"),
    ],
)  # fmt: skip
def test_logs_that_do_not_meet_say_how_far_they_are_apart(folder, joint_start, frame_start, words) -> None:
    with_clocks(folder, 1.0, joint_start, frame_start)
    with pytest.raises(RecordingError) as caught:
        load_recording(folder.path)
    assert words in str(caught.value)


def test_unix_stamps_are_printed_so_that_they_differ(folder) -> None:
    with_clocks(folder, 1.0, UNIX_S + 7.25, UNIX_S)
    with pytest.raises(RecordingError, match=r"\(1764180000\.02 to 1764180000\.46 s.*from 1764180007\.25 to"):
        load_recording(folder.path)
