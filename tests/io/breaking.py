"""Ways to break a recording, for the tests that ask what is said about it."""

import re
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from recording_files import COLUMNS, RecordingFolder, joint_rows, write_csv, write_images

from rmis_calib.errors import FileError, InputError
from rmis_calib.io.recording import load_recording

Break = Callable[[RecordingFolder], Any]
REMOVE = object()
Case = tuple[Break, type[Exception], str]


def edit(name: str, **changes: Any) -> Break:
    """Set keys of a YAML file; a key `a__b` is `b` inside `a`, and REMOVE takes it out."""

    def change(raw: dict) -> None:
        for path, value in changes.items():
            *parents, key = path.split("__")
            node: Any = raw
            for parent in parents:
                node = node[int(parent) if parent.isdigit() else parent]
            if value is REMOVE:
                del node[key]
            else:
                node[int(key) if key.isdigit() else key] = value

    return lambda folder: folder.edit(name, change)


def cell(row: int, column: int, text: str, name: str = "joints.csv") -> Break:
    """Replace one cell; `row` is a line number of the file."""

    def change(line: str) -> str:
        cells = line.split(",")
        cells[column] = text
        return ",".join(cells)

    return lambda folder: folder.edit_line(name, row, change)


def remove(name: str) -> Break:
    return lambda folder: (folder.path / name).unlink()


def joints_with(change: Callable[[np.ndarray], Any]) -> Break:
    def apply(folder: RecordingFolder) -> None:
        rows = joint_rows()
        change(rows)
        write_csv(folder.path / "joints.csv", COLUMNS, rows)

    return apply


def rename_column(old: str, new: str) -> Break:
    return lambda folder: folder.edit_line("joints.csv", 1, lambda line: line.replace(old, new))


def write(name: str, content: bytes) -> Break:
    return lambda folder: (folder.path / name).write_bytes(content)


def heads(text: str) -> Break:
    return write("head_points.csv", text.encode())


def as_images(change: Callable[[Path], Any]) -> Break:
    """Both videos as folders of images, the right one then changed."""

    def apply(folder: RecordingFolder) -> None:
        for side in ("right", "left"):
            write_images(folder.path / side)
            edit("recording.yaml", **{side: side})(folder)
        change(folder.path / "right")

    return apply


def both(*breaks: Break) -> Break:
    return lambda folder: [change(folder) for change in breaks]


def check_one_clear_line(folder: RecordingFolder, case: Case) -> None:
    """Break the recording, load it, and look at what it says."""
    change, error, message = case
    change(folder)
    with pytest.raises(error) as caught:
        load_recording(folder.path)
    text = str(caught.value)
    assert re.search(message, text), text
    assert "\n" not in text and isinstance(caught.value, (InputError, FileError))
    assert len(text) - len(str(folder.path)) < 330, text
