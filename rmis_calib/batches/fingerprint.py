"""What the answer of a job depends on, as one number: the same number, and it need not be computed again."""

import hashlib
import json
import os
from collections.abc import Iterator
from pathlib import Path

from rmis_calib import __version__
from rmis_calib.batches.jobs import Job
from rmis_calib.errors import RmisCalibError
from rmis_calib.io.configs import load_yaml
from rmis_calib.io.folders import DESCRIPTION

WHOLE_BYTES = 2**20
"""Files up to this size are read whole; of longer ones, with their size and time of change, some places."""
_SAMPLES, _SAMPLE_BYTES = 16, 2**14


_KNOWN: dict[bytes, str] = {}
"""Fingerprints by what the file system says of the inputs: a watch asks often, and reads only what has changed."""


def fingerprint(job: Job, effect: str) -> str:
    """A digest of the inputs, the configuration and the program's version.

    Of a small file the content counts, of a video its size, its time of change and 16 places spread over it. What
    cannot be read counts as such: a recording that is mended has another fingerprint.

    Args:
        job: what to do.
        effect: settings of the batch that change what is written.
    """
    values = {"version": __version__, "task": job.task, "config": job.config.to_dict(), "effect": effect}
    head = json.dumps(values, sort_keys=True, default=str).encode()
    inputs = sorted(_inputs(job))
    look, digest = hashlib.blake2b(head), hashlib.blake2b(head, digest_size=16)
    for name, path in inputs:
        look.update(f"\0{name}\0{path}\0{_status(path)}".encode("utf-8", "surrogateescape"))
    if look.digest() not in _KNOWN:
        for name, path in inputs:
            digest.update(f"\0{name}\0".encode("utf-8", "surrogateescape"))
            _add_file(digest, path)
        _KNOWN[look.digest()] = digest.hexdigest()
    return _KNOWN[look.digest()]


def size_bytes(job: Job) -> int:
    """Bytes of all inputs: how long a job will take, as far as anyone knows before its pictures are counted."""
    total = 0
    for _, path in _inputs(job):
        try:
            total += path.stat().st_size
        except OSError:
            continue
    return total


def last_change_s(job: Job) -> float:
    """When a file of the inputs was last changed, s since 1970; 0 where there is none."""
    times = [0.0]
    for _, path in _inputs(job):
        try:
            times.append(path.stat().st_mtime)
        except OSError:
            continue
    return max(times)


def _inputs(job: Job) -> Iterator[tuple[str, Path]]:
    """Every file that a job reads, with a name that does not depend on where the tree lies."""
    yield from _files(job.source, "")
    for key, value in (("masks", job.config.masks), ("prior", job.config.prior)):
        if value is not None:
            yield from _files(Path(value), f"{key}:")
    try:
        raw = load_yaml(job.source / DESCRIPTION)
    except RmisCalibError:
        return
    entries = [(key, value) for key, value in raw.items() if not isinstance(value, dict)]
    entries += [
        (f"{key}.{part}", v) for key, value in raw.items() if isinstance(value, dict) for part, v in value.items()
    ]
    for key, value in entries:
        if isinstance(value, str) and "\0" not in value and (job.source / value).exists():
            path = job.source / value
            if not path.resolve().is_relative_to(job.source.resolve()):
                yield from _files(path, f"{key}:")


def _files(path: Path, prefix: str) -> Iterator[tuple[str, Path]]:
    """A file itself, or what a folder holds; recordings in a recording are not part of it."""
    if not path.is_dir():
        yield f"{prefix}{path.name}", path
        return
    for folder, names, files in os.walk(path):
        if Path(folder) != path and DESCRIPTION in files:
            names.clear()
            continue
        names[:] = [name for name in names if not name.startswith(".")]
        for name in files:
            if not name.startswith("."):
                yield f"{prefix}{Path(folder, name).relative_to(path).as_posix()}", Path(folder, name)


def _status(path: Path) -> str:
    """Changes whenever the content of a file may have: the time of the last change of its entry cannot be set back."""
    try:
        status = path.stat()
        return f"{status.st_ino} {status.st_size} {status.st_mtime_ns} {status.st_ctime_ns}"
    except OSError as error:
        return f"unreadable {error.errno}"


def _add_file(digest: "hashlib.blake2b", path: Path) -> None:
    try:
        if not path.is_file():  # a pipe or a device, which might never end
            digest.update(b"no file")
            return
        size = path.stat().st_size
        with path.open("rb") as file:
            if size <= WHOLE_BYTES:
                digest.update(file.read(WHOLE_BYTES))
                return
            digest.update(f"{size} {path.stat().st_mtime_ns}".encode())
            for place in range(_SAMPLES):
                file.seek((size - _SAMPLE_BYTES) * place // (_SAMPLES - 1))
                digest.update(file.read(_SAMPLE_BYTES))
    except OSError as error:
        digest.update(f"unreadable {error.errno}".encode())
