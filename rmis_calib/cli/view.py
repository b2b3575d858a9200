"""`rmis-calib view`."""

from dataclasses import dataclass
from pathlib import Path

import tyro

from rmis_calib.cli import EXIT_OK
from rmis_calib.cli.console import say
from rmis_calib.errors import FileError, InputError


@dataclass(frozen=True, kw_only=True)
class View:
    """Show both arms, cameras, shaft and uncertainty in a browser, motion by motion (needs rmis-calib[view]).

    Prints the address and serves until Ctrl-C. Several results of one recording are drawn in several colours.
    """

    paths: tyro.conf.Positional[tuple[Path, ...]]
    """Recording folder, results of it (result.json, or the folder that `calibrate` wrote), or both in any order."""
    recording: Path | None = None
    """Recording of the results, where it is neither named nor beside them."""
    host: str = "127.0.0.1"
    """Address to bind. The default is for this machine alone; 0.0.0.0 lets every machine on the network look."""
    port: int = 8080
    """Port to listen on; the next free one where it is taken."""

    def run(self) -> int:
        folder, results = sorted_paths(self.paths, self.recording)
        from rmis_calib.viewer import open_viewer

        viewer = open_viewer(folder, results, self.host, self.port)
        say(f"{viewer.motions} motions at {viewer.url} (Ctrl-C to stop)")
        try:
            viewer.wait()
        except KeyboardInterrupt:
            viewer.close()
        return EXIT_OK


def sorted_paths(paths: tuple[Path, ...], recording: Path | None) -> tuple[Path, dict[str, Path]]:
    """The recording among the paths, and the results by the shortest names that differ.

    Raises:
        FileError: a path is neither.
        InputError: no recording, or two.
    """
    found, results = [recording] if recording else [], []
    for path in paths:
        if (path / "recording.yaml").is_file() or path.name == "recording.yaml":
            found.append(path.parent if path.name == "recording.yaml" else path)
        elif (path / "result.json").is_file() or path.is_file():
            results.append(path)
        else:
            raise FileError(where=str(path), expected="a recording folder, or a result", found="neither")
    if not found and results:
        found = [beside for beside in map(_recording_beside, results[:1]) if beside is not None]
    if len({folder.resolve() for folder in found}) != 1:
        what = f"{len(found)} recordings" if found else "results alone: name their recording too"
        raise InputError(where="view", expected="one recording", found=what)
    names = [path.parent.name if path.name == "result.json" else path.stem for path in results]
    if len(set(names)) < len(names):
        names = [str(path) for path in results]
    return found[0], dict(zip(names, results, strict=True))


def _recording_beside(result: Path) -> Path | None:
    """Where `calibrate` and `demo` have the recording of what they write: RECORDING for RECORDING_calibration, or
    `recording` for `calibration`."""
    folder = (result.parent if result.name == "result.json" else result).resolve()
    for name in (folder.name.partition("_calibration")[0], "recording"):
        beside = folder.parent / name
        if beside != folder and (beside / "recording.yaml").is_file():
            return beside
    return None
