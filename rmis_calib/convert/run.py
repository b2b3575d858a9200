"""One source to one recording folder: whole, or not at all."""

from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path

from rmis_calib.convert.material import Job, ProgressCallback
from rmis_calib.convert.settings import ConvertSettings
from rmis_calib.convert.sources import read_source
from rmis_calib.errors import FileError, InputError
from rmis_calib.io.atomic import atomic_directory
from rmis_calib.io.outputs import check_apart, check_folder
from rmis_calib.io.robot import load_robot


@contextmanager
def _places_in_words(folder: Path, source: Path) -> Iterator[None]:
    """Name no file of a recording that is gone by the time the message is read."""
    try:
        yield
    except (InputError, FileError) as problem:
        if str(folder) not in str(problem):
            raise
        said = str(problem).replace(f"{folder}/", "").replace(str(folder), "it")
        raise type(problem)(said, where=f"{source}, as a recording") from problem


def convert(
    source: str | Path,
    out: str | Path,
    settings: ConvertSettings | None = None,
    *,
    overwrite: bool = False,
    progress: ProgressCallback | None = None,
    on_note: Callable[[str], None] | None = None,
) -> tuple[str, ...]:
    """Make a recording folder of a bag, a recorder's session, a data set, or pictures with a table.

    The recording is read back before it appears, so that what is written can be calibrated.

    Args:
        source: ROS1 .bag, ROS2 bag (folder, .mcap or .db3), folder of a dVRK recorder's session, SurgPose or SurgSync
            folder, or folder of pictures with a table.
        out: the recording folder to make; never a place in the source.
        settings: overrides of what is guessed.
        overwrite: replace `out`, if all of it was written by this program.
        progress: called with (stage, done, total).
        on_note: called with each thing that was guessed, as it is found.
    Returns:
        what was guessed and why, a sentence each; recording.yaml keeps them, too.
    Raises:
        FileError: the source is absent, damaged or of no known kind.
        RecordingError, RobotError: it lacks something; says what to give.
        OutputError: the output cannot be written.
    """
    source, out, settings = Path(source), Path(out), settings or ConvertSettings()
    inputs = [source, *(Path(path) for path in (settings.robot, settings.stereo) if path is not None)]
    check_apart(out, [path for path in inputs if path.exists()])
    check_folder(out.absolute(), overwrite)
    if settings.robot is not None:
        load_robot(settings.robot)
    if settings.stereo is not None and not Path(settings.stereo).exists():
        raise FileError(where=settings.stereo, expected="a camera calibration", found="nothing there")
    notes: list[str] = []

    def note(sentence: str) -> None:
        if sentence not in notes:
            notes.append(sentence)
            if on_note is not None:
                on_note(sentence)

    from rmis_calib.convert.assemble import add_notes, assemble
    from rmis_calib.io.description import read_description

    with atomic_directory(out, overwrite=overwrite) as folder, _places_in_words(folder, source):
        job = Job(source, folder, note, progress or (lambda stage, done, total: None))
        material, settings = read_source(job, settings)
        assemble(material, job, settings)
        add_notes(folder, notes)
        read_description(folder)
    return tuple(notes)
