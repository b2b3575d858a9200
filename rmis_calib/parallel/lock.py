"""Who works on an output folder: one process at a time, and a dead one does not count.

The lock is the kernel's (flock, through filelock), which lets go when its holder dies, however it dies. Beside it
stands who holds it, for people.
"""

import json
import os
import socket
from collections.abc import Iterator
from contextlib import contextmanager
from datetime import UTC, datetime
from pathlib import Path

from filelock import FileLock, Timeout

from rmis_calib.errors import OutputError


@contextmanager
def locked(folder: Path, what: str = "batch") -> Iterator[str | None]:
    """Hold the lock of an output folder; gives who held it before and died with it, in words.

    Args:
        folder: exists.
        what: kind of work, in a word.

    Raises:
        OutputError: another such work is going on there; says which. Or the folder cannot be written.
    """
    lock = FileLock(folder / f".rmis-calib-{what}.lock", timeout=0)
    try:
        lock.acquire()
    except Timeout as error:
        holder = _holder(folder, what) or f"another {what}"
        expected = "an output folder that nobody is at work in"
        raise OutputError(where=str(folder), expected=expected, found=holder) from error
    except OSError as error:
        expected = "a folder that can be written and locked"
        raise OutputError(where=str(folder), expected=expected, found=error.strerror) from error
    try:
        dead = _holder(folder, what)
        now = datetime.now(UTC).isoformat(timespec="seconds")
        holder = {"host": socket.gethostname(), "pid": os.getpid(), "since": now}
        holder_file(folder, what).write_text(json.dumps(holder) + "\n", encoding="utf-8")
        yield dead
    finally:
        holder_file(folder, what).unlink(missing_ok=True)
        lock.release()


def holder_file(folder: Path, what: str = "batch") -> Path:
    """Where it stands who holds the lock."""
    return folder / f".rmis-calib-{what}.holder.json"


def _holder(folder: Path, what: str) -> str | None:
    """Who says to be at work; None where nobody does."""
    try:
        raw = json.loads(holder_file(folder, what).read_text(encoding="utf-8"))
        return f"a {what} on {raw['host']}, process {raw['pid']}, since {raw['since']}"
    except (OSError, ValueError, KeyError, TypeError):
        return None
