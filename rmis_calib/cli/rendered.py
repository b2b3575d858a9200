"""The sub-commands that render their own recording: `synth` and `demo`."""

from dataclasses import dataclass, replace
from pathlib import Path

import tyro
from pydantic import ValidationError

from rmis_calib.cli import EXIT_OK
from rmis_calib.cli.console import ProgressCallback, conclude, print_table, progress_reporter, say, summarise_result
from rmis_calib.cli.estimates import Estimates
from rmis_calib.cli.paths import check_output_folder
from rmis_calib.errors import InputError, OutputError
from rmis_calib.io.validation import first_finding


@dataclass(frozen=True, kw_only=True)
class Synth:
    """Render a synthetic recording folder with its ground truth."""

    out: tyro.conf.Positional[Path]
    """Recording folder to write."""
    preset: str = "demo"
    """YAML file, or name of a shipped preset (configs/synth)."""
    motions: int | None = None
    """Number of motions, one stereo frame each."""
    seed: int | None = None
    """Seed of everything random."""
    overwrite: bool = False
    """Replace OUT, if all of it was written by this program."""

    def run(self) -> int:
        with progress_reporter() as progress:
            render_recording(self.out, self.preset, self.motions, self.seed, self.overwrite, progress)
        say(f"recording: {self.out}")
        return EXIT_OK


@dataclass(frozen=True, kw_only=True)
class Demo(Estimates):
    """Render a stereo recording, calibrate it, compare with the truth, leave a report."""

    out: Path = Path("demo_output")
    """Folder to write."""
    motions: int = 60
    """Number of motions, one stereo frame each."""
    seed: int = 1
    """Seed of the rendering."""
    overwrite: bool = False
    """Replace OUT, if all of it was written by this program."""

    def run(self) -> int:
        recording = self.out / "recording"
        calibration = self.out / "calibration"
        for folder in (recording, calibration):
            check_output_folder(folder, self.inputs(), self.overwrite)
        from rmis_calib.io.description import read_description
        from rmis_calib.pipeline import evaluate
        from rmis_calib.report import calibrate_to_folder

        with progress_reporter() as progress:
            render_recording(recording, "demo", self.motions, self.seed, self.overwrite, progress)
            description = read_description(recording)
            result = calibrate_to_folder(
                description, calibration, self.resolved(), overwrite=self.overwrite, progress=progress
            )
        conclude(result)
        print_table("against the truth of the rendering", evaluate(result, recording).rows())
        return summarise_result(f"demo {self.out}", result, calibration / "report.html")


def render_recording(
    out: Path, preset: str, motions: int | None, seed: int | None, overwrite: bool, progress: ProgressCallback
) -> None:
    """Render a preset of `configs/synth`, with another number of motions or another seed where given.

    Raises:
        InputError: no such preset, or an impossible value in it.
        OutputError: the folder exists already, or cannot be written.
    """
    import data_synth

    changes = {"motions": motions, "seed": seed}
    try:
        config = data_synth.load_synth_config(preset)
        config = replace(config, **{key: value for key, value in changes.items() if value is not None})
    except ValidationError as error:
        raise first_finding(error, data_synth.SynthConfig, f"preset {preset}", InputError) from None
    except (FileNotFoundError, ValueError) as error:
        raise InputError(" ".join(str(error).split()), where="--preset") from error
    try:
        data_synth.write_recording(
            out, config, overwrite=overwrite, on_progress=lambda done, total: progress("rendering", done, total)
        )
    except FileExistsError as error:
        raise OutputError(where=str(out), expected=str(error), found="another one") from error
    except OSError as error:
        raise OutputError(where=str(out), expected="a place that can be written", found=error.strerror) from error
