"""Where commands read and write: inputs that settings name, outputs that may be written, names beside an input."""

from pathlib import Path

from rmis_calib.config import CalibrationConfig
from rmis_calib.errors import FileError
from rmis_calib.io.outputs import check_apart, check_folder, numbered


def setting_inputs(config: str | None, settings: CalibrationConfig) -> list[Path]:
    """Files that a command's settings name, which exist.

    Raises:
        FileError: masks or a prior that are not there.
    """
    for flag, value in (("--masks", settings.masks), ("--prior", settings.prior)):
        if value is not None and not Path(value).exists():
            what = {"--masks": "a folder of mask pictures, or a model file", "--prior": "a YAML file or a result.json"}
            raise FileError(where=value, expected=what[flag], found="nothing there")
    named = [Path(value) for value in (config, settings.masks, settings.prior) if value is not None]
    return [path for path in named if path.exists()]


def beside(source: Path, ending: str, suffix: str = "") -> Path:
    """A fresh name beside an input, in the folder that holds it."""
    return numbered(named_beside(source, ending), suffix)


def named_beside(source: Path, ending: str) -> Path:
    """The name beside an input, whether or not something is there already."""
    named = source if source.name not in ("", "..") else source.resolve()
    return named.with_name(named.name + ending)


def check_output_folder(out: Path, inputs: list[Path], overwrite: bool) -> None:
    """Refuse a folder that may not be written, before any work.

    Raises:
        OutputError: it is, contains or lies in an input, or holds what this program did not write.
    """
    check_apart(out, inputs)
    check_folder(out.absolute(), overwrite)
