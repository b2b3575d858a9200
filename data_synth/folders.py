"""Folders that the generator makes, and may make anew: only where it wrote everything that is in them.

Each holds a marker with the names, sizes and digests of its files, in the format that `rmis_calib` uses, too.
"""

from __future__ import annotations

import hashlib
import json
import os
from pathlib import Path

MARKER = ".rmis-calib-output.json"
MARKER_FORMAT = "rmis-calib-output/1"


def check_replaceable(folder: Path, overwrite: bool) -> None:
    """Refuse a place where something is that the generator did not write.

    Raises:
        FileExistsError: says what is there.
    """
    if not os.path.lexists(folder):
        return
    if folder.is_dir() and not any(folder.iterdir()):
        return
    if not overwrite:
        raise FileExistsError(f"{folder}: a new name, or --overwrite (overwrite=True) to replace what is there")
    found = foreign_content(folder) if folder.is_dir() else folder.name
    if found is not None:
        raise FileExistsError(f"{folder}: a folder whose whole content this program wrote, not one with {found}")


def foreign_content(folder: Path) -> str | None:
    """The first file that the marker does not list, or that has changed; None where there is none."""
    try:
        record = json.loads((folder / MARKER).read_text(encoding="utf-8"))
        listed = record["files"] if record["format"] == MARKER_FORMAT else {}
    except (OSError, ValueError, KeyError, TypeError):
        return min(path.name for path in folder.iterdir())
    for path in sorted(folder.rglob("*")):
        name = path.relative_to(folder).as_posix()
        if name == MARKER or (path.is_dir() and not path.is_symlink()):
            continue
        if path.is_symlink() or listed.get(name) != _entry(path):
            return name
    return None


def write_marker(folder: Path) -> None:
    """List all files of a folder."""
    files = {path.relative_to(folder).as_posix(): _entry(path) for path in sorted(folder.rglob("*")) if path.is_file()}
    text = json.dumps({"format": MARKER_FORMAT, "written_by": "data_synth", "files": files}, indent=1)
    (folder / MARKER).write_text(text + "\n", encoding="utf-8")


def remove_listed(folder: Path) -> None:
    """Delete the files that the marker lists, and the folders that are then empty."""
    if (folder / MARKER).is_file():
        for name in [*json.loads((folder / MARKER).read_text(encoding="utf-8"))["files"], MARKER]:
            (folder / name).unlink(missing_ok=True)
    for path, _, files in os.walk(folder, topdown=False):
        if not files and not os.listdir(path):
            os.rmdir(path)


def _entry(path: Path) -> dict[str, int | str]:
    with path.open("rb") as file:
        digest = hashlib.file_digest(file, lambda: hashlib.blake2b(digest_size=16))
        return {"size": path.stat().st_size, "blake2b": digest.hexdigest()}
