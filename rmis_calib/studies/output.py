"""What a study leaves: every trial as CSV and Parquet, medians, figures, one page, and how it was made."""

import csv
import io
import sys
from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

from rmis_calib.io.atomic import atomic_write, write_json
from rmis_calib.io.plain_values import finite_or_none
from rmis_calib.results import package_versions
from rmis_calib.studies.engine import PAGE, RECORD, STUDY_FORMAT
from rmis_calib.studies.figures import write_figure
from rmis_calib.studies.page import Table, write_page
from rmis_calib.studies.plots import Figure

if TYPE_CHECKING:
    import pyarrow

TRIALS_CSV, TRIALS_PARQUET, SUMMARY = "trials.csv", "trials.parquet", "summary.csv"


@dataclass(frozen=True)
class StudyResult:
    """A finished study.

    Attributes:
        kind: of study.
        table: a row a trial.
        summary: a row a condition, with the same keys.
        sentences: what was found.
        figures: what was drawn.
        tables: what was found, in print.
        folder: where all of it is.
        reached: whether what was asked for can be had (`plan`).
    """

    kind: str
    table: "pyarrow.Table"
    summary: tuple[dict[str, Any], ...]
    sentences: tuple[str, ...]
    figures: tuple[Figure, ...]
    tables: tuple[Table, ...]
    folder: Path
    reached: bool = True

    @property
    def page(self) -> Path:
        return self.folder / PAGE


def output_names(figures: Sequence[str]) -> list[str]:
    """Files that a study writes beside its record and its page."""
    return [TRIALS_CSV, TRIALS_PARQUET, SUMMARY, *(f"{name}.{end}" for name in figures for end in ("pdf", "png"))]


def write_record(folder: Path, kind: str, settings: Any, command: str | None) -> dict[str, str]:
    """Write study.json, before any work, so that the folder says what is in it; returns how the study is made, for
    figures and page."""
    versions = {name: version for name, version in package_versions().items() if version is not None}
    command = command or f"rmis_calib.study_{kind}(...) in {Path(sys.argv[0]).name or 'Python'}"
    record = {
        "format": STUDY_FORMAT,
        "study": kind,
        "command": command,
        "seed": settings.run.seed,
        "versions": versions,
        "settings": asdict(settings),
    }
    write_json(folder / RECORD, finite_or_none(record))
    return {
        "command": command,
        "seed": str(settings.run.seed),
        "versions": ", ".join(f"{name} {version}" for name, version in versions.items()),
    }


def write_study(result: StudyResult, title: str, about: Mapping[str, str]) -> None:
    """Write everything but the record, each file whole or not at all.

    Raises:
        OutputError: the folder cannot be written.
    """
    import pyarrow.csv
    import pyarrow.parquet

    described = result.table.replace_schema_metadata({**about})
    with atomic_write(result.folder / TRIALS_PARQUET) as temporary:
        pyarrow.parquet.write_table(described, temporary)
    with atomic_write(result.folder / TRIALS_CSV) as temporary:
        pyarrow.csv.write_csv(result.table, temporary)
    with atomic_write(result.folder / SUMMARY) as temporary:
        temporary.write_text(_csv(result.summary, about), encoding="utf-8")
    for figure in result.figures:
        write_figure(result.folder, figure, about)
    write_page(result.page, title, result.sentences, result.figures, result.tables, about)


def _csv(rows: Sequence[Mapping[str, Any]], about: Mapping[str, str]) -> str:
    text = io.StringIO()
    writer = csv.DictWriter(text, fieldnames=[*rows[0], *about], lineterminator="\n")
    writer.writeheader()
    writer.writerows([{**row, **about} for row in rows])
    return text.getvalue()
