"""The sub-commands of one recording or result: their arguments as dataclasses, each with one `run`
that calls the public function and prints. Those of the other modules are gathered here by name.
"""

from collections.abc import Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Annotated, Any, ClassVar

import tyro

from rmis_calib.cli import EXIT_OK
from rmis_calib.cli.baseline_command import Baseline as Baseline
from rmis_calib.cli.batch_commands import Batch as Batch
from rmis_calib.cli.batch_commands import Compare as Compare
from rmis_calib.cli.completion import Completion as Completion
from rmis_calib.cli.console import (
    conclude,
    conclude_check,
    print_table,
    progress_reporter,
    say,
    summarise,
    summarise_result,
)
from rmis_calib.cli.convert_command import Convert as Convert
from rmis_calib.cli.equipment import CamerasShow as CamerasShow
from rmis_calib.cli.equipment import RobotsCheck as RobotsCheck
from rmis_calib.cli.equipment import RobotsImport as RobotsImport
from rmis_calib.cli.equipment import RobotsList as RobotsList
from rmis_calib.cli.equipment import RobotsShow as RobotsShow
from rmis_calib.cli.estimates import Estimates, Settings
from rmis_calib.cli.info import Info as Info
from rmis_calib.cli.paths import beside, check_output_folder, setting_inputs
from rmis_calib.cli.rendered import Demo as Demo
from rmis_calib.cli.rendered import Synth as Synth
from rmis_calib.cli.study_commands import parse_study
from rmis_calib.cli.usage import parse_arguments
from rmis_calib.cli.view import View as View
from rmis_calib.config import CalibrationConfig, load_config
from rmis_calib.exports.settings import SUFFIXES, ExportSettings, FormatName
from rmis_calib.io.configs import check_regular
from rmis_calib.io.folders import DESCRIPTION, recording_folder
from rmis_calib.io.outputs import (
    EVALUATION_FORMAT,
    RESULT_FORMAT,
    check_apart,
    check_file,
    is_json_of,
)


def parse(class_name: str, command: str, argv: Sequence[str]) -> Any:
    """The command's arguments; a `--config` file, where given, sets the defaults that flags then override.

    Raises:
        SystemExit: help was asked for, and printed.
        InputError: a word that is not understood, or a value that no setting may have.
    """
    if command == "study":
        return parse_study(argv)
    config = _config_argument(argv)
    return parse_arguments(globals()[class_name], argv, f"rmis-calib {command}", config and load_config(config))


def _config_argument(argv: Sequence[str]) -> str | None:
    for index, word in enumerate(argv):
        if word == "--config" and index + 1 < len(argv):
            return argv[index + 1]
        if word.startswith("--config="):
            return word.partition("=")[2]
    return None


@dataclass(frozen=True, kw_only=True)
class Check(Estimates):
    """Look a recording over before it is calibrated, within seconds: files and units, clocks, motion of the joints,
    repeated pictures, swapped cameras, and the accuracy to expect. Nothing is written.

    Exit code 0: nothing speaks against calibrating it; 1: doubts that would make a calibration untrustworthy; 2: the
    recording breaks its format.
    """

    recording: tyro.conf.Positional[Path]
    """Recording folder."""
    uses: ClassVar[tuple[str, ...]] = (
        "device",
        "masks",
        "mask_labels",
        "prior",
        "instrument_at",
        "measurements",
        "picture_errors",
        "min_motions",
        "detector",
        "solver",
    )

    def run(self) -> int:
        recording_folder(self.recording)
        self.inputs()
        from rmis_calib.pipeline import check

        return conclude_check(check(self.recording, self.resolved()), self.recording)


@dataclass(frozen=True, kw_only=True)
class Calibrate(Estimates):
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
        conclude(result)
        return summarise_result(f"calibrate {self.recording}", result, out / "report.html")


@dataclass(frozen=True, kw_only=True)
class Solve(Estimates):
    """Estimate camera_right_T_arm from an observations file (.npz), for people who bring their own vision."""

    observations: tyro.conf.Positional[Path]
    """Observations file."""
    out: Path | None = None
    """Result file to write. Default: OBSERVATIONS_result.json, numbered."""
    overwrite: bool = False
    """Replace OUT, if it is a result of this program."""
    uses: ClassVar[tuple[str, ...]] = ("device", "measurements", "clock_search_s", "solver")

    def run(self) -> int:
        from rmis_calib.io.observations import ShaftObservations

        observations = ShaftObservations.load(self.observations)
        out = self.out or beside(self.observations.with_suffix(""), "_result", ".json")
        check_apart(out, [self.observations, *self.inputs()])
        check_file(out, is_json_of(RESULT_FORMAT), self.overwrite)
        from rmis_calib.pipeline import solve

        result = solve(observations, self.resolved(), throw=False)
        result.write(out)
        conclude(result)
        return summarise_result(f"solve {self.observations}", result, out)


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
        facts = [f"{name} {value}" for name, value in evaluation.rows()]
        summarise(f"evaluate {self.result} in {self.recording}", *facts, self.out and f"written to {self.out}")
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
    out: Path | None = None
    """File or folder to write. Default: RESULT_FORMAT, numbered."""
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
        named = path.absolute().parent if path.name == "result.json" else path.with_suffix("")
        out = self.out or beside(named, f"_{self.to}", SUFFIXES[self.to])
        from rmis_calib.exports import export

        export(
            path,
            self.to,
            out,
            recording=self.recording,
            settings=self.settings,
            overwrite=self.overwrite,
            force=self.force,
        )
        summarise(f"export {path}", self.to, f"written to {out}")
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
    uses: ClassVar[tuple[str, ...]] = (
        "device",
        "batch_size",
        "every",
        "search_every",
        "masks",
        "mask_labels",
        "detector",
    )

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
        summarise(f"detect {self.source}", *(f"{name} {value}" for name, value in table.rows()), f"written to {out}")
        return EXIT_OK
