"""Broken tables, videos and images of a recording: one clear line each, with file, line, expected and found."""

from pathlib import Path

import numpy as np
import pytest
from breaking import (
    REMOVE,
    Case,
    as_images,
    both,
    cell,
    check_one_clear_line,
    edit,
    heads,
    joints_with,
    rename_column,
    write,
)
from recording_files import COLUMNS, FPS, FRAMES, RecordingFolder, joint_rows, truncate, write_csv, write_video

from rmis_calib.errors import FileError, InputError, RecordingError, VideoError
from rmis_calib.io.recording import load_recording

CASES: dict[str, Case] = {
    # joints.csv.
    "NaN": (cell(5, 4, "nan"), RecordingError, r"joints\.csv line 5, column instrument\.pitch_rad: .*found 'nan'"),
    "inf": (
        cell(7, 2, "-inf"),
        RecordingError,
        r"joints\.csv line 7, column laparoscope\.insertion_mm: .*found '-inf'",
    ),
    "text": (cell(9, 1, "abc"), RecordingError, r"joints\.csv line 9, column laparoscope\.yaw_rad: .*found 'abc'"),
    "overflow": (cell(9, 1, "1e999"), RecordingError, "line 9, .*expected a finite number, found '1e999'"),
    "underscore": (cell(9, 1, "1_0"), RecordingError, "line 9, .*found '1_0'"),
    "empty cell": (cell(9, 1, ""), RecordingError, "line 9, column .*found an empty cell"),
    "decimal comma": (cell(9, 1, "0,5"), RecordingError, "line 9: expected 6 numbers, found 7"),
    "blank line": (
        lambda f: f.edit_line("joints.csv", 9, lambda _: ""),
        RecordingError,
        "line 9: .*found an empty line",
    ),
    "time backwards": (
        cell(30, 0, "0.1"),
        RecordingError,
        r"joints\.csv line 30, column timestamp_s: expected more than 0\.27 .*, found 0\.1 \(going back\)",
    ),
    "time repeated": (cell(30, 0, "0.27"), RecordingError, r"line 30, .*found 0\.27 \(repeated\)"),
    "zero bytes": (write("joints.csv", b""), RecordingError, r"joints\.csv: .*found an empty file"),
    "header only": (write("joints.csv", (",".join(COLUMNS) + "\n").encode()), RecordingError, "found no rows"),
    "not UTF-8 header": (
        write("joints.csv", b"timestamp_s,\xff\n1,2\n"),
        RecordingError,
        "line 1: .*UTF-8.* byte 0xff",
    ),
    "not UTF-8 body": (
        lambda f: (f.path / "joints.csv").write_bytes((f.path / "joints.csv").read_bytes() + b"\xe9,1,2,3,4,5\n"),
        RecordingError,
        "line 62: expected UTF-8 text, found byte 0xe9",
    ),
    "semicolons": (rename_column(",", ";"), RecordingError, "line 2: expected 6 numbers, found 1"),
    "missing column": (
        rename_column("instrument.yaw_rad", "timestamp"),
        RecordingError,
        r"missing instrument\.yaw_rad",
    ),
    "column twice": (rename_column("instrument.yaw", "laparoscope.yaw"), RecordingError, "yaw_rad twice"),
    "extra column": (
        lambda f: write_csv(f.path / "joints.csv", (*COLUMNS, "speed"), np.pad(joint_rows(), ((0, 0), (0, 1)))),
        RecordingError,
        "found unexpected speed",
    ),
    "metres suffix": (
        rename_column("instrument.insertion_mm", "instrument.insertion_m"),
        RecordingError,
        r"column instrument\.insertion_mm: expected a reading of -4\.8 to 244\.8 mm, found 1\d+",
    ),
    "another suffix": (
        rename_column("instrument.insertion_mm", "instrument.insertion_um"),
        RecordingError,
        r"line 1: wrong unit; expected instrument\.insertion_mm \(millimetres\), found instrument\.insertion_um",
    ),
    "no suffix": (rename_column("instrument.yaw_rad", "instrument.yaw"), RecordingError, "wrong unit; expected"),
    "arm not in use": (
        edit("recording.yaml", laparoscope_arm=None),
        RecordingError,
        r"expected columns of the arms in use \(instrument\), found laparoscope\.yaw_rad, whose arm",
    ),
    "prismatic in metres": (
        joints_with(lambda rows: rows.__setitem__((slice(None), 5), rows[:, 5] / 1000)),
        RecordingError,
        r"column instrument\.insertion_mm: looks like metres; write millimetres; .*all 60 readings below 1 mm",
    ),
    "revolute in degrees": (
        joints_with(lambda rows: rows.__setitem__((slice(20, None), 4), -35.0)),
        RecordingError,
        r"line 22, column instrument\.pitch_rad: looks like degrees; write radians; .*found -35",
    ),
    "above the limit": (
        joints_with(lambda rows: rows.__setitem__((slice(10, None), 5), 245.0)),
        RecordingError,
        r"line 12, column instrument\.insertion_mm: expected a reading of -4\.8 to 244\.8 mm, found 245",
    ),
    "below the limit": (
        joints_with(lambda rows: rows.__setitem__((slice(10, None), 3), -1.57)),
        RecordingError,
        "-1.56 to 1.56 rad",
    ),
    "no overlap in time": (
        edit("recording.yaml", clock_offset_s=100.0),
        RecordingError,
        r"joints at the time of some frame \(100 to 100\.44 s, .*found samples from 0 to 0\.59 s",
    ),
    # frame_times.csv.
    "frame number": (cell(5, 0, "4", "frame_times.csv"), RecordingError, r"line 5, column frame: expected 3 .*found 4"),
    "frame time back": (
        cell(5, 1, "0.01", "frame_times.csv"),
        RecordingError,
        r"line 5, column timestamp_s: .*going back",
    ),
    "frame time twice": (cell(5, 1, "0.08", "frame_times.csv"), RecordingError, r"line 5, .*\(repeated\)"),
    "frame times columns": (
        lambda f: f.edit_line("frame_times.csv", 1, lambda _: "frame,time_s"),
        RecordingError,
        "expected columns frame, timestamp_s, found missing timestamp_s",
    ),
    "video shorter": (
        lambda f: f.write_frame_times(np.arange(FRAMES + 3) / FPS),
        VideoError,
        r"right\.mp4: expected 15 frames as frame_times\.csv has, found 12 frames",
    ),
    "video longer": (
        lambda f: f.write_frame_times(np.arange(FRAMES - 2) / FPS),
        VideoError,
        r"right\.mp4: expected 10 frames as frame_times\.csv has, found 12 frames",
    ),
    # Pictures.
    "left shorter": (
        lambda f: write_video(f.path / "left.mp4", FRAMES - 1),
        VideoError,
        r"left\.mp4: expected 12 frames as right\.mp4 has, found 11 frames",
    ),
    "zero-byte video": (
        write("right.mp4", b""),
        VideoError,
        r"right\.mp4: expected a video, found an empty file \(0 bytes\)",
    ),
    "truncated video": (
        lambda f: truncate(f.path / "right.mp4", 0.6),
        VideoError,
        r"right\.mp4: expected a complete video, found a file cut short",
    ),
    "text as video": (write("right.mp4", b"hello " * 99), VideoError, r"right\.mp4: expected a complete video"),
    "wrong size": (
        lambda f: write_video(f.path / "right.mp4", size=(128, 64)),
        VideoError,
        r"right\.mp4: expected frames of 96 x 64 px as in stereo\.yaml, found 128 x 64",
    ),
    "size swapped": (edit("stereo.yaml", image_size=[64, 96]), VideoError, r"image_size is \[width, height\]"),
    "left at other times": (
        both(
            edit("recording.yaml", frame_times=REMOVE),
            lambda f: write_video(f.path / "left.mp4", pts=[*range(FRAMES - 1), FRAMES + 5]),
        ),
        VideoError,
        r"left\.mp4: expected the frame times of right\.mp4, or a frame_times file, found a difference of 0\.24 s",
    ),
    "images without times": (
        both(as_images(lambda _: None), edit("recording.yaml", frame_times=REMOVE)),
        RecordingError,
        "frame_times: expected a file with the time of each frame of right, found none",
    ),
    "one image less": (as_images(lambda p: (p / "0003.png").unlink()), VideoError, "left: expected 11 frames as right"),
    "truncated first image": (
        as_images(lambda p: truncate(p / "0000.png", 0.5)),
        VideoError,
        r"0000\.png: .*truncated",
    ),
    # head_points.csv.
    "head frame": (
        heads("frame,u_right_px,v_right_px\n12,1,1\n"),
        RecordingError,
        "line 2, column frame: .*0 to 11, found 12",
    ),
    "head frame twice": (heads("frame,u_right_px,v_right_px\n1,1,1\n1,1,1\n"), RecordingError, "line 3, .*repeated"),
    "head frame 1.5": (heads("frame,u_right_px,v_right_px\n1.5,1,1\n"), RecordingError, "line 2, .*found 1.5"),
    "head NaN": (heads("frame,u_right_px,v_right_px\n1,nan,1\n"), RecordingError, "line 2, column u_right_px: .*'nan'"),
    "head far away": (heads("frame,u_right_px,v_right_px\n1,1,999\n"), RecordingError, "-64 to 128 px, found 999"),
    "head column": (heads("frame,u_right_px,y\n1,1,1\n"), RecordingError, "missing v_right_px"),
    "head half left": (heads("frame,u_right_px,v_right_px,u_left_px\n1,1,1,1\n"), RecordingError, "missing v_left_px"),
}


