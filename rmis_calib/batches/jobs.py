"""What a batch has to do: every recording of a tree, or the entries of a manifest, each with a place for its output."""

import csv
import os
from collections.abc import Iterator
from dataclasses import dataclass, replace
from pathlib import Path, PurePosixPath
from typing import Any, Literal

from rmis_calib.config import CalibrationConfig, load_config, parse_config
from rmis_calib.errors import FileError, InputError
from rmis_calib.io.configs import load_yaml, read_bytes, yaml_value
from rmis_calib.io.folders import DESCRIPTION, natural_order
from rmis_calib.io.readers import PICTURE_SUFFIXES, VIDEO_SUFFIXES

Task = Literal["calibrate", "detect"]
MANIFESTS = (".txt", ".csv", ".yaml", ".yml")
_LARGEST_MANIFEST = 64 * 2**20
ITSELF = "_itself"
"""Last part of the name of what lies in a folder that holds other recordings, so that no output contains another."""


@dataclass(frozen=True)
class Job:
    """One recording, video or folder of pictures to work on.

    Attributes:
        name: where its output lies below the output folder, parts joined by `/`.
        source: what to read.
        task: what to do with it.
        config: how.
        why: how it was found.
    """

    name: str
    source: Path
    task: Task
    config: CalibrationConfig
    why: str


@dataclass(frozen=True)
class LeftOut:
    """Something that looks like work and is none, and why."""

    path: Path
    why: str


def find_jobs(
    root: Path, task: Task, config: CalibrationConfig, skip: Path | None = None
) -> tuple[list[Job], list[LeftOut]]:
    """The work of a folder or a manifest, in the order of the names.

    Links are followed, once each; what begins with a dot is passed over.

    Args:
        root: a folder, or a manifest (`.txt`: a path a line; `.csv`: columns recording, name, config and settings by
            their dotted names; `.yaml`: `recordings`, a list of paths or of mappings with recording, name and config).
            Paths in a manifest count from its folder.
        task: `calibrate` takes recordings (folders with recording.yaml), `detect` also plain videos and folders of
            pictures.
        config: of every job; a manifest's entry may change it.
        skip: a folder in which nothing is looked for: the output.

    Raises:
        FileError: the root is not there or cannot be read.
        InputError, ConfigError: a manifest that is not one; names the entry.
    """
    if not root.exists():
        expected = f"a folder of recordings, or a manifest ({', '.join(MANIFESTS)})"
        raise FileError(where=str(root), expected=expected, found="nothing there")
    if root.is_dir():
        found, left_out = _search(root, task, skip)
        named = _apart([_relative(path, root) for path, _ in found], root.resolve().name)
        jobs = [Job(name, path, task, config, why) for name, (path, why) in zip(named, found, strict=True)]
    else:
        jobs, left_out = _listed(root, task, config), []
    return sorted(jobs, key=lambda job: natural_order(job.name)), left_out


def _search(root: Path, task: Task, skip: Path | None) -> tuple[list[tuple[Path, str]], list[LeftOut]]:
    """Recordings below a folder and, for `detect`, what else holds pictures, in no particular order."""
    found: list[tuple[Path, str]] = []
    left_out: list[LeftOut] = []
    avoided = None if skip is None or not skip.exists() else (skip.stat().st_dev, skip.stat().st_ino)
    seen: set[tuple[int, int]] = set()

    def refuse(error: OSError) -> None:
        left_out.append(LeftOut(Path(error.filename), f"cannot be read: {error.strerror}"))

    inside: set[str] = set()  # recordings, whose videos and pictures are theirs
    for folder, names, files in os.walk(root, followlinks=True, onerror=refuse):
        status = os.stat(folder)
        if (status.st_dev, status.st_ino) in seen or (status.st_dev, status.st_ino) == avoided:
            names.clear()
            continue
        seen.add((status.st_dev, status.st_ino))
        names[:] = sorted(name for name in names if not name.startswith("."))
        within = os.path.dirname(folder) in inside
        if DESCRIPTION in files:
            found.append((Path(folder), DESCRIPTION))
            within = True
        elif task == "detect" and not within:
            visible = [name for name in files if not name.startswith(".")]
            found += [(Path(folder, name), "video") for name in visible if _suffix(name) in VIDEO_SUFFIXES]
            pictures = [name for name in visible if _suffix(name) in PICTURE_SUFFIXES]
            others = [name for name in visible if _suffix(name) not in (*PICTURE_SUFFIXES, *VIDEO_SUFFIXES)]
            if pictures and others:
                left_out.append(LeftOut(Path(folder), f"a folder of pictures must hold nothing else: {others[0]}"))
            elif pictures:
                found.append((Path(folder), "folder of pictures"))
        if within:
            inside.add(folder)
    return found, left_out


def _suffix(name: str) -> str:
    return os.path.splitext(name)[1].lower()


def _relative(path: Path, root: Path) -> str:
    return path.relative_to(root).as_posix()


def _apart(names: list[str], root_name: str) -> list[str]:
    """Names of which none is a folder of another: `a` beside `a/b` becomes `a/_itself`."""
    folders = {str(parent) for name in names for parent in PurePosixPath(name).parents if name != "."}
    nested = [name in folders for name in names]
    own = [(root_name or ITSELF) if name == "." else name for name in names]
    return [
        (ITSELF if name == "." else f"{name}/{ITSELF}") if is_folder else given
        for name, given, is_folder in zip(names, own, nested, strict=True)
    ]


