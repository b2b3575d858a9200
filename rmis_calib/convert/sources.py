"""What kind of source a path is, told by what is in it, and its reader."""

from dataclasses import replace
from pathlib import Path

from rmis_calib.convert.material import Job, Material
from rmis_calib.convert.settings import ConvertSettings
from rmis_calib.errors import FileError, RecordingError

BAGS = (".bag", ".mcap", ".db3")
VIDEOS = (".mp4", ".mkv", ".avi", ".mov")
_KNOWN = (
    "a ROS1 .bag, a ROS2 bag (folder, .mcap, .db3), a folder with the mp4 and sidecar JSON of a dVRK recorder, "
    "a SurgPose, SurgSync or LeRobot folder, or a folder with right, left and a table of joints (.csv)"
)
_JIGSAWS_COLUMNS = 76


def read_source(job: Job, settings: ConvertSettings) -> tuple[Material, ConvertSettings]:
    """The content of a source, and the settings with what its kind implies.

    Raises:
        FileError: nothing is there.
        RecordingError: it is of no known kind, or of one that cannot be calibrated; says why.
    """
    path = job.source
    if not path.exists():
        raise FileError(where=str(path), expected=_KNOWN, found="nothing there")
    if path.suffix.lower() in BAGS:
        from rmis_calib.convert.bags import convert_bag

        return convert_bag(job, settings), settings
    if path.is_file() and path.suffix.lower() in VIDEOS:
        from rmis_calib.convert.session import convert_session

        return convert_session(job, settings, path), settings
    if path.is_file():
        _refuse_jigsaws([path])
        raise RecordingError(where=str(path), expected=_KNOWN, found="another file")
    return _read_folder(job, settings)


def _read_folder(job: Job, settings: ConvertSettings) -> tuple[Material, ConvertSettings]:
    path = job.source
    names = {entry.name.lower() for entry in path.iterdir()}
    if "api_jp_data.yaml" in names:
        from rmis_calib.convert.data_sets import convert_surgpose

        return convert_surgpose(job, settings), replace(settings, laparoscope="none")
    if {"image", "kinematic"} <= names:
        from rmis_calib.convert.data_sets import convert_surgsync

        return convert_surgsync(job, settings), settings
    if "meta" in names and (path / "meta" / "info.json").is_file():
        from rmis_calib.convert.lerobot import convert_lerobot

        return convert_lerobot(job, settings)
    _refuse_jigsaws(sorted([*path.glob("*.txt"), *path.glob("kinematics/**/*.txt")])[:3])
    videos = [entry for entry in path.iterdir() if entry.suffix.lower() in VIDEOS]
    if any(video.with_suffix(".json").is_file() for video in videos):
        from rmis_calib.convert.session import convert_session

        return convert_session(job, settings), settings
    if "metadata.yaml" in names or any(Path(name).suffix in BAGS for name in names):
        from rmis_calib.convert.bags import convert_bag

        return convert_bag(job, settings), settings
    if any(Path(name).stem == "right" for name in names) and any(name.endswith(".csv") for name in names):
        from rmis_calib.convert.table import convert_table

        return convert_table(job, settings)
    found = ", ".join(sorted(names)[:8]) or "an empty folder"
    raise RecordingError(where=str(path), expected=_KNOWN, found=found)


def _refuse_jigsaws(paths: list[Path]) -> None:
    """Kinematics of JIGSAWS hold no joints and come without cameras: no calibration is possible."""
    for path in paths:
        if path.suffix.lower() != ".txt":
            continue
        with path.open(encoding="utf-8", errors="replace") as file:
            if len(file.readline().split()) == _JIGSAWS_COLUMNS:
                expected = "joints (or poses relative to the RCM) and calibrated cameras"
                found = "kinematics of JIGSAWS: tip poses only, without RCM, joints or camera calibration"
                raise RecordingError(where=str(path), expected=expected, found=found)
