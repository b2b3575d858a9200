"""A batch in numbers: a row a recording and what set-ups show, as CSV, Parquet and JSON."""

import csv
import io
from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from rmis_calib.batches.job_record import JobRecord
from rmis_calib.batches.jobs import LeftOut
from rmis_calib.batches.setups import SetupComparison
from rmis_calib.io.atomic import atomic_write, write_json
from rmis_calib.io.outputs import check_file, is_json_of, is_report

PAGE = "index.html"
SUMMARY_FORMAT = "rmis-calib-batch-summary/1"
TIMES = ("seconds", "host", "written")
"""Keys in which two runs of the same work differ."""
_FIRST = (
    "name", "task", "outcome", "status", "failure", "message", "setup", "rotation_sigma_deg", "translation_sigma_mm",
    "working_point_sigma_mm", "motions_used", "motions", "frames", "clock_s", "clock_sigma_s",
)  # fmt: skip


@dataclass(frozen=True, eq=False)
class BatchSummary:
    """What a batch came to.

    Attributes:
        records: of every job, in the order of their names.
        setups: comparisons of the recordings of one set-up.
        left_out: what looked like work and was none.
        done_before: names of the jobs that had been done before.
        not_done: names of the jobs that were not begun (`fail_fast`, or interrupted).
    """

    records: tuple[JobRecord, ...]
    setups: tuple[SetupComparison, ...]
    left_out: tuple[LeftOut, ...] = ()
    done_before: tuple[str, ...] = ()
    not_done: tuple[str, ...] = ()

    @property
    def trustworthy(self) -> bool:
        """Whether every job was done and every result passed its own checks."""
        return not self.not_done and all(record.trustworthy for record in self.records)

    @property
    def counts(self) -> dict[str, int]:
        """How many ended each way: by verdict, `found` for detections, `failed`, `not done`."""
        ends = [end_of(record) for record in self.records] + ["not done"] * len(self.not_done)
        return {end: ends.count(end) for end in dict.fromkeys(ends)}

    def rows(self) -> list[dict[str, Any]]:
        """A flat row of plain values a job, all with the same keys; None for what is not known."""
        flat = [flat_row(record) for record in self.records]
        keys = [key for key in _FIRST if any(key in row for row in flat)]
        keys += sorted({key for row in flat for key in row} - set(keys) - set(TIMES)) + list(TIMES)
        return [{key: row.get(key) for key in keys} for row in flat]

    def to_dict(self) -> dict[str, Any]:
        return {
            "format": SUMMARY_FORMAT,
            "trustworthy": self.trustworthy,
            "counts": self.counts,
            "recordings": self.rows(),
            "setups": [setup_record(setup) for setup in self.setups],
            "left_out": [{"path": str(item.path), "why": item.why} for item in self.left_out],
            "not_done": list(self.not_done),
        }

    def write(self, folder: Path) -> None:
        """summary.json, summary.csv and summary.parquet, each whole or not at all.

        Raises:
            OutputError: another file is there, or it cannot be written.
        """
        write_json(folder / "summary.json", self.to_dict())
        rows = self.rows()
        text = io.StringIO()
        writer = csv.DictWriter(text, fieldnames=list(rows[0]) if rows else list(_FIRST), lineterminator="\n")
        writer.writeheader()
        writer.writerows(rows)
        with atomic_write(folder / "summary.csv") as temporary:
            temporary.write_text(text.getvalue(), encoding="utf-8")
        with atomic_write(folder / "summary.parquet") as temporary:
            write_parquet(temporary, rows)


def end_of(record: JobRecord) -> str:
    """How a job ended, in a word: its verdict, `found` or `failed`."""
    if record.outcome == "failed":
        return "failed"
    return "found" if record.task == "detect" else str(record.row.get("status"))


def flat_row(record: JobRecord) -> dict[str, Any]:
    """A record as plain values; stages as `seconds_<stage>` are left to the log."""
    row = {key: value for key, value in record.row.items() if key != "notes"}
    notes = record.row.get("notes") or []
    return {
        "name": record.name,
        "task": record.task,
        "outcome": record.outcome,
        "failure": record.failure,
        "message": record.message,
        "source": record.source,
        "notes": "; ".join(notes),
        "fingerprint": record.fingerprint,
        "seconds": record.seconds,
        "host": record.host,
        "written": record.written,
        **row,
    }


def setup_record(setup: SetupComparison) -> dict[str, Any]:
    """A comparison as plain values."""
    pooled, answer = setup.pooled, setup.answer
    agreement = None if pooled is None else pooled.agreement
    return {
        "setup": setup.setup,
        "recordings": list(setup.names),
        "sentences": setup.sentences(),
        "camera_right_T_arm": None if answer is None else answer.camera_right_T_arm.to_dict(),
        "covariance": None if answer is None else answer.covariance.tolist(),
        "rotation_sigma_deg": None if answer is None else answer.rotation_sigma_deg,
        "translation_sigma_mm": None if answer is None else answer.translation_sigma_mm,
        "agreement": None if agreement is None else vars(agreement),
        "outliers": list(setup.outliers),
        "deviation_rad_mm": None if pooled is None else pooled.deviation.tolist(),
        "changes": [
            {
                "before": setup.names[change.index],
                "rotation_deg": change.rotation_deg,
                "translation_mm": change.translation_mm,
                "probability": change.probability,
            }
            for change in setup.changes
        ],
        "drifts": [vars(item) for item in setup.drifts],
    }


def write_parquet(path: Path, rows: Sequence[dict[str, Any]]) -> None:
    """A table of flat rows; a column with values of several kinds becomes text."""
    import pyarrow
    import pyarrow.parquet

    columns = {key: _of_one_kind([row[key] for row in rows]) for key in (rows[0] if rows else {})}
    pyarrow.parquet.write_table(pyarrow.table(columns), path)


def _of_one_kind(values: Iterable[Any]) -> list[Any]:
    values = list(values)
    kinds = {type(value) for value in values if value is not None}
    if kinds <= {int, float} and float in kinds:
        return [None if value is None else float(value) for value in values]
    if len(kinds) > 1:
        return [None if value is None else str(value) for value in values]
    return values


def check_summary_files(folder: Path) -> None:
    """Refuse, before any work, an output folder in which somebody else's files have the summary's names.

    Raises:
        OutputError: a file of that name is none of ours.
    """
    tests = {"summary.json": is_json_of(SUMMARY_FORMAT), PAGE: is_report}
    for name, is_ours in tests.items():
        check_file(folder / name, is_ours, overwrite=True)
    has_summary = (folder / "summary.json").is_file()
    for name in ("summary.csv", "summary.parquet"):
        check_file(folder / name, lambda _: has_summary, overwrite=True)
