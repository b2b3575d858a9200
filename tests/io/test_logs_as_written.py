"""Joint logs as spreadsheets, pandas and robots write them: read with a note, or refused with line and reason."""

import math
from pathlib import Path

import numpy as np
import pytest
from recording_files import COLUMNS, RecordingFolder, joint_rows, write_csv

from rmis_calib.errors import FileError, RecordingError
from rmis_calib.io._csv import read_table
from rmis_calib.io.recording import load_recording

ROWS = [[0.0, 0.25], [0.5, -1.5], [1.0, 2e-3]]
PLAIN = "t,x\n0.0,0.25\n0.5,-1.5\n1.0,2e-3\n"


@pytest.mark.parametrize(
    ("text", "noted"),
    [
        (PLAIN, ""),
        (PLAIN.rstrip("\n"), ""),
        (PLAIN + "\n\n \n", ""),
        (PLAIN.replace("\n", "\r\n"), ""),
        (PLAIN.replace("\n", "\r"), ""),
        ("\ufeff" + PLAIN, ""),
        ('"t","x"\n0.0,0.25\n0.5,-1.5\n1.0,2e-3\n', ""),
        ('"t","x"\n"0.0","0.25"\n"0.5","-1.5"\n"1.0","2e-3"\n', ""),
        ("t,x,\n0.0,0.25,\n0.5,-1.5,\n1.0,2e-3,\n", ""),
        ("t,x\n0.0,0.25,\n0.5,-1.5,\n1.0,2e-3,\n", ""),
        (",t,x\n0,0.0,0.25\n1,0.5,-1.5\n2,1.0,2e-3\n", "the first column numbers the rows"),
        ("Unnamed: 0,t,x\n0,0.0,0.25\n1,0.5,-1.5\n2,1.0,2e-3\n", "the first column numbers the rows"),
        (PLAIN.replace(",", ";"), "separated by semicolons"),
        (PLAIN.replace(",", "\t"), "separated by tabs"),
        (PLAIN.replace(",", ";").replace(".", ","), "a comma was read as the decimal sign"),
    ],
    ids=[
        "plain", "no last line end", "empty lines at the end", "CR LF", "CR", "BOM", "quoted names", "all quoted",
        "comma at all ends", "comma at the rows' ends", "index", "pandas index", "semicolons", "tabs", "decimal comma",
    ],
)  # fmt: skip
def test_one_table_written_in_many_ways(tmp_path: Path, text: str, noted: str) -> None:
    path = tmp_path / "t.csv"
    path.write_bytes(text.encode())
    notes: list[str] = []
    table = read_table(path, note=notes.append)
    assert table.columns == ("t", "x")
    np.testing.assert_array_equal(table.values, ROWS)
    assert bool(notes) == bool(noted) and noted in " ".join(notes)


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("t,x\n0,1\n\n1,2\n", "line 3: expected 2 numbers, found an empty line"),
        ("t,x\n0,1\n1,2,3\n", "line 3: expected 2 numbers, found 3"),
        ("t,x\n0,1\n1,two\n", "line 3, column x: expected a finite number, found 'two'"),
        ("t,x\n0,1\n1,\n", "line 3, column x: expected a finite number, found an empty cell"),
        ("t,x\n0,1\n1,nan\n", "line 3, column x: expected a finite number, found 'nan'"),
        ("t,x\n0,1\n1,1e999\n", "line 3, column x: expected a finite number, found '1e999'"),
        (",t,x\n0,0,1\n2,1,2\n", "expected a name for every column, found '' with other values than 0, 1, 2"),
        ("t,t\n0,1\n", "expected each column once, found t twice"),
        ("t;x\n0,5;1\n1.5;2\n", "line 3"),  # points beside commas: one of the two is a mistake
        ("\n", "an empty file"),
        ("t,x\n", "no rows"),
    ],
)
def test_what_is_no_table_is_refused_with_its_line(tmp_path: Path, text: str, message: str) -> None:
    path = tmp_path / "t.csv"
    path.write_text(text)
    if ";" in text:  # read as 0.5 and 1.5: nothing is lost
        np.testing.assert_array_equal(read_table(path).values, [[0.5, 1.0], [1.5, 2.0]])
        return
    with pytest.raises(RecordingError, match=message):
        read_table(path)


def test_lines_are_numbered_across_blocks(tmp_path: Path) -> None:
    path = tmp_path / "t.csv"
    lines = [f"{number},{number}.5" for number in range(1_200_000)]
    lines[1_000_000] = "1000000,x"
    path.write_text("t,x\n" + "\n".join(lines) + "\n")
    assert path.stat().st_size > 1 << 24  # several blocks
    with pytest.raises(RecordingError, match="line 1000002, column x: expected a finite number, found 'x'"):
        read_table(path)


