"""The sub-commands: their arguments as dataclasses, each with one `run` that calls the public function and prints."""

import dataclasses
from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Annotated, Any, Literal

import tyro
from pydantic import ValidationError

from rmis_calib.batches.settings import BatchSettings
from rmis_calib.cli import EXIT_OK
from rmis_calib.cli.baseline_command import Baseline as Baseline
from rmis_calib.cli.batch_console import (
    batch_reporter,
    conclude_batch,
    conclude_comparison,
    say_plan,
    stopped_by_signal,
)
from rmis_calib.cli.console import ProgressCallback, conclude, conclude_check, print_table, progress_reporter, say
from rmis_calib.cli.convert_command import Convert as Convert
from rmis_calib.cli.equipment import CamerasShow as CamerasShow
from rmis_calib.cli.equipment import RobotsCheck as RobotsCheck
from rmis_calib.cli.equipment import RobotsImport as RobotsImport
from rmis_calib.cli.equipment import RobotsList as RobotsList
from rmis_calib.cli.equipment import RobotsShow as RobotsShow
from rmis_calib.cli.info import Info as Info
from rmis_calib.cli.paths import beside, check_output_folder, setting_inputs
from rmis_calib.cli.study_commands import parse_study
from rmis_calib.cli.usage import parse_arguments
from rmis_calib.cli.view import View as View
from rmis_calib.config import CalibrationConfig, load_config
from rmis_calib.errors import InputError, OutputError
from rmis_calib.exports.settings import ExportSettings, FormatName
from rmis_calib.io.configs import check_regular
from rmis_calib.io.folders import DESCRIPTION, recording_folder
from rmis_calib.io.outputs import (
    EVALUATION_FORMAT,
    RESULT_FORMAT,
    check_apart,
    check_file,
    is_json_of,
)
from rmis_calib.io.validation import first_finding
from rmis_calib.solver.settings import Method

Settings = Annotated[CalibrationConfig, tyro.conf.arg(name="")]


def parse(class_name: str, command: str, argv: Sequence[str]) -> Any:
    """The command's arguments; a `--config` file, where given, sets the defaults that flags then override.

    Raises:
        SystemExit: help was asked for, and printed.
        InputError: a word that is not understood, or a value that no setting may have.
    """
    if command == "study":
        return parse_study(argv)
    kind = globals()[class_name]
    config = _config_argument(argv)
    default = kind.defaults(load_config(config)) if config and issubclass(kind, _Estimates) else None
    return parse_arguments(kind, argv, f"rmis-calib {command}", default)


def _config_argument(argv: Sequence[str]) -> str | None:
    for index, word in enumerate(argv):
        if word == "--config" and index + 1 < len(argv):
            return argv[index + 1]
        if word.startswith("--config="):
            return word.partition("=")[2]
    return None


@dataclass(frozen=True, kw_only=True)
class _Estimates:
    """What every estimating command can be told."""

    config: str | None = None
    """YAML file, or name of a shipped preset, that sets the defaults of the flags below."""
    method: Method | None = None
    """Estimator: joint (default), global (rotation first, then translation) or paper (IJCARS 2020)."""
    settings: Settings = field(default_factory=CalibrationConfig)

    @classmethod
    def defaults(cls, settings: CalibrationConfig) -> Any:
        """An instance whose required arguments are still to be given."""
        required = {
            spec.name: tyro.MISSING
            for spec in dataclasses.fields(cls)
            if spec.default is dataclasses.MISSING and spec.default_factory is dataclasses.MISSING
        }
        return cls(**required, settings=settings)

    def resolved(self) -> CalibrationConfig:
        if self.method is None:
            return self.settings
        return replace(self.settings, solver=replace(self.settings.solver, method=self.method))

    def inputs(self) -> list[Path]:
        """Files that the settings name, which exist.

        Raises:
            FileError: masks or a prior that are not there.
        """
        return setting_inputs(self.config, self.settings)


@dataclass(frozen=True, kw_only=True)
class Check(_Estimates):
    """Look a recording over before it is calibrated, within seconds: files and units, clocks, motion of the joints,
    repeated pictures, swapped cameras, and the accuracy to expect. Nothing is written.

    Exit code 0: nothing speaks against calibrating it; 1: doubts that would make a calibration untrustworthy; 2: the
    recording breaks its format.
    """

    recording: tyro.conf.Positional[Path]
    """Recording folder."""

    def run(self) -> int:
        recording_folder(self.recording)
        self.inputs()
        from rmis_calib.pipeline import check

        return conclude_check(check(self.recording, self.resolved()), self.recording)


