"""The sub-commands: their arguments as dataclasses, each with one `run` that calls the public function and prints."""

import dataclasses
from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, Literal

import tyro
from pydantic import ValidationError

from rmis_calib.cli import EXIT_NOT_TRUSTWORTHY, EXIT_OK
from rmis_calib.cli.console import ProgressCallback, console, print_advice, print_table, progress_reporter
from rmis_calib.config import CalibrationConfig, config_error, load_config

if TYPE_CHECKING:
    from rmis_calib.results import CalibrationResult

Method = Literal["paper", "global", "joint"]
Settings = Annotated[CalibrationConfig, tyro.conf.arg(name="")]


def parse(class_name: str, command: str, argv: Sequence[str]) -> Any:
    """The command's arguments; a `--config` file, where given, sets the defaults that flags then override.

    Raises:
        ConfigError: a value that no setting may have; names the setting.
    """
    kind = globals()[class_name]
    config = _config_argument(argv)
    default = kind.defaults(load_config(config)) if config and issubclass(kind, _Estimates) else None
    prog = f"rmis-calib {command}"
    try:
        return tyro.cli(kind, args=list(argv), prog=prog, default=default, description=kind.__doc__)
    except ValidationError as error:  # of the settings as a whole; tyro reports those of single groups itself
        raise config_error(error, prog) from None


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


@dataclass(frozen=True, kw_only=True)
class Calibrate(_Estimates):
    """Estimate camera_right_T_arm from a recording folder: stereo video and the joint log of both arms.

    Writes OUT/result.json, OUT/report.html, OUT/observations.npz (for `solve`), OUT/config.yaml and OUT/overlays.
    """

    recording: tyro.conf.Positional[Path]
    """Recording folder."""
    out: Path
    """Folder to write; it appears only when everything in it is complete."""
    overwrite: bool = False
    """Replace OUT if it exists."""
    overlays: int = 12
    """Pictures drawn with detected and predicted contours, spread over the recording (-1: every frame)."""

    def run(self) -> int:
        with progress_reporter() as progress:
            result = calibrate_folder(
                self.recording, self.out, self.resolved(), self.overwrite, self.overlays, progress
            )
        return conclude(result, self.out / "report.html")


@dataclass(frozen=True, kw_only=True)
class Solve(_Estimates):
    """Estimate camera_right_T_arm from an observations file (.npz), for people who bring their own vision."""

    observations: tyro.conf.Positional[Path]
    """Observations file."""
    out: Path
    """Result file to write (result.json)."""

    def run(self) -> int:
        from rmis_calib.io import ShaftObservations
        from rmis_calib.pipeline import solve

        observations = ShaftObservations.load(self.observations)
        result = solve(observations, self.resolved(), throw=False)
        result.write(self.out)
        return conclude(result, self.out)


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

    def run(self) -> int:
        from rmis_calib.io import write_json
        from rmis_calib.pipeline import evaluate
        from rmis_calib.results import CalibrationResult, finite_or_none

        evaluation = evaluate(CalibrationResult.read(self.result), self.recording, self.truth)
        print_table("evaluation", evaluation.rows())
        if self.out is not None:
            write_json(self.out, finite_or_none(evaluation.to_dict()))
        return EXIT_OK


@dataclass(frozen=True, kw_only=True)
class Detect:
    """Find the instrument shaft: a table of lines, and pictures with what was found drawn in.

    Writes OUT/lines.csv, OUT/lines.npz and OUT/overlays; on request OUT/overlay_right.mp4 and OUT/debug. Without a
    recording there is no camera: lines are in pixels.
    """

    source: tyro.conf.Positional[Path]
    """Recording folder, video, folder of images, or one image."""
    out: Path
    """Folder to write."""
    config: str | None = None
    """YAML file, or name of a shipped preset, that sets the defaults of the flags below."""
    overwrite: bool = False
    """Replace OUT if it exists."""
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
        from rmis_calib.io import atomic_directory
        from rmis_calib.pipeline import detect
        from rmis_calib.report import DetectionPictures, PictureChoice, write_lines

        choice = PictureChoice(self.overlays, self.overlay_video, self.debug_frames if self.debug else 0)
        with atomic_directory(self.out, overwrite=self.overwrite) as folder, progress_reporter() as progress:
            with DetectionPictures(folder, choice) as pictures:
                table = detect(self.source, self.settings, progress, pictures.add)
            write_lines(folder, table)
        print_table(f"shafts in {self.source}", table.rows())
        console.print(f"lines: {self.out / 'lines.csv'}   pictures: {self.out / 'overlays'}", soft_wrap=True)
        if self.overlay_video:
            console.print(f"video: {self.out / 'overlay_right.mp4'}", soft_wrap=True)
        if self.debug:
            drawn, failed = pictures.sheets.total(), pictures.failed.total()
            more = "" if drawn >= failed else "; --debug-frames -1 draws every frame"
            console.print(
                f"stages: {self.out / 'debug'} ({drawn} sheets; {failed} frames without a shaft{more})", soft_wrap=True
            )
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
    """Replace OUT if it exists."""

    def run(self) -> int:
        with progress_reporter() as progress:
            render_recording(self.out, self.preset, self.motions, self.seed, self.overwrite, progress)
        console.print(f"recording: {self.out}")
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
    """Replace OUT if it exists."""

    def run(self) -> int:
        from rmis_calib.pipeline import evaluate

        recording = self.out / "recording"
        calibration = self.out / "calibration"
        with progress_reporter() as progress:
            render_recording(recording, "demo", self.motions, self.seed, self.overwrite, progress)
            result = calibrate_folder(recording, calibration, self.resolved(), self.overwrite, 12, progress)
        code = conclude(result, calibration / "report.html")
        print_table("against the truth of the rendering", evaluate(result, recording).rows())
        return code


