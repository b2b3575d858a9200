"""Strict tables of numbers: parsed by NumPy at full speed, and searched line by line only to say what is wrong."""

import re
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from rmis_calib.errors import FileError, RecordingError
from rmis_calib.io.configs import read_bytes

_NUMBER = re.compile(r"\s*[-+]?(\d+\.?\d*|\.\d+)([eE][-+]?\d+)?\s*\Z", re.ASCII)
_BOM = b"\xef\xbb\xbf"


@dataclass(frozen=True)
class Table:
    """Columns of finite numbers; row i stands on line i + 2 of the file.

    Attributes:
        path: the file.
        columns: names in the header.
        values: (rows, columns).
    """

    path: Path
    columns: tuple[str, ...]
    values: np.ndarray

    def where(self, row: int, column: str | None = None) -> str:
        """Place of an entry, for messages."""
        place = f"{self.path} line {row + 2}"
        return place if column is None else f"{place}, column {column}"


def read_table(path: str | Path, may_be_empty: bool = False) -> Table:
    """A comma-separated table with one header line. A byte-order mark and CR LF line ends are accepted.

    Args:
        path: the file.
        may_be_empty: accept a header without rows.

    Raises:
        FileError: the file is absent or unreadable.
        RecordingError: it is not a table of finite numbers; names line and column.
    """
    path = Path(path)
    data = read_bytes(path).removeprefix(_BOM).rstrip()
    header, _, body = data.partition(b"\n")
    columns = _parse_header(path, header)
    if not body and may_be_empty:
        return Table(path, columns, np.empty((0, len(columns))))
    if not body:
        raise RecordingError(where=str(path), expected="a header line and rows of numbers", found="no rows")
    rows = body.count(b"\n") + 1
    try:
        # By path: NumPy reads a file in its own loop, in half the time it takes over a list of lines.
        values = np.loadtxt(path, delimiter=",", skiprows=1, comments=None, ndmin=2, encoding="utf-8-sig")
    except ValueError:
        values = np.empty((0, 0))
    except OSError as error:
        raise FileError(where=str(path), expected="a readable file", found=error.strerror) from error
    if values.shape != (rows, len(columns)) or not np.isfinite(values).all():
        raise _first_problem(path, columns, body)
    return Table(path, columns, values)


def require_columns(table: Table, expected: tuple[str, ...]) -> None:
    """Refuse a table whose columns are not the expected ones, in any order.

    Raises:
        RecordingError: a column is missing or not expected.
    """
    missing = [column for column in expected if column not in table.columns]
    extra = [column for column in table.columns if column not in expected]
    for label, columns in (("missing", missing), ("unexpected", extra)):
        if columns:
            found = f"{label} {', '.join(columns)}"
            raise RecordingError(where=f"{table.path} line 1", expected=f"columns {', '.join(expected)}", found=found)


def require_increasing(table: Table, column: str) -> np.ndarray:
    """The column, (rows,).

    Raises:
        RecordingError: a value does not exceed the one above it.
    """
    values = table.values[:, table.columns.index(column)]
    bad = np.diff(values) <= 0
    if bad.any():
        row = int(bad.argmax()) + 1
        trouble = "repeated" if values[row] == values[row - 1] else "going back"
        raise RecordingError(
            where=table.where(row, column),
            expected=f"more than {values[row - 1]:.9g} of the line above",
            found=f"{values[row]:.9g} ({trouble})",
        )
    return values


def _parse_header(path: Path, header: bytes) -> tuple[str, ...]:
    if not header.strip():
        raise RecordingError(where=str(path), expected="a header line and rows of numbers", found="an empty file")
    try:
        text = header.decode("utf-8")
    except UnicodeDecodeError as error:
        found = f"byte 0x{header[error.start]:02x}"
        raise RecordingError(where=f"{path} line 1", expected="UTF-8 text", found=found) from error
    columns = tuple(name.strip() for name in text.split(","))
    if ";" in text or "\t" in text:
        raise RecordingError(where=f"{path} line 1", expected="columns separated by commas", found=text.strip()[:60])
    if "" in columns:
        raise RecordingError(where=f"{path} line 1", expected="a name for every column", found="an empty name")
    repeated = [name for i, name in enumerate(columns) if name in columns[:i]]
    if repeated:
        raise RecordingError(where=f"{path} line 1", expected="each column once", found=f"{repeated[0]} twice")
    return columns


def _first_problem(path: Path, columns: tuple[str, ...], body: bytes) -> RecordingError:
    """What a person must mend first, in reading order."""
    for number, line in enumerate(body.split(b"\n"), start=2):
        place = f"{path} line {number}"
        try:
            text = line.decode("utf-8")
        except UnicodeDecodeError as error:
            return RecordingError(where=place, expected="UTF-8 text", found=f"byte 0x{line[error.start]:02x}")
        if not text.strip():
            return RecordingError(where=place, expected=f"{len(columns)} numbers", found="an empty line")
        fields = text.split(",")
        if len(fields) != len(columns):
            return RecordingError(where=place, expected=f"{len(columns)} numbers", found=len(fields))
        for column, field in zip(columns, fields, strict=True):
            # A huge exponent matches, and is infinite.
            if not _NUMBER.match(field) or not np.isfinite(float(field)):
                found = repr(field.strip()[:40]) if field.strip() else "an empty cell"
                return RecordingError(where=f"{place}, column {column}", expected="a finite number", found=found)
    return RecordingError(where=str(path), expected="a table of numbers", found="line ends of mixed kinds")
