"""The sub-commands for many recordings or results: `batch` and `compare`."""

from dataclasses import dataclass, field
from pathlib import Path
from typing import Annotated, Literal

import tyro

from rmis_calib.batches.settings import BatchSettings
from rmis_calib.cli.batch_console import (
    batch_reporter,
    conclude_batch,
    conclude_comparison,
    say_plan,
    stopped_by_signal,
)
from rmis_calib.cli.estimates import Estimates
from rmis_calib.cli.paths import named_beside
from rmis_calib.io.configs import check_regular


@dataclass(frozen=True, kw_only=True)
class Batch(Estimates):
    """Calibrate, or detect in, every recording below a folder or in a manifest, side by side.

    Writes OUT/NAME a recording, OUT/index.html, OUT/summary.csv, .parquet and .json. What is done already with the same
    inputs and settings is passed over, so an interrupted batch goes on where it stopped. Exit code 0: every result
    passed its own checks; 1: one did not, or a recording failed.
    """

    root: tyro.conf.Positional[Path]
    """Folder that is searched for recordings; or a manifest: .txt (a path a line), .csv (recording, name, config, and
    settings by their dotted names) or .yaml (recordings: [{recording, name, config}])."""
    out: Path | None = None
    """Folder to write, or to go on with. Default: RECORDINGS_batch."""
    task: Literal["calibrate", "detect"] = "calibrate"
    """What to do; detect takes plain videos and folders of pictures, too."""
    dry_run: bool = False
    """List what would be done, and why; write nothing."""
    batch: Annotated[BatchSettings, tyro.conf.arg(name="")] = field(default_factory=BatchSettings)

    def run(self) -> int:
        self.inputs()
        config = self.resolved()
        out = self.out or named_beside(self.root.with_suffix("") if self.root.is_file() else self.root, "_batch")
        if self.dry_run:
            from rmis_calib.batches import plan

            return say_plan(plan(self.root, out, config, self.task, self.batch))
        from rmis_calib.batches import batch

        with batch_reporter() as progress, stopped_by_signal(self.batch.watch) as stop:
            summary = batch(self.root, out, config, task=self.task, settings=self.batch, progress=progress, stop=stop)
        return conclude_batch(f"batch {self.root}", summary, out / "index.html")


@dataclass(frozen=True, kw_only=True)
class Compare:
    """Compare results of one set-up: a pooled transform, whether they agree, which one does not fit, what drifts."""

    results: tyro.conf.Positional[tuple[Path, ...]]
    """Result files (result.json), or folders that hold one, in the order of their time."""

    def run(self) -> int:
        paths = [path / "result.json" if path.is_dir() else path for path in self.results]
        for path in paths:
            check_regular(path)
        from rmis_calib.batches import compare
        from rmis_calib.results import CalibrationResult

        names = [str(path.parent if path.name == "result.json" else path) for path in paths]
        results = [CalibrationResult.read(path) for path in paths]
        return conclude_comparison(compare(results, names), dict(zip(names, results, strict=True)))