@dataclass(frozen=True, kw_only=True)
class Calibrate(_Estimates):
    """Estimate camera_right_T_arm from a recording folder: stereo video and the joint log of both arms.

    Writes OUT/result.json, OUT/report.html, OUT/observations.npz (for `solve`), OUT/config.yaml and OUT/overlays.
    """

    recording: tyro.conf.Positional[Path]
    """Recording folder."""
    out: Path | None = None
    """Folder to write; it appears only when everything in it is complete. Default: RECORDING_calibration, numbered."""
    overwrite: bool = False
    """Replace OUT, if all of it was written by this program."""
    overlays: int = 12
    """Pictures drawn with detected and predicted contours, spread over the recording (-1: every frame)."""
    overlay_video: bool = False
    """Write OUT/overlay_right.mp4 (and _left) with detected and predicted contours, residuals and the verdict."""

    def run(self) -> int:
        recording_folder(self.recording)
        from rmis_calib.io.description import read_description

        description = read_description(self.recording)
        out = self.out or beside(description.path, "_calibration")
        check_output_folder(out, [*description.inputs, *self.inputs()], self.overwrite)
        from rmis_calib.report import calibrate_to_folder

        with progress_reporter() as progress:
            result = calibrate_to_folder(
                description,
                out,
                self.resolved(),
                overwrite=self.overwrite,
                overlays=self.overlays,
                overlay_video=self.overlay_video,
                progress=progress,
            )
        return conclude(result, out / "report.html")


@dataclass(frozen=True, kw_only=True)
class Batch(_Estimates):
    """Calibrate, or detect in, every recording below a folder or in a manifest, side by side.

    Writes OUT/NAME a recording, OUT/index.html, OUT/summary.csv, .parquet and .json. What is done already with the same
    inputs and settings is passed over, so an interrupted batch goes on where it stopped. Exit code 0: every result
    passed its own checks; 1: one did not, or a recording failed.
    """

    root: tyro.conf.Positional[Path]
    """Folder that is searched for recordings; or a manifest: .txt (a path a line), .csv (recording, name, config, and
    settings by their dotted names) or .yaml (recordings: [{recording, name, config}])."""
    out: Path
    """Folder to write."""
    task: Literal["calibrate", "detect"] = "calibrate"
    """What to do; detect takes plain videos and folders of pictures, too."""
    dry_run: bool = False
    """List what would be done, and why; write nothing."""
    batch: Annotated[BatchSettings, tyro.conf.arg(name="")] = field(default_factory=BatchSettings)

    def run(self) -> int:
        self.inputs()
        config = self.resolved()
        if self.dry_run:
            from rmis_calib.batches import plan

            return say_plan(plan(self.root, self.out, config, self.task, self.batch))
        from rmis_calib.batches import batch

        with batch_reporter() as progress, stopped_by_signal(self.batch.watch) as stop:
            summary = batch(
                self.root, self.out, config, task=self.task, settings=self.batch, progress=progress, stop=stop
            )
        return conclude_batch(summary, self.out / "index.html")


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


@dataclass(frozen=True, kw_only=True)
class Solve(_Estimates):
    """Estimate camera_right_T_arm from an observations file (.npz), for people who bring their own vision."""

    observations: tyro.conf.Positional[Path]
    """Observations file."""
    out: Path | None = None
    """Result file to write. Default: OBSERVATIONS_result.json, numbered."""
    overwrite: bool = False
    """Replace OUT, if it is a result of this program."""

    def run(self) -> int:
        from rmis_calib.io.observations import ShaftObservations

        observations = ShaftObservations.load(self.observations)
        out = self.out or beside(self.observations.with_suffix(""), "_result", ".json")
        check_apart(out, [self.observations, *self.inputs()])
        check_file(out, is_json_of(RESULT_FORMAT), self.overwrite)
        from rmis_calib.pipeline import solve

        result = solve(observations, self.resolved(), throw=False)
        result.write(out)
        return conclude(result, out)


@dataclass(frozen=True, kw_only=True)
class Evaluate:
    """Measure a result: head-point reprojection error in the recording, and errors against a truth file."""

    result: tyro.conf.Positional[Path]
    """Result file (result.json)."""
    recording: tyro.conf.Positional[Path]
    """Recording folder whose head_points.csv is compared with the kinematics seen through the result."""
    truth: Path | None = None
    """YAML file with camera_right_T_arm (4x4 rows, mm); default: the recording's ground_truth.yaml where present."""
    out: Path | None = None
    """JSON file for the numbers."""
    overwrite: bool = False
    """Replace OUT, if it is an evaluation of this program."""

    def run(self) -> int:
        inputs = [path for path in (self.result, self.truth) if path is not None]
        for path in inputs:
            check_regular(path)
        recording_folder(self.recording)
        from rmis_calib.io.description import read_description

        description = read_description(self.recording)
        if self.out is not None:
            check_apart(self.out, [*description.inputs, *inputs])
            check_file(self.out, is_json_of(EVALUATION_FORMAT), self.overwrite)
        from rmis_calib.io import load_recording, write_json
        from rmis_calib.io.plain_values import finite_or_none
        from rmis_calib.pipeline import evaluate
        from rmis_calib.results import CalibrationResult

        evaluation = evaluate(CalibrationResult.read(self.result), load_recording(description), self.truth)
        print_table("evaluation", evaluation.rows())
        if self.out is not None:
            write_json(self.out, {"format": EVALUATION_FORMAT} | finite_or_none(evaluation.to_dict()))
        return EXIT_OK


