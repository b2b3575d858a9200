"""Tables of numbers as the world writes them: comma, semicolon or tab, quoted or not, decimal point or comma.

A file is parsed in blocks of lines, so that memory stays near the size of the numbers. Whatever was guessed is noted;
what cannot be a table of finite numbers is refused with its line.
"""

import re
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import TextIO

import numpy as np

from rmis_calib.errors import FileError, RecordingError
from rmis_calib.io._checks import Note, no_note
from rmis_calib.io.configs import check_regular

_NUMBER = re.compile(r"\s*[-+]?(\d+\.?\d*|\.\d+)([eE][-+]?\d+)?\s*\Z", re.ASCII)
_DECIMAL_COMMA = re.compile(r"\d,\d")
_INDEX_NAMES = ("", "Unnamed: 0", "index")
_BLOCK_CHARACTERS = 1 << 23
_LONGEST_LINE = 1 << 20
_SEPARATORS = {";": "semicolons", "\t": "tabs"}


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


@dataclass(frozen=True)
class _Dialect:
    """How a table is written.

    Attributes:
        separator: between the fields of a line.
        has_quotes, has_decimal_comma: what is to be rewritten before parsing.
        columns: names in the file, without the empty one of a comma at the end of the lines.
        has_end_separator: a separator after the last name; lines may have one too.
        has_index: the first column numbers the rows from 0.
    """

    separator: str
    has_quotes: bool
    has_decimal_comma: bool
    columns: tuple[str, ...]
    has_end_separator: bool
    has_index: bool

    def plain(self, line: str) -> str:
        """A line with decimal points, without quotes and without a separator at its end."""
        if self.has_quotes:
            line = line.replace('"', "")
        if self.has_decimal_comma:
            line = line.replace(",", ".")
        if self.has_end_separator and line.endswith(self.separator):
            line = line[: -len(self.separator)]
        return line


def read_table(path: str | Path, may_be_empty: bool = False, note: Note = no_note) -> Table:
    """A table with one header line; line ends of any kind, with or without a byte-order mark.

    Args:
        path: the file.
        may_be_empty: accept a header without rows.
        note: told of separators, decimal commas and columns that were guessed.

    Raises:
        FileError: the file is absent, unreadable or no ordinary file.
        RecordingError: it is not a table of finite numbers; names line and column.
    """
    path = Path(path)
    check_regular(path)
    try:
        with path.open(encoding="utf-8-sig") as file:
            dialect, values = _read(path, file)
    except OSError as error:
        raise FileError(where=str(path), expected="a readable file", found=error.strerror) from error
    except UnicodeDecodeError as error:
        raise _not_text(path) from error
    if not len(values) and not may_be_empty:
        raise RecordingError(where=str(path), expected="a header line and rows of numbers", found="no rows")
    columns = dialect.columns
    if dialect.has_index:
        if not np.array_equal(values[:, 0], np.arange(len(values))):
            found = f"{columns[0]!r} with other values than 0, 1, 2, ..."
            raise RecordingError(where=f"{path} line 1", expected="a name for every column", found=found)
        note(f"{path.name}: the first column numbers the rows and was left out")
        columns, values = columns[1:], values[:, 1:]
    if dialect.separator != ",":
        note(f"{path.name}: columns are separated by {_SEPARATORS[dialect.separator]}")
    if dialect.has_decimal_comma:
        note(f"{path.name}: a comma was read as the decimal sign")
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
            expected=f"more than {values[row - 1]:.15g} of the line above",
            found=f"{values[row]:.15g} ({trouble})",
        )
    return values


def _read(path: Path, file: TextIO) -> tuple[_Dialect, np.ndarray]:
    """The dialect and all values, (rows, columns of the file)."""
    header = file.readline(_LONGEST_LINE)
    if not header.strip("\0 \t\r\n"):
        raise RecordingError(where=str(path), expected="a header line and rows of numbers", found="an empty file")
    start = file.tell()
    dialect = _dialect(path, header.rstrip("\n"), file.readline(_LONGEST_LINE))
    file.seek(start)
    is_plain = not (dialect.has_quotes or dialect.has_decimal_comma or dialect.has_end_separator)
    blocks, number = [], 2
    for lines in _blocks(path, file):
        if not is_plain:
            lines = [dialect.plain(line) for line in lines]
        blocks.append(_parse(path, dialect, lines, number))
        number += len(lines)
    return dialect, np.concatenate(blocks) if blocks else np.empty((0, len(dialect.columns)))