@pytest.mark.parametrize("name", CASES)
def test_one_clear_line(folder: RecordingFolder, name: str) -> None:
    check_one_clear_line(folder, CASES[name])


def test_left_columns_need_a_left_camera(folder: RecordingFolder) -> None:
    folder.edit("recording.yaml", lambda raw: raw.pop("left"))
    folder.edit("stereo.yaml", lambda raw: (raw.pop("left"), raw.pop("camera_left_T_camera_right")))
    heads("frame,u_right_px,v_right_px,u_left_px,v_left_px\n1,1,1,1,1\n")(folder)
    with pytest.raises(RecordingError, match="found unexpected u_left_px, v_left_px"):
        load_recording(folder.path)


def test_no_folder_and_offset_that_is_not_finite(folder: RecordingFolder, tmp_path: Path) -> None:
    with pytest.raises(
        FileError, match="none: expected a recording: a folder with recording.yaml, found nothing there"
    ):
        load_recording(tmp_path / "none")
    with pytest.raises(InputError, match="clock_offset_s: expected a finite number of seconds, found nan"):
        load_recording(folder.path, clock_offset_s=float("nan"))


def test_preset_needs_all_joints_of_its_arms(folder: RecordingFolder) -> None:
    folder.edit("recording.yaml", lambda raw: raw.update(robot="dvrk-classic"))
    with pytest.raises(RecordingError, match=r"found missing laparoscope\.pitch_rad, .*instrument\.wrist_yaw_rad"):
        load_recording(folder.path)


def test_carriage_at_rest_is_not_taken_for_metres(folder: RecordingFolder) -> None:
    rows = joint_rows()
    rows[:, 2] = np.random.default_rng(0).normal(0, 0.02, len(rows))
    write_csv(folder.path / "joints.csv", COLUMNS, rows)
    load_recording(folder.path)


def test_a_little_beyond_a_limit_is_accepted(folder: RecordingFolder) -> None:
    joints_with(lambda rows: rows.__setitem__((slice(10, None), 5), 244.0))(folder)
    load_recording(folder.path)


def test_damage_later_in_a_video_shows_when_it_is_read(folder: RecordingFolder) -> None:
    as_images(lambda path: truncate(path / "0007.png", 0.5))(folder)
    recording = load_recording(folder.path)
    with pytest.raises(
        VideoError, match=r"0007\.png: expected a complete image, found a PNG without its end: truncated"
    ):
        list(recording.right.batches(4))
