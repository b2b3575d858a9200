"""What may be written where: never into, onto or around an input, and never over what this program did not write.

A folder that the program makes holds a marker with the names, sizes and digests of its files. Only a folder whose whole
content is in its marker, unchanged, may be replaced; a file only if it says of itself that it is one of ours.
"""

import hashlib
import json
import os
import zipfile
from collections.abc import Callable, Iterable, Iterator
from pathlib import Path
from typing import Final

from rmis_calib import __version__
from rmis_calib.errors import FileError, InputError, OutputError
from rmis_calib.io.configs import check_regular, load_json

MARKER = ".rmis-calib-output.json"
MARKER_FORMAT = "rmis-calib-output/1"
RESULT_FORMAT: Final = "rmis-calib-result/1"
EVALUATION_FORMAT = "rmis-calib-evaluation/1"
BASELINE_FORMAT = "rmis-calib-baseline/1"
OBSERVATIONS_FORMAT = "rmis-calib-observations/1"
HTML_GENERATOR = '<meta name="generator" content="rmis-calib">'
_HEAD_BYTES = 4096
_OVERWRITE = "a new name, or --overwrite (overwrite=True) to replace it"


def check_apart(out: str | Path, inputs: Iterable[str | Path]) -> None:
    """Refuse an output that is an input, contains one, or lies in one; links count as what they lead to.

    Args:
        out: file or folder that is to be written; need not exist.
        inputs: files and folders that are read; those that do not exist are passed over.

    Raises:
        OutputError: names the input.
    """
    target = Path(os.path.realpath(out))
    above_target = _identities(target)
    for given in inputs:
        source = Path(os.path.realpath(given))
        if not source.exists():
            continue
        own = _identity(source)
        if target == source or _identity(target) == own:
            what = "the input itself"
        elif own in above_target and source.is_dir():
            what = "a place inside it"
        elif target.is_dir() and _identity(target) in _identities(source):
            what = "a folder that contains it"
        else:
            continue
        raise OutputError(where=str(out), expected=f"an output apart from the input {given}", found=what)


def numbered(stem: Path, suffix: str = "") -> Path:
    """`stem` + suffix if nothing is there, else the first of `stem_2`, `stem_3`, ... where nothing is."""
    number, path = 1, stem.with_name(stem.name + suffix)
    while os.path.lexists(path):
        number += 1
        path = stem.with_name(f"{stem.name}_{number}{suffix}")
    return path


def check_folder(target: Path, overwrite: bool) -> None:
    """Whether a folder may be made, or made anew, at a place.

    Raises:
        OutputError: a file is there; or a folder with content, and `overwrite` is false or not all of it is ours; or it
            is the current folder or one above it.
    """
    if not os.path.lexists(target):
        return
    if not target.is_dir():
        raise OutputError(where=str(target), expected="a folder to write", found="a file")
    if Path.cwd().is_relative_to(target.resolve()):
        found = "the current folder or one above it"
        raise OutputError(where=str(target), expected="an output folder of its own", found=found)
    if not any(target.iterdir()):
        return
    if not overwrite:
        raise OutputError(where=str(target), expected=_OVERWRITE, found="a folder with content")
    foreign = foreign_content(target)
    if foreign is not None:
        expected = "a folder whose whole content this program wrote: move that file, or choose another name"
        raise OutputError(where=str(target), expected=expected, found=f"{foreign}, which is not of this program")


def foreign_content(folder: Path) -> str | None:
    """The first thing in a folder that its marker does not list or that has changed since; None where all is ours."""
    listed = _read_marker(folder)
    if listed is None:
        return next((path.name for path in sorted(folder.iterdir())), None)
    for path in _walk(folder):
        name = path.relative_to(folder).as_posix()
        if name == MARKER:
            continue
        if path.is_symlink() or not path.is_file() or name not in listed:
            return name
        size, digest = listed[name]
        if path.stat().st_size != size or _digest(path) != digest:
            return f"{name} (changed since it was written)"
    return None