@dataclass(frozen=True, kw_only=True)
class Export:
    """Write a result as another program reads it; docs/export.md has what each format holds.

    Exit code 1, and nothing written, where the result is not trustworthy; --force writes it all the same, marked.
    """

    result: tyro.conf.Positional[Path]
    """Result file (result.json), or a folder that holds one."""
    to: FormatName
    """Format. dvrk, ros-static-tf and surgsync are folders, the others files."""
    out: Path
    """File or folder to write."""
    recording: Path | None = None
    """Recording folder of the result: dvrk and surgsync need its arms, joints and cameras."""
    overwrite: bool = False
    """Replace OUT, if this program wrote it."""
    force: bool = False
    """Write a result that is not trustworthy, marked as such."""
    settings: Annotated[ExportSettings, tyro.conf.arg(name="")] = field(default_factory=ExportSettings)

    def run(self) -> int:
        path = self.result / "result.json" if self.result.is_dir() else self.result
        check_regular(path)
        if self.recording is not None:
            recording_folder(self.recording)
        from rmis_calib.exports import export

        export(
            path,
            self.to,
            self.out,
            recording=self.recording,
            settings=self.settings,
            overwrite=self.overwrite,
            force=self.force,
        )
        say(f"written: {self.out} ({self.to})")
        return EXIT_OK


@dataclass(frozen=True, kw_only=True)
class Detect:
    """Find the instrument shaft: a table of lines, and pictures with what was found drawn in.

    Writes OUT/lines.csv, OUT/lines.npz and OUT/overlays; on request OUT/overlay_right.mp4 and OUT/debug. Without a
    recording there is no camera: lines are in pixels.
    """

    source: tyro.conf.Positional[Path]
    """Recording folder, video, folder of images, or one image."""
    out: Path | None = None
    """Folder to write. Default: SOURCE_lines, numbered."""
    config: str | None = None
    """YAML file, or name of a shipped preset, that sets the defaults of the flags below."""
    overwrite: bool = False
    """Replace OUT, if all of it was written by this program."""
    overlays: int = -1
    """Pictures drawn a camera, spread over the frames (-1: every frame)."""
    overlay_video: bool = False
    """Write the overlays of every frame as a video a camera, too."""
    debug: bool = False
    """Draw the stages of the search, a sheet a frame, to show why a frame failed."""
    debug_frames: int = 40
    """Most sheets of `--debug` a camera. Where there are more frames, only those without a shaft get one (-1: every
    frame gets one)."""
    settings: Settings = field(default_factory=CalibrationConfig)

    def run(self) -> int:
        from rmis_calib.io.description import read_description
        from rmis_calib.io.readers import open_reader

        if (self.source / DESCRIPTION).is_file():
            inputs = list(read_description(self.source).inputs)
        else:
            inputs = [open_reader(self.source).path]
        out = self.out or beside(self.source if self.source.is_dir() else self.source.with_suffix(""), "_lines")
        check_output_folder(out, [*inputs, *setting_inputs(self.config, self.settings)], self.overwrite)
        from rmis_calib.io import atomic_directory
        from rmis_calib.pipeline import detect
        from rmis_calib.report import DetectionPictures, PictureChoice, write_lines

        choice = PictureChoice(self.overlays, self.overlay_video, self.debug_frames if self.debug else 0)
        with atomic_directory(out, overwrite=self.overwrite) as folder, progress_reporter() as progress:
            with DetectionPictures(folder, choice) as pictures:
                table = detect(self.source, self.settings, progress, pictures.add)
            write_lines(folder, table)
        print_table(f"shafts in {self.source}", table.rows())
        say(f"lines: {out / 'lines.csv'}   pictures: {out / 'overlays'}")
        if self.overlay_video:
            say(f"video: {out / 'overlay_right.mp4'}")
        if self.debug:
            drawn, failed = pictures.sheets.total(), pictures.failed.total()
            more = "" if drawn >= failed else "; --debug-frames -1 draws every frame"
            say(f"stages: {out / 'debug'} ({drawn} sheets; {failed} frames without a shaft{more})")
        return EXIT_OK


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
class Demo(_Estimates):
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
        code = conclude(result, calibration / "report.html")
        print_table("against the truth of the rendering", evaluate(result, recording).rows())
        return code


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