def test_an_endless_line_is_refused(tmp_path: Path) -> None:
    path = tmp_path / "t.csv"
    with path.open("wb") as file:
        file.write(b"t,x\n0,1\n")
        file.truncate(1 << 40)  # sparse: a terabyte of zero bytes
    with pytest.raises(RecordingError, match="line 3: expected a line of numbers, found one of megabytes"):
        read_table(path)


def test_a_pipe_is_refused_and_does_not_hang(folder: RecordingFolder) -> None:
    import os

    for name in ("joints.csv", "robot.yaml", "recording.yaml", "right.mp4"):
        path = folder.path / name
        content = path.read_bytes()
        path.unlink()
        os.mkfifo(path)
        with pytest.raises(FileError, match="found a pipe, socket or device"):
            load_recording(folder.path)
        path.unlink()
        path.write_bytes(content)
    load_recording(folder.path)


def written(folder: RecordingFolder, rows: np.ndarray, columns: tuple[str, ...] = COLUMNS) -> None:
    write_csv(folder.path / "joints.csv", columns, rows)


def test_an_angle_that_wraps_is_unwrapped(folder: RecordingFolder) -> None:
    rows = joint_rows()
    free = COLUMNS.index("laparoscope.yaw_rad")
    rows[:, free] = math.pi - 0.1 + 0.01 * np.arange(len(rows))  # leaves at pi, on its way up
    expected = rows[:, free].copy()
    rows[:, free] = (rows[:, free] + math.pi) % (2 * math.pi) - math.pi
    written(folder, rows)
    recording = load_recording(folder.path)
    np.testing.assert_allclose(recording.joints.values[:, 0], expected, atol=1e-9)
    assert any("laparoscope.yaw_rad: 1 jumps of a whole turn" in note for note in recording.notes)
    # Counter-literal: interpolated across the wrap without it, an angle half-way would be near 0.
    value, known = recording.joints_at_frames("laparoscope")
    assert known.all() and float(value[:, 0].min()) > 3.0


def test_a_spike_costs_the_frames_beside_it_and_no_more(folder: RecordingFolder) -> None:
    rows = joint_rows()
    rows[22, COLUMNS.index("instrument.insertion_mm")] = 9e5  # at 0.22 s, the time of frame 5
    rows[23, COLUMNS.index("instrument.pitch_rad")] += 1.0
    written(folder, rows)
    recording = load_recording(folder.path)
    _, known = recording.joints_at_frames("instrument")
    assert np.flatnonzero(~known).tolist() == [5]
    assert sum("an encoder spike" in note for note in recording.notes) == 2
    assert any("line 24, column instrument.insertion_mm" in note for note in recording.notes)
    # All other frames read what they read without the spike.
    written(folder, joint_rows())
    clean, _ = load_recording(folder.path).joints_at_frames("instrument")
    spiked, _ = recording.joints_at_frames("instrument")
    np.testing.assert_allclose(spiked[known], clean[known], atol=0.02)


def test_a_step_that_stays_is_no_spike(folder: RecordingFolder) -> None:
    rows = joint_rows()
    rows[30:, COLUMNS.index("instrument.pitch_rad")] += 1.0
    written(folder, rows)
    assert not any("spike" in note for note in load_recording(folder.path).notes)


def test_units_in_names_are_converted(folder: RecordingFolder) -> None:
    rows = joint_rows()
    plain, _ = load_recording(folder.path).joints_at_frames("instrument")
    rows[:, COLUMNS.index("instrument.yaw_rad")] *= 180.0 / math.pi
    rows[:, COLUMNS.index("instrument.insertion_mm")] /= 1000.0
    names = [name.replace("instrument.yaw_rad", "instrument.yaw_deg") for name in COLUMNS]
    written(folder, rows, tuple(name.replace("instrument.insertion_mm", "instrument.insertion_m") for name in names))
    recording = load_recording(folder.path)
    converted, _ = recording.joints_at_frames("instrument")
    np.testing.assert_allclose(converted, plain, rtol=1e-8)  # the file holds ten digits
    assert [note.rpartition(" ")[2] for note in recording.notes] == ["instrument.yaw_rad", "instrument.insertion_mm"]


def test_degrees_under_the_name_of_radians_are_named(folder: RecordingFolder) -> None:
    rows = joint_rows()
    rows[:, COLUMNS.index("instrument.yaw_rad")] = np.linspace(2.0, 40.0, len(rows))  # within +-1.5 rad as degrees
    written(folder, rows)
    with pytest.raises(RecordingError, match="line 2, column instrument.yaw_rad: looks like degrees; write radians"):
        load_recording(folder.path)
