"""One episode of a LeRobot data set (v2), as Open-H publishes surgical robots: a table a frame, and a video a camera.

Source: meta/info.json names the files (`data_path`, `video_path`) and the columns (`features`, with `names`).
"""

from pathlib import Path
from typing import Any

import numpy as np

from rmis_calib.convert.files import take
from rmis_calib.convert.material import NS, Job, Material
from rmis_calib.convert.settings import ConvertSettings
from rmis_calib.convert.table import logs_of_table, require_robot
from rmis_calib.errors import FileError, RecordingError
from rmis_calib.io._csv import Table
from rmis_calib.io.configs import load_json
from rmis_calib.io.readers import open_reader
from rmis_calib.io.stereo import read_stereo

_CALIBRATIONS = ("camera_calibration", "calibration/camera_calibration")
_START_NS = NS
"""Time of a frame at 0 s: a recording's clock is none of 1970."""


def convert_lerobot(job: Job, settings: ConvertSettings) -> tuple[Material, ConvertSettings]:
    """All of a recording from one episode: joints by `--map`, cameras by the words right and left in their names.

    Raises:
        FileError: a file of the episode is absent or damaged.
        RecordingError: another version, an episode or a camera that must be named, a missing column; says what to give.
    """
    where = job.source / "meta" / "info.json"
    info = load_json(where, RecordingError)
    version = str(info.get("codebase_version", "none"))
    if not version.startswith("v2"):
        expected = "a LeRobot data set of version 2, with a video for each episode (LeRobot converts others)"
        raise RecordingError(where=f"{where}: codebase_version", expected=expected, found=version)
    require_robot(job, settings)
    try:
        episode = _episode(info, settings, str(where))
        place = {"episode_index": episode, "episode_chunk": episode // int(info.get("chunks_size") or 1000)}
        keys = _cameras(info["features"], settings, str(where))
        videos = {s: job.source / info["video_path"].format(video_key=key, **place) for s, key in keys.items()}
        table, seconds = _read_table(job.source / info["data_path"].format(**place), info["features"])
    except (KeyError, TypeError, ValueError, AttributeError) as problem:
        expected = "total_episodes, features, data_path and video_path of LeRobot"
        raise RecordingError(
            where=str(where), expected=expected, found=f"{type(problem).__name__} {problem}"
        ) from problem
    row_ns = np.round(seconds * NS).astype(np.int64) + _START_NS
    job.note(f"LeRobot {version}, episode {episode}: {len(row_ns)} frames, joints and pictures by frame")
    job.note(f"cameras: {', '.join(f'{side} {key}' for side, key in keys.items())}")
    logs, settings = logs_of_table(table, row_ns, settings, job)
    names = {}
    for side, video in videos.items():
        count = open_reader(video).count
        if count != len(row_ns):
            raise RecordingError(where=str(video), expected=f"{len(row_ns)} frames as {table.path.name}", found=count)
        names[side] = f"{side}{video.suffix}"
        take(video, job.folder / names[side])
    folder = next((job.source / name for name in _CALIBRATIONS if (job.source / name).is_dir()), None)
    cameras = None if folder is None or settings.stereo is not None else read_stereo(folder, job.note)
    return Material(logs, cameras, row_ns, names["right"], names.get("left")), settings


def _episode(info: dict[str, Any], settings: ConvertSettings, where: str) -> int:
    total = int(info["total_episodes"])
    chosen = 0 if settings.episode is None and total == 1 else settings.episode
    if chosen is None or not 0 <= chosen < total:
        found = "none" if chosen is None else chosen
        raise RecordingError(where=where, expected=f"--episode, 0 to {total - 1}", found=found)
    return chosen


def _cameras(features: dict[str, Any], settings: ConvertSettings, where: str) -> dict[str, str]:
    """Feature of each eye's video: those that were named, or the only ones with right and left in their names."""
    keys = [key for key, feature in features.items() if feature.get("dtype") == "video"]
    named = {"right": settings.right_topic, "left": settings.left_topic}
    found = {}
    for side, key in named.items():
        fits = [k for k in keys if k == key] if key is not None else [k for k in keys if side in k.lower()]
        if len(fits) > 1 or (key is not None and not fits):
            raise RecordingError(where=where, expected=f"--{side}-topic, a video", found=", ".join(keys))
        found |= {side: fits[0]} if fits else {}
    if "right" not in found and len(keys) == 1:
        found = {"right": keys[0]}
    if "right" not in found:
        raise RecordingError(where=where, expected="--right-topic, a video", found=", ".join(keys) or "no video")
    return found


def _read_table(path: Path, features: dict[str, Any]) -> tuple[Table, np.ndarray]:
    """Numbers of the episode, a column for each name of each feature; and the time of each row, s."""
    try:
        import pyarrow.parquet
    except ImportError as problem:
        raise FileError(where=str(path), expected="the package pyarrow", found="nothing") from problem
    try:
        content = pyarrow.parquet.read_table(path)
    except (OSError, pyarrow.ArrowException) as problem:
        raise FileError(
            where=str(path), expected="a Parquet file", found=str(problem).splitlines()[0][:200]
        ) from problem
    columns: dict[str, np.ndarray] = {}
    for key in content.column_names:
        names = _names(features.get(key, {}).get("names"))
        values = np.array(content[key].to_pylist(), dtype=np.float64) if names else None
        if values is not None and values.ndim == 2 and values.shape[1] == len(names):
            columns |= {f"{key}/{name}": values[:, i] for i, name in enumerate(names)}
    if not columns:
        raise FileError(where=str(path), expected="a feature with names, such as observation.state", found="none")
    seconds = np.array(content["timestamp"].to_pylist(), dtype=np.float64).reshape(-1)
    return Table(path, tuple(columns), np.stack(list(columns.values()), axis=1)), seconds


def _names(names: Any) -> list[str]:
    """Names of a feature's components: a list, or lists by group."""
    if isinstance(names, dict):
        return [str(name) for group in names.values() for name in (group if isinstance(group, list) else [group])]
    return [str(name) for name in names or []]