def _blocks(path: Path, file: TextIO) -> Iterator[list[str]]:
    """Lines in blocks, without the empty ones at the end of the file."""
    empty: list[str] = []
    rest, number = "", 2
    while text := file.read(_BLOCK_CHARACTERS):
        whole, end, rest = (rest + text).rpartition("\n")
        lines = [*empty, *whole.split("\n")] if end else empty
        number += len(lines) - len(empty)
        if len(rest) > _LONGEST_LINE:
            raise RecordingError(where=f"{path} line {number}", expected="a line of numbers", found="one of megabytes")
        empty = []
        while lines and not lines[-1].strip():
            empty.append(lines.pop())
        if lines:
            yield lines
    if rest.strip():
        yield [*empty, rest]


def _dialect(path: Path, header: str, first: str) -> _Dialect:
    separator = next((sign for sign in _SEPARATORS if sign in header), ",")
    columns = [name.strip().strip('"').strip() for name in header.split(separator)]
    has_end = len(columns) > 1 and columns[-1] == ""
    columns = columns[:-1] if has_end else columns
    has_index = len(columns) > 1 and columns[0] in _INDEX_NAMES
    named = columns[1:] if has_index else columns
    if "" in named:
        raise RecordingError(where=f"{path} line 1", expected="a name for every column", found="an empty name")
    repeated = [name for i, name in enumerate(columns) if name in columns[:i]]
    if repeated:
        raise RecordingError(where=f"{path} line 1", expected="each column once", found=f"{repeated[0]} twice")
    # Lines may end with a separator although the header does not.
    has_end = has_end or first.rstrip("\n").count(separator) == len(columns)
    decimal_comma = separator != "," and bool(_DECIMAL_COMMA.search(first))
    return _Dialect(separator, '"' in first, decimal_comma, tuple(columns), has_end, has_index)


def _parse(path: Path, dialect: _Dialect, lines: list[str], number: int) -> np.ndarray:
    """Values of some lines, the first of which is line `number` of the file."""
    try:
        values = np.loadtxt(lines, delimiter=dialect.separator, comments=None, ndmin=2)
    except ValueError:
        values = np.empty((0, 0))
    if values.shape != (len(lines), len(dialect.columns)) or not np.isfinite(values).all():
        raise _first_problem(path, dialect, lines, number)
    return values


def _first_problem(path: Path, dialect: _Dialect, lines: list[str], first: int) -> RecordingError:
    """What a person must mend first, in reading order."""
    for number, line in enumerate(lines, start=first):
        place = f"{path} line {number}"
        if not line.strip():
            return RecordingError(where=place, expected=f"{len(dialect.columns)} numbers", found="an empty line")
        fields = line.split(dialect.separator)
        if len(fields) != len(dialect.columns):
            return RecordingError(where=place, expected=f"{len(dialect.columns)} numbers", found=len(fields))
        for column, field in zip(dialect.columns, fields, strict=True):
            # A huge exponent matches, and is infinite.
            if not _NUMBER.match(field) or not np.isfinite(float(field)):
                found = repr(field.strip()[:40]) if field.strip() else "an empty cell"
                return RecordingError(where=f"{place}, column {column}", expected="a finite number", found=found)
    return RecordingError(where=str(path), expected="a table of numbers", found="one that cannot be parsed")


def _not_text(path: Path) -> RecordingError:
    """Where a file stops being UTF-8 text."""
    number = 1
    with path.open("rb") as file:
        for number, line in enumerate(file, start=1):
            try:
                line.decode("utf-8")
            except UnicodeDecodeError as error:
                found = f"byte 0x{line[error.start]:02x}"
                return RecordingError(where=f"{path} line {number}", expected="UTF-8 text", found=found)
    return RecordingError(where=f"{path} line {number}", expected="UTF-8 text", found="a cut character")
