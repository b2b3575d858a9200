"""`rc.export`: a result into the file or folder of another program, whole or not at all."""

from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

from rmis_calib.errors import CalibrationFailed, InputError
from rmis_calib.exports.answer import Answer
from rmis_calib.exports.formats import (
    csv_table,
    dvrk,
    easy_handeye2,
    ethz,
    moveit,
    opencv,
    ros_static_tf,
    surgsync,
    tum,
    urdf_origin,
)
from rmis_calib.exports.hand_eye import WRITTEN_BY
from rmis_calib.exports.placement import placement
from rmis_calib.exports.settings import ExportSettings
from rmis_calib.io import Recording, load_recording
from rmis_calib.io.atomic import atomic_directory, atomic_write
from rmis_calib.io.configs import did_you_mean
from rmis_calib.io.outputs import check_apart, check_file
from rmis_calib.results import CalibrationResult

_HEAD_BYTES = 4096


@dataclass(frozen=True)
class Format:
    """One format: what makes its content, and whether that is a folder of files."""

    file: Callable[[Answer], str] | None = None
    folder: Callable[[Answer], dict[str, str]] | None = None


FORMATS: dict[str, Format] = {
    "csv": Format(file=csv_table.content),
    "dvrk": Format(folder=dvrk.content),
    "easy-handeye2": Format(file=easy_handeye2.content),
    "ethz": Format(file=ethz.content),
    "moveit": Format(file=moveit.content),
    "opencv-json": Format(file=opencv.json_content),
    "opencv-yaml": Format(file=opencv.yaml_content),
    "ros-static-tf": Format(folder=ros_static_tf.content),
    "surgsync": Format(folder=surgsync.content),
    "tum": Format(file=tum.content),
    "urdf-origin": Format(file=urdf_origin.content),
}


def export(
    result: CalibrationResult | str | Path,
    to: str,
    out: str | Path,
    *,
    recording: Recording | str | Path | None = None,
    settings: ExportSettings | None = None,
    overwrite: bool = False,
    force: bool = False,
) -> Path:
    """Write a result as another program reads it.

    Args:
        result: the result, or its result.json.
        to: one of `FORMATS`; dvrk, ros-static-tf and surgsync are folders, the others files.
        out: file or folder to write.
        recording: what was calibrated; dvrk and surgsync need it for the arms' bases, joints and cameras.
        settings: names of frames, camera, axes.
        overwrite: replace `out`, if this program wrote it.
        force: write a result that is not trustworthy, marked as such.

    Returns:
        `out`.

    Raises:
        CalibrationFailed: the result is not trustworthy (without `force`), or holds no transform.
        InputError: no such format, or something that the format needs is missing.
        OutputError: `out` exists, is an input, or cannot be written.
    """
    if to not in FORMATS:
        found = f"{to!r}{did_you_mean(str(to), list(FORMATS))}"
        raise InputError(where="format", expected=f"one of {', '.join(FORMATS)}", found=found)
    inputs = [] if isinstance(result, CalibrationResult) else [Path(result)]
    known = result if isinstance(result, CalibrationResult) else CalibrationResult.read(result)
    _require_trust(known, force)
    settings = settings or ExportSettings()
    opened = load_recording(recording) if isinstance(recording, (str, Path)) else recording
    if opened is not None:
        inputs.append(opened.path)
    check_apart(out, inputs)
    placed = None if opened is None else placement(opened, known, settings.frame)
    answer, target = Answer(known, settings, placed), Path(out)
    chosen = FORMATS[to]
    if chosen.file is not None:
        _write_file(target, chosen.file(answer), overwrite)
    if chosen.folder is not None:
        _write_folder(target, chosen.folder(answer), overwrite)
    return target


def _require_trust(result: CalibrationResult, force: bool) -> None:
    if result.camera_right_T_arm is None:
        raise CalibrationFailed(f"it holds no transform to export ({result.message})", result)
    if not result.trustworthy and not force:
        raise CalibrationFailed(f"{result.message}; nothing was exported (--force exports it, marked)", result)


def _write_file(target: Path, text: str, overwrite: bool) -> None:
    check_file(target, _is_export, overwrite)
    with atomic_write(target) as temporary:
        temporary.write_text(text, encoding="utf-8")


def _write_folder(target: Path, files: dict[str, str], overwrite: bool) -> None:
    with atomic_directory(target, overwrite=overwrite) as folder:
        for name, text in files.items():
            path = folder / name
            path.parent.mkdir(parents=True, exist_ok=True)
            path.write_text(text, encoding="utf-8")


def _is_export(path: Path) -> bool:
    """Whether a file says that it is an export of this program."""
    try:
        with path.open("rb") as file:
            return WRITTEN_BY.encode() in file.read(_HEAD_BYTES)
    except OSError:
        return False
