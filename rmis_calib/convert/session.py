"""A session of the dVRK's recorder: mp4 with a sidecar JSON of time stamps, and a bag or extracted CSV of the arms."""

from pathlib import Path
from typing import Any

import numpy as np

from rmis_calib.convert.bags import cameras_of, read_logs
from rmis_calib.convert.files import take
from rmis_calib.convert.material import NS, Job, Logs, Material
from rmis_calib.convert.settings import ConvertSettings
from rmis_calib.convert.topic_tables import read_topic_table
from rmis_calib.errors import RecordingError
from rmis_calib.io._camera_formats.camera_info import CameraInfo
from rmis_calib.io._checks import Note
from rmis_calib.io.configs import load_json
from rmis_calib.io.readers import open_reader

# The nearest to the exposure first; what each is called in sidecars of 2025 and 2026.
_STAMPS = (
    ("when the source produced the frame", ("mono_source_ns", "cpu_realtime_mono_source_ns")),
    ("when the stereo stage left", ("stereo_output_ns", "cpu_realtime_stereo_output_ns")),
    ("when the overlay left", ("overlay_output_ns", "cpu_realtime_overlay_output_ns")),
    ("the recorder's preferred capture time", ("preferred_capture_time_ns",)),
    ("when the recorder received the frame", ("recorder_reception_ns", "cpu_realtime_recorder_reception_ns", "cpu_ns")),
)
_EYES = (("left_source_ns", "right_source_ns"), ("cpu_realtime_left_source_ns", "cpu_realtime_right_source_ns"))
_LISTS = {"timestamps_ns": 1, "timestamps_ms": 1_000_000, "timestamps": None}
_EARLIEST_NS = 100_000_000 * NS
"""1973: an earlier stamp is not since 1970, but a frame that carries none."""
_PAIR_SLACK = 0.5
_SPANS_APART, _SPANS_DIFFER = 3.0, 0.2
"""Factor between a video's length and that of its stamps beyond which they do not belong together, and share of it from
which that is told. Files of 25 or 60 frames a second may hold a stream of 30."""


def convert_session(job: Job, settings: ConvertSettings, video: Path | None = None) -> Material:
    """All of a recording from a session's folder, or from one video of it.

    Raises:
        RecordingError: no video with stamps, or no logs of arms; says what was looked for.
    """
    folder = job.source if video is None else job.source.parent
    videos = [video] if video is not None else sorted(p for p in folder.iterdir() if p.with_suffix(".json").is_file())
    videos = [p for p in videos if p.suffix.lower() in (".mp4", ".mkv", ".avi", ".mov")]
    right, left, sidecar = _choose(videos, job)
    stamps = _frame_stamps(right, sidecar, job.note)
    logs, infos = _logs(folder, settings, job)
    side_by_side = str(sidecar.get("side_by_side", "")).upper()
    layout = "side_by_side" if side_by_side in ("LR", "RL") else None
    if layout is not None:
        job.note(f"{right.name}: both eyes side by side, {side_by_side[0]} first (sidecar)")
    take(right, job.folder / f"right{right.suffix}")
    if left is not None:
        _check_pair(right, stamps, left, job)
        take(left, job.folder / f"left{left.suffix}")
    cameras = (
        cameras_of(infos, left is not None or layout is not None, bool(settings.rectified), job.note) if infos else None
    )
    return Material(
        logs, cameras, stamps, f"right{right.suffix}", None if left is None else f"left{left.suffix}", layout,
        side_by_side == "RL",
    )  # fmt: skip


def _choose(videos: list[Path], job: Job) -> tuple[Path, Path | None, dict[str, Any]]:
    """The right video (or that of both eyes), the left one, and the sidecar of the first."""
    sidecars = {
        path: load_json(path.with_suffix(".json"), RecordingError)
        for path in videos
        if path.with_suffix(".json").is_file()
    }
    if not sidecars:
        expected = "a video with a sidecar of the same name (.json) that holds its time stamps"
        raise RecordingError(
            where=str(job.source), expected=expected, found=", ".join(p.name for p in videos) or "none"
        )
    both = [p for p, raw in sidecars.items() if str(raw.get("side_by_side", "")).upper() in ("LR", "RL")]
    by_side = {side: [p for p in sidecars if side in p.stem.lower()] for side in ("right", "left")}
    if len(both) == 1:
        return both[0], None, sidecars[both[0]]
    if not both and len(by_side["right"]) == len(by_side["left"]) == 1:
        right, left = by_side["right"][0], by_side["left"][0]
        job.note(f"pictures: {right.name} and {left.name}, by their names")
        return right, left, sidecars[right]
    if len(sidecars) == 1:
        only = next(iter(sidecars))
        job.note(f"pictures: {only.name}, the only video (called right)")
        return only, None, sidecars[only]
    found = ", ".join(path.name for path in sidecars)
    raise RecordingError(
        where=str(job.source), expected="one video to convert: name it instead of the folder", found=found
    )


def _frame_stamps(video: Path, sidecar: dict[str, Any], note: Note) -> np.ndarray:
    """(N,) ns, one a frame of the video.

    Raises:
        RecordingError: the sidecar has no stamps, or another number of them than the video has frames.
    """
    ns, what = _stamps_of(sidecar, video)
    latency_ms = float(sidecar.get("estimated_latency_ms") or 0.0)
    reader = open_reader(video, len(ns))
    count = reader.count
    if count != len(ns):
        expected = f"a time stamp for each of the {count} frames"
        raise RecordingError(where=str(video.with_suffix(".json")), expected=expected, found=f"{len(ns)} stamps")
    _check_spans(video, ns, reader.times_s, note)
    note(
        f"{video.name}: frame times are {what}"
        + (f", less the latency of {latency_ms:g} ms that it states" if latency_ms else "")
    )
    return ns - round(latency_ms * 1e6)


