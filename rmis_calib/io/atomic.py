"""Outputs that are whole or absent: written under a temporary name beside the target, then renamed.

A rename inside one folder is atomic, so whoever looks sees the old content or the new one. An error or Ctrl-C removes
the temporary; a killed process leaves a name that starts with a dot and holds `.tmp`: nobody takes it for a result.
"""

import json
import os
import shutil
import tempfile
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import yaml

from rmis_calib.errors import InputError, OutputError, RmisCalibError
from rmis_calib.io.outputs import check_file, check_folder, is_json_of, remove_own, write_marker


@contextmanager
def atomic_write(path: str | Path) -> Iterator[Path]:
    """A temporary path with the suffix of `path`; becomes `path` when the block ends without an exception.

    Raises:
        OutputError: the folder of `path` is absent or not writable, or writing fails.
    """
    target = Path(path)
    temporary = _temporary_file(target)
    try:
        yield temporary
        _flush(temporary)
        temporary.replace(target)
        _flush(target.parent)
    except RmisCalibError:
        raise
    except OSError as error:
        raise _output_error(target, error) from error
    finally:
        temporary.unlink(missing_ok=True)


@contextmanager
def atomic_directory(path: str | Path, overwrite: bool = False) -> Iterator[Path]:
    """A temporary folder beside `path`; becomes `path` when the block ends without an exception.

    Args:
        path: the folder to make; its parents are made as needed. An existing empty folder is replaced.
        overwrite: replace an existing folder that holds something, if all of it was written by this program and has not
            changed since (outputs.py).

    Raises:
        OutputError: `path` is a file, holds something and may not be overwritten, contains the current folder, or
            cannot be written.
    """
    target = Path(path).absolute()
    check_folder(target, overwrite)
    try:
        target.parent.mkdir(parents=True, exist_ok=True)
        temporary = Path(tempfile.mkdtemp(prefix=f".{target.name}.", suffix=".tmp", dir=target.parent))
        temporary.chmod(0o777 & ~_umask())
    except OSError as error:
        raise _output_error(target, error) from error
    try:
        yield temporary
        write_marker(temporary)
        for folder, _, names in os.walk(temporary):
            for name in names:
                _flush(Path(folder, name))
        check_folder(target, overwrite)
        _swap(temporary, target)
    except RmisCalibError:
        raise
    except OSError as error:
        raise _output_error(target, error) from error
    finally:
        shutil.rmtree(temporary, ignore_errors=True)


def write_json(path: str | Path, value: Any, overwrite: bool = True) -> None:
    """Write plain values as indented JSON, whole or not at all.

    Args:
        path: a new file; or one of the same `format` as `value`, which is then replaced.
        value: plain values.
        overwrite: whether a file of that format may be replaced.

    Raises:
        InputError: a number is NaN or infinite (an unknown number is None).
        OutputError: another file is there, or the file cannot be written.
    """
    format_name = value.get("format") if isinstance(value, dict) else None
    check_file(Path(path), is_json_of(*([format_name] if format_name else [])), overwrite)
    try:
        text = json.dumps(value, indent=2, allow_nan=False, ensure_ascii=False)
    except ValueError as error:
        raise InputError(where=str(path), expected="finite numbers or None", found=str(error)) from error
    with atomic_write(path) as temporary:
        temporary.write_text(text + "\n", encoding="utf-8")


def write_yaml(path: str | Path, value: Any) -> None:
    """Write plain values as YAML in the order given, whole or not at all.

    Raises:
        OutputError: a file is there already, or it cannot be written.
    """
    check_file(Path(path), lambda _: False, overwrite=False)
    text = yaml.safe_dump(value, sort_keys=False, allow_unicode=True)
    with atomic_write(path) as temporary:
        temporary.write_text(text, encoding="utf-8")


def _temporary_file(target: Path) -> Path:
    if target.is_dir():
        raise OutputError(where=str(target), expected="a file to write", found="a folder")
    try:
        # The suffix stays, since image and array writers choose the format by it.
        handle, name = tempfile.mkstemp(prefix=f".{target.stem}.", suffix=f".tmp{target.suffix}", dir=target.parent)
        os.close(handle)
        os.chmod(name, 0o666 & ~_umask())
    except OSError as error:
        raise _output_error(target, error) from error
    return Path(name)


def _umask() -> int:
    """The process's file mode mask, which temporary files do not follow by themselves."""
    mask = os.umask(0o022)
    os.umask(mask)
    return mask


def _flush(path: Path) -> None:
    """Force a file or folder to the disk, so that a rename never becomes durable before the content."""
    if os.name != "posix":  # Windows cannot flush what is open for reading, nor folders.
        return
    handle = os.open(path, os.O_RDONLY)
    try:
        os.fsync(handle)
    finally:
        os.close(handle)


def _swap(temporary: Path, target: Path) -> None:
    """Put `temporary` in the place of `target`; the old content is removed only once the new one stands.

    Of the old content only files that its marker lists are deleted: what somebody else put there meanwhile stays, in a
    folder beside the new one.
    """
    target = target.resolve()
    if not target.exists():
        temporary.rename(target)
        return
    old = Path(tempfile.mkdtemp(prefix=f".{target.name}.", suffix=".old.tmp", dir=target.parent))
    try:
        # A rename onto an empty folder replaces it.
        target.rename(old)
        temporary.rename(target)
    except BaseException:
        if not target.exists():
            old.rename(target)
        raise
    finally:
        if target.exists():
            remove_own(old)


def _output_error(target: Path, error: OSError) -> OutputError:
    return OutputError(where=str(target), expected="a writable place", found=error.strerror or str(error))