@dataclass(frozen=True)
class _Entry:
    """A line of a manifest."""

    source: str
    name: str | None
    config: str | dict[str, Any] | None
    where: str


def _listed(manifest: Path, task: Task, config: CalibrationConfig) -> list[Job]:
    readers = {".txt": _text_entries, ".csv": _csv_entries, ".yaml": _yaml_entries, ".yml": _yaml_entries}
    if manifest.suffix.lower() not in readers:
        expected = f"a folder, or a manifest ({', '.join(MANIFESTS)})"
        raise InputError(where=str(manifest), expected=expected, found=f"a file {manifest.suffix or 'without suffix'}")
    entries = list(readers[manifest.suffix.lower()](manifest))
    folder = manifest.parent.absolute()
    sources = [Path(os.path.normpath(folder / entry.source)) for entry in entries]
    common = Path(os.path.commonpath([source.parent for source in sources])) if sources else folder
    given = [entry.name or _relative(source, common) for entry, source in zip(entries, sources, strict=True)]
    for entry, name in zip(entries, given, strict=True):
        parts = PurePosixPath(name).parts
        if not parts or PurePosixPath(name).is_absolute() or ".." in parts or any(p.startswith(".") for p in parts):
            expected = "a relative path without `..` and hidden folders"
            raise InputError(where=f"{entry.where}: name", expected=expected, found=repr(name))
        if given.count(name) > 1:
            expected = "names that differ; give a `name`"
            raise InputError(where=entry.where, expected=expected, found=f"{name} {given.count(name)} times")
    jobs = []
    for entry, source, name in zip(entries, sources, _apart(given, folder.name), strict=True):
        jobs.append(Job(name, source, task, _changed(config, entry), entry.where.removeprefix(f"{manifest.parent}/")))
    return jobs


def _text_entries(manifest: Path) -> Iterator[_Entry]:
    for number, line in enumerate(_text(manifest).splitlines(), 1):
        path = line.partition("#")[0].strip()
        if path:
            yield _Entry(path, None, None, f"{manifest}, line {number}")


def _csv_entries(manifest: Path) -> Iterator[_Entry]:
    rows = csv.DictReader(_text(manifest).splitlines())
    columns = rows.fieldnames or ()
    if "recording" not in columns or len(set(columns)) < len(columns):
        expected, found = "columns of different names and a column called recording", ", ".join(columns) or "none"
        raise InputError(where=f"{manifest}, line 1", expected=expected, found=found)
    for row in rows:
        where = f"{manifest}, line {rows.line_num}"
        if None in row or None in row.values():
            raise InputError(where=where, expected=f"{len(columns)} values", found="another number")
        settings = {key: value for key, value in row.items() if key not in ("recording", "name", "config") and value}
        preset = row.get("config") or None
        if preset and settings:
            expected = "a config file or settings in columns of their own"
            raise InputError(where=where, expected=expected, found="both")
        group = next((key for key in settings if any(other.startswith(f"{key}.") for other in settings)), None)
        if group is not None:
            expected = "a setting or settings of a group, not both"
            raise InputError(where=where, expected=expected, found=f"{group} and settings below it")
        nested: dict[str, Any] = {}
        for key, value in settings.items():
            own: Any = yaml_value(value)
            for part in reversed(key.split(".")):
                own = {part: own}
            nested = _merged(nested, own)
        yield _Entry(row["recording"], row.get("name") or None, preset or nested or None, where)


def _yaml_entries(manifest: Path) -> Iterator[_Entry]:
    raw = load_yaml(manifest)
    entries = raw.get("recordings")
    if not isinstance(entries, list) or set(raw) != {"recordings"}:
        found = ", ".join(raw) if set(raw) != {"recordings"} else type(entries).__name__
        raise InputError(where=str(manifest), expected="recordings: a list", found=found)
    for number, item in enumerate(entries, 1):
        where = f"{manifest}, entry {number}"
        if isinstance(item, str):
            yield _Entry(item, None, None, where)
            continue
        known = {"recording", "name", "config"}
        is_text = isinstance(item, dict) and all(isinstance(item.get(key, ""), str) for key in ("recording", "name"))
        if not is_text or "recording" not in item or set(item) - known:
            expected = "a path, or a mapping with recording and, if wanted, name (words, not numbers) and config"
            raise InputError(where=where, expected=expected, found=str(item)[:80])
        yield _Entry(item["recording"], item.get("name"), item.get("config"), where)


def _text(path: Path) -> str:
    try:
        return read_bytes(path, _LARGEST_MANIFEST).decode("utf-8-sig")
    except UnicodeDecodeError as error:
        raise InputError(where=str(path), expected="text in UTF-8", found=str(error)) from error


def _changed(config: CalibrationConfig, entry: _Entry) -> CalibrationConfig:
    """The configuration with what an entry says: another one by its name or file, or some settings."""
    if entry.config is None:
        return config
    if isinstance(entry.config, str):
        return load_config(entry.config)
    if not isinstance(entry.config, dict):
        raise InputError(where=f"{entry.where}: config", expected="a name or settings", found=type(entry.config))
    return parse_config(_merged(config.to_dict(), entry.config), f"{entry.where}: config")


def _merged(base: dict[str, Any], changes: dict[str, Any]) -> dict[str, Any]:
    both = dict(base)
    for key, value in changes.items():
        inner = both.get(key)
        both[key] = _merged(inner, value) if isinstance(inner, dict) and isinstance(value, dict) else value
    return both


def with_device(job: Job, device: str) -> Job:
    """The job on another device."""
    return replace(job, config=replace(job.config, device=device))