def _check_spans(video: Path, ns: np.ndarray, own_s: np.ndarray | None, note: Note) -> None:
    """Refuse stamps over a time that the video by its own clock can hardly have taken: they are another video's."""
    if own_s is None or len(ns) < 2 or own_s[-1] <= own_s[0]:
        return
    stamped_s, own_span_s = (ns[-1] - ns[0]) / NS, float(own_s[-1] - own_s[0])
    if not own_span_s / _SPANS_APART < stamped_s < own_span_s * _SPANS_APART:
        expected = f"time stamps of {video.name}, which runs for {own_span_s:.3g} s"
        found = f"stamps over {stamped_s:.3g} s: the sidecar of another video?"
        raise RecordingError(where=str(video.with_suffix(".json")), expected=expected, found=found)
    if abs(stamped_s - own_span_s) > _SPANS_DIFFER * own_span_s:
        spans = f"{own_span_s:.3g} s by its own clock and {stamped_s:.3g} s by its sidecar"
        note(f"{video.name} runs for {spans}, which is used")


def _stamps_of(sidecar: dict[str, Any], video: Path) -> tuple[np.ndarray, str]:
    for name, factor in _LISTS.items():
        values = sidecar.get(name)
        if isinstance(values, list) and values:
            return _listed_ns(
                values, factor, f"{video.with_suffix('.json')}: {name}"
            ), f"the list {name} of the sidecar"
    frames = [_flat(frame) for frame in sidecar.get("frames") or [] if isinstance(frame, dict)]
    for left, right in _EYES:
        if frames and all(_is_stamp(frame.get(left)) and _is_stamp(frame.get(right)) for frame in frames):
            middle = [(int(frame[left]) + int(frame[right])) // 2 for frame in frames]
            return np.array(middle, dtype=np.int64), "midway between the left and the right source"
    for what, names in _STAMPS:
        for name in names:
            if frames and all(_is_stamp(frame.get(name)) for frame in frames):
                return np.array([int(frame[name]) for frame in frames], dtype=np.int64), what
    expected = "frames with time stamps since 1970 (or a list timestamps_ns, timestamps_ms, timestamps)"
    raise RecordingError(
        where=str(video.with_suffix(".json")), expected=expected, found=", ".join(sidecar) or "nothing"
    )


def _listed_ns(values: list[Any], factor: int | None, where: str) -> np.ndarray:
    """Stamps in ns; a list that does not name its unit shows it by its size."""
    try:
        factor = factor or (1 if values[0] > 1e17 else 1_000_000 if values[0] > 1e11 else NS)
        ns = [int(value) * factor if factor == 1 else round(float(value) * factor) for value in values]
        return np.array(ns, dtype=np.int64)
    except (TypeError, ValueError, OverflowError) as problem:
        raise RecordingError(where=where, expected="a list of numbers", found=str(problem)) from problem


def _flat(frame: dict[str, Any]) -> dict[str, Any]:
    """A frame's stamps without the groups that newer sidecars put them in."""
    flat = dict(frame)
    for value in frame.values():
        if isinstance(value, dict):
            flat |= value
    return flat


def _is_stamp(value: Any) -> bool:
    return isinstance(value, int | float) and _EARLIEST_NS < value < 2**63 - 1


def _check_pair(right: Path, stamps: np.ndarray, left: Path, job: Job) -> None:
    others = _frame_stamps(left, load_json(left.with_suffix(".json"), RecordingError), job.note)
    slack = _PAIR_SLACK * float(np.median(np.diff(stamps))) if len(stamps) > 1 else NS
    if len(others) != len(stamps) or float(np.abs(others - stamps).max()) > slack:
        expected = f"the frames of {right.name}, each within half a frame interval"
        found = (
            f"{len(others)} frames"
            if len(others) != len(stamps)
            else f"{np.abs(others - stamps).max() / 1e6:.3g} ms apart"
        )
        raise RecordingError(where=str(left), expected=expected, found=found)


def _logs(folder: Path, settings: ConvertSettings, job: Job) -> tuple[Logs, dict[str, CameraInfo]]:
    """Logs of arms in bags and tables of a session's folder."""
    logs = Logs({})
    infos: dict[str, CameraInfo] = {}
    bags = [path.parent for path in sorted(folder.rglob("metadata.yaml"))]
    bags += [
        path
        for path in sorted(folder.rglob("*"))
        if path.suffix in (".bag", ".mcap", ".db3") and path.parent not in bags
    ]
    for bag in bags:
        found, cameras = read_logs(bag, settings, job.note)
        logs = Logs(found.arms | logs.arms, found.placings | logs.placings)
        infos = cameras | infos
        job.note(f"arms: {', '.join(found.arms) or 'none'} of {bag.relative_to(folder)}")
    for path in sorted(folder.rglob("*.csv")):
        read_topic_table(path, folder, logs, job.note)
    logs = logs.with_content()
    if not logs.arms:
        expected = "a bag or extracted tables (PSM1_measured_js.csv) beside the video"
        raise RecordingError(where=str(folder), expected=expected, found="neither")
    return logs, infos