def calibrate_folder(
    source: Path,
    out: Path,
    config: CalibrationConfig,
    overwrite: bool,
    overlays: int,
    progress: ProgressCallback,
) -> "CalibrationResult":
    """Calibrate a recording and write the answer, the report and the pictures as one folder, whole or not at all."""
    from rmis_calib.io import atomic_directory, load_recording
    from rmis_calib.pipeline import run_calibration
    from rmis_calib.report import write_calibration_folder

    recording = load_recording(source)
    with atomic_directory(out, overwrite=overwrite) as folder:
        run = run_calibration(recording, config, progress)
        write_calibration_folder(folder, run, overlays)
    return run.result


def render_recording(
    out: Path, preset: str, motions: int | None, seed: int | None, overwrite: bool, progress: ProgressCallback
) -> None:
    """Render a preset of `configs/synth`, with another number of motions or another seed where given.

    Raises:
        InputError: no such preset, or an impossible value in it.
        OutputError: the folder exists already, or cannot be written.
    """
    import data_synth
    from rmis_calib.errors import InputError, OutputError

    changes = {"motions": motions, "seed": seed}
    try:
        config = data_synth.load_synth_config(preset)
        config = replace(config, **{key: value for key, value in changes.items() if value is not None})
    except (FileNotFoundError, ValueError) as error:
        raise InputError(" ".join(str(error).split()), where="--preset") from error
    try:
        data_synth.write_recording(
            out, config, overwrite=overwrite, on_progress=lambda done, total: progress("rendering", done, total)
        )
    except FileExistsError as error:
        raise OutputError(where=str(out), expected="a new folder, or --overwrite", found="one that exists") from error
    except OSError as error:
        raise OutputError(where=str(out), expected="a place that can be written", found=error.strerror) from error


def conclude(result: "CalibrationResult", written: Path) -> int:
    """Print the answer and where it is; the exit code says whether to trust it."""
    console.print(f"[bold]{result.status}[/bold]: {result.message}\n", soft_wrap=True)
    print_table(result.camera_right_T_arm.name if result.camera_right_T_arm else "no transform", result_rows(result))
    for note in result.notes:
        console.print(f"note: {note}", soft_wrap=True, markup=False)
    if not result.trustworthy:
        print_advice(result.observability.get("advice") or [])
    console.print(f"written: {written}\n", soft_wrap=True)
    return EXIT_OK if result.trustworthy else EXIT_NOT_TRUSTWORTHY


def result_rows(result: "CalibrationResult") -> list[tuple[str, str]]:
    """The answer with frames, units and uncertainty."""
    rows: list[tuple[str, str]] = []
    transform = result.camera_right_T_arm
    if transform is not None:
        matrix = transform.matrix.tolist()
        lines = ["".join(f"{x:10.6f}" for x in row[:3]) + f"{row[3]:12.4f}" for row in matrix[:3]]
        rows.append(("rotation | translation, mm", "\n".join(lines)))
        rows.append(("quaternion wxyz", "".join(f"{x:10.6f}" for x in transform.quat_wxyz.tolist())))
    if result.rotation_sigma_deg is not None and result.translation_sigma_mm is not None:
        rows.append(("1 sigma", f"{result.rotation_sigma_deg:.3f} deg, {result.translation_sigma_mm:.3f} mm"))
    used, total = int(result.motions.used.sum()), len(result.motions.used)
    rows.append(("motions used", f"{used} of {total} (method {result.method})"))
    rows += [(f"  {count} rejected", reason) for reason, count in result.motions.rejected_by_reason.items()]
    for kind, residual in result.residuals.items():
        if residual["median"] is not None:
            rows.append((f"residual, {kind.replace('_', ' ')}", f"median {residual['median']:.3g} {residual['unit']}"))
    for name, nuisance in result.nuisances.items():
        if name.startswith("edge_bias"):  # eight hundredths of a pixel: for result.json and the report
            continue
        sigma = "" if nuisance["sigma"] is None else f" +- {nuisance['sigma']:.2g}"
        held = " (held by its prior)" if nuisance.get("held") else ""
        value = 0.0 if abs(nuisance["value"]) < 1e-9 * (nuisance["sigma"] or 0.0) else nuisance["value"]  # rounding
        rows.append((name.replace("_", " "), f"{value:.4g}{sigma} {nuisance['unit']}{held}"))
    return rows