def write_marker(folder: Path) -> None:
    """List all files of a folder that the program has made, as its own."""
    files = {
        path.relative_to(folder).as_posix(): {"size": path.stat().st_size, "blake2b": _digest(path)}
        for path in _walk(folder)
        if path != folder / MARKER
    }
    record = {"format": MARKER_FORMAT, "written_by": f"rmis_calib {__version__}", "files": files}
    (folder / MARKER).write_text(json.dumps(record, indent=1) + "\n", encoding="utf-8")


def remove_own(folder: Path) -> None:
    """Delete the files that a folder's marker lists, and the folders that are then empty; all else stays."""
    for name in [*(_read_marker(folder) or {}), MARKER]:
        (folder / name).unlink(missing_ok=True)
    for path, _, _ in os.walk(folder, topdown=False):
        try:
            os.rmdir(path)
        except OSError:  # something else is in it
            continue


def check_file(target: Path, is_ours: Callable[[Path], bool], overwrite: bool) -> None:
    """Whether a file may be written, or written anew, at a place.

    Raises:
        OutputError: a folder is there; or a file, and `overwrite` is false or the file is not ours.
    """
    if not os.path.lexists(target):
        return
    if target.is_dir():
        raise OutputError(where=str(target), expected="a file to write", found="a folder")
    if not target.is_file():
        raise OutputError(where=str(target), expected="an ordinary file or a new one", found="a device, pipe or link")
    if not is_ours(target):
        expected = "a new name, or a file of the same kind that this program wrote"
        raise OutputError(where=str(target), expected=expected, found="another file")
    if not overwrite:
        raise OutputError(where=str(target), expected=_OVERWRITE, found="a file that exists")


def is_json_of(*formats: str) -> Callable[[Path], bool]:
    """A test for JSON files whose `format` is one of these."""

    def test(path: Path) -> bool:
        try:
            return load_json(path).get("format") in formats
        except (FileError, InputError):
            return False

    return test


def is_report(path: Path) -> bool:
    """Whether a file is a report page of this program."""
    try:
        with path.open("rb") as file:
            return HTML_GENERATOR.encode() in file.read(_HEAD_BYTES)
    except OSError:
        return False


def is_npz_with(name: str) -> Callable[[Path], bool]:
    """A test for .npz files that hold an array of this name."""

    def test(path: Path) -> bool:
        try:
            check_regular(path)
            with zipfile.ZipFile(path) as archive:
                return f"{name}.npy" in archive.namelist()
        except (OSError, FileError, zipfile.BadZipFile):
            return False

    return test


def _walk(folder: Path) -> Iterator[Path]:
    """Everything below a folder that is not an ordinary folder, sorted; links are not followed."""
    for path, names, files in os.walk(folder):
        names.sort()
        links = [name for name in names if os.path.islink(os.path.join(path, name))]
        yield from (Path(path, name) for name in sorted([*files, *links]))


def _read_marker(folder: Path) -> dict[str, tuple[int, str]] | None:
    marker = folder / MARKER
    if marker.is_symlink() or not marker.is_file():
        return None
    try:
        raw = json.loads(marker.read_text(encoding="utf-8"))
        if raw["format"] != MARKER_FORMAT:
            return None
        return {str(name): (int(item["size"]), str(item["blake2b"])) for name, item in raw["files"].items()}
    except (OSError, ValueError, KeyError, TypeError, AttributeError, RecursionError):
        return None


def _digest(path: Path) -> str:
    with path.open("rb") as file:
        return hashlib.file_digest(file, lambda: hashlib.blake2b(digest_size=16)).hexdigest()


def _identity(path: Path) -> tuple[int, int] | None:
    """What a path is on its disk, whatever it is called; None where nothing is."""
    try:
        status = path.stat()
    except OSError:
        return None
    return status.st_dev, status.st_ino


def _identities(path: Path) -> set[tuple[int, int]]:
    """Of a path and of every folder that it lies in."""
    return {own for place in (path, *path.parents) if (own := _identity(place)) is not None}
