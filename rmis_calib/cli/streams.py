"""Standard output that nobody may be reading: a closed pipe is no failure, a full device is one clear line."""

import os
import sys
from collections.abc import Iterator
from contextlib import contextmanager
from typing import Any


class GuardedStream:
    """A text stream that goes quiet once writing to it fails.

    Attributes:
        failure: why, unless the reader of a pipe has simply seen enough.
    """

    def __init__(self, stream: Any) -> None:
        self._stream = stream
        self.failure = ""
        self._is_quiet = False

    def write(self, text: str) -> int:
        """Write, or do nothing once it has failed."""
        if not self._is_quiet:
            try:
                self._stream.write(text)
            except OSError as error:
                self._go_quiet(error)
        return len(text)

    def flush(self) -> None:
        """Hand on what is buffered."""
        if not self._is_quiet:
            try:
                self._stream.flush()
            except OSError as error:
                self._go_quiet(error)

    def _go_quiet(self, error: OSError) -> None:
        self._is_quiet = True
        if not isinstance(error, BrokenPipeError):
            self.failure = error.strerror or str(error)
        # What is still buffered must go somewhere when Python ends.
        with open(os.devnull, "wb") as nowhere:
            os.dup2(nowhere.fileno(), self._stream.fileno())

    def __getattr__(self, name: str) -> Any:
        return getattr(self._stream, name)


@contextmanager
def guarded_output() -> Iterator[GuardedStream]:
    """Standard output and error, guarded while the block runs."""
    out, err = sys.stdout, sys.stderr
    guarded = GuardedStream(out)
    sys.stdout, sys.stderr = guarded, GuardedStream(err)  # type: ignore[assignment]
    try:
        yield guarded
    finally:
        sys.stdout.flush()
        sys.stderr.flush()
        sys.stdout, sys.stderr = out, err
