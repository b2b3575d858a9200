"""Where a recording is, and the order of names. Imports nothing heavy, so that a wrong path is told at once."""

import re
from pathlib import Path

from rmis_calib.errors import FileError

DESCRIPTION = "recording.yaml"
"""The file that makes a folder a recording."""


def recording_folder(path: str | Path) -> Path:
    """The folder of a recording, given itself or its recording.yaml.

    Raises:
        FileError: nothing is there, or no recording; says where one may be.
    """
    path = Path(path)
    folder = path.parent if path.name == DESCRIPTION else path
    expected = f"a recording: a folder with {DESCRIPTION}"
    if not folder.exists():
        raise FileError(where=str(path), expected=expected, found="nothing there")
    if not folder.is_dir():
        raise FileError(where=str(path), expected=expected, found="a file")
    if not (folder / DESCRIPTION).exists():
        inside = sorted(item.parent for item in folder.glob(f"*/{DESCRIPTION}"))
        hint = f" (did you mean {inside[0]}?)" if inside else ""
        raise FileError(where=str(path), expected=expected, found=f"a folder without it{hint}")
    return folder


def natural_order(name: str) -> list[str | int]:
    """Sort key in which `case_10` comes after `case_9`: text and numbers in turn, text first."""
    parts: list[str | int] = [*re.split(r"([0-9]+)", name)]
    parts[1::2] = map(int, parts[1::2])
    return parts
