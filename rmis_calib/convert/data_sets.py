"""Published data sets with pictures, joints and cameras: SurgPose and SurgSync."""

import json
from pathlib import Path
from typing import Any

import numpy as np
import yaml

from rmis_calib.convert.files import take, take_pictures
from rmis_calib.convert.material import NS, ArmLog, Job, Logs, Material
from rmis_calib.convert.settings import ConvertSettings
from rmis_calib.errors import RecordingError
from rmis_calib.io.folders import natural_order
from rmis_calib.io.readers import open_reader
from rmis_calib.io.stereo import read_stereo

_SURGPOSE_HZ = 30.0
_SURGPOSE_JOINTS = 6
_SURGPOSE_CAMERAS = "StereoCalibrationDVRK.ini"


def convert_surgpose(job: Job, settings: ConvertSettings) -> Material:
    """SurgPose: videos of both eyes at 30 Hz, joints a frame, no time stamps; a dVRK Classic, the camera stands still.

    Raises:
        RecordingError: a file is missing, or frames and joints do not go together.
    """
    folder = job.source
    videos = {side: _first(folder, (f"regular/{side}_video.mp4", f"{side}_video.mp4")) for side in ("right", "left")}
    count = open_reader(videos["right"]).count
    interval_ns = NS / (settings.rate_hz or _SURGPOSE_HZ)
    frame_ns = np.round(np.arange(count) * interval_ns).astype(np.int64) + NS
    arms = _surgpose_joints(folder / "api_jp_data.yaml", interval_ns)
    job.note(
        f"SurgPose: {count} frames at {1e9 / interval_ns:g} Hz, joints by frame number (a clock offset is looked for)"
    )
    for side, video in videos.items():
        take(video, job.folder / f"{side}{video.suffix}")
    cameras = None
    if settings.stereo is None:
        cameras = read_stereo(_first(folder, (_SURGPOSE_CAMERAS, f"../{_SURGPOSE_CAMERAS}")), job.note)
    job.note(
        "robot: dvrk-classic, since SurgPose was recorded on one with IS1200 instruments (--robot for another tool)"
    )
    suffixes = {side: video.suffix for side, video in videos.items()}
    return Material(
        Logs(arms), cameras, frame_ns, f"right{suffixes['right']}", f"left{suffixes['left']}", robot="dvrk-classic"
    )


def _surgpose_joints(path: Path, interval_ns: float) -> dict[str, ArmLog]:
    """Joints of every arm, by frame: {"0": {"PSM1": [6 numbers]}, ...}."""
    arms: dict[str, ArmLog] = {}
    try:
        with path.open(encoding="utf-8") as file:
            frames = yaml.load(file, Loader=getattr(yaml, "CSafeLoader", yaml.SafeLoader))
        for index in sorted(frames, key=int):
            for name, joints in frames[index].items():
                log = arms.setdefault(str(name), ArmLog(str(name)))
                log.joints.append(np.array(joints, dtype=np.float64).reshape(_SURGPOSE_JOINTS))
                log.joint_ns.append(round(int(index) * interval_ns) + NS)
    except (yaml.YAMLError, ValueError, TypeError, AttributeError, LookupError) as problem:
        expected = f"a mapping of frame numbers to arms with {_SURGPOSE_JOINTS} joints each"
        raise RecordingError(
            where=str(path), expected=expected, found=" ".join(str(problem).split())[:120]
        ) from problem
    return arms


def convert_surgsync(job: Job, settings: ConvertSettings) -> Material:
    """SurgSync's raw clips: image/SIDE/i.png, kinematic/ARM/i.json, time_syn/i.json, camera_calibration.

    Raises:
        RecordingError: a file is missing or of another form.
    """
    folder = job.source
    eyes = {side: _numbered(folder / "image" / side) for side in ("right", "left")}
    numbers = sorted(set.intersection(*(set(found) for found in eyes.values() if found)), key=int)
    if not eyes["right"] or not numbers:
        raise RecordingError(where=str(folder / "image"), expected="pictures in right and left", found="none in common")
    stamps = [_time_syn(folder / "time_syn" / f"{number}.json") for number in numbers]
    if not all(stamps) and settings.rate_hz is None:
        expected = "time_syn/NUMBER.json of every frame, or --rate-hz"
        raise RecordingError(where=str(folder / "time_syn"), expected=expected, found="none of some")
    frame_ns = [
        _ns(stamp.get("image_right_stamp") or stamp.get("image_left_stamp"))
        if stamp
        else round(i * NS / (settings.rate_hz or 1.0))
        for i, stamp in enumerate(stamps)
    ]
    arms = {}
    for arm_folder in sorted(path for path in (folder / "kinematic").iterdir() if path.is_dir()):
        log = arms[arm_folder.name] = ArmLog(arm_folder.name, is_local=True)
        for number, stamp, ns in zip(numbers, stamps, frame_ns, strict=True):
            _add_kinematics(log, arm_folder / f"{number}.json", stamp, ns)
        job.note(f"{log.name}: {len(log.joints)} readings, {len(log.poses)} poses relative to its RCM")
    cameras = None
    if settings.stereo is None:
        calibration = next(
            (folder / name for name in ("camera_calibration", "calibration") if (folder / name).is_dir()), None
        )
        cameras = None if calibration is None else read_stereo(calibration, job.note)
    for side, found in eyes.items():
        if found:
            take_pictures([found[number] for number in numbers], job.folder / side)
    job.note(f"SurgSync: {len(numbers)} frames; stamps of the right pictures and of each arm's measured_js")
    return Material(Logs(arms), cameras, np.array(frame_ns, dtype=np.int64), "right", "left" if eyes["left"] else None)


def _add_kinematics(log: ArmLog, path: Path, stamp: dict[str, Any] | None, frame_ns: int) -> None:
    if not path.is_file():
        return
    raw = _json(path)
    try:
        data = (raw[0] if isinstance(raw, list) else raw)["arm"]["measured_data"]
        own = ((stamp or {}).get("Kinematics_set_1") or {}).get(log.name, {}).get("measured_data") or {}
        if data.get("measured_js", {}).get("position"):
            log.joints.append(np.array(data["measured_js"]["position"], dtype=np.float64))
            log.joint_ns.append(_ns(own.get("measured_js_stamp")) or frame_ns)
        pose = data.get("local_measured_cp") or {}
        if pose.get("position") and pose.get("orientation"):
            log.poses.append(np.array([*pose["position"], *pose["orientation"]], dtype=np.float64))
            log.pose_ns.append(_ns(own.get("local_measured_cp_stamp")) or frame_ns)
    except (KeyError, IndexError, TypeError, ValueError, AttributeError) as problem:
        expected = "arm.measured_data with measured_js and local_measured_cp"
        raise RecordingError(where=str(path), expected=expected, found="another form") from problem


def _time_syn(path: Path) -> dict[str, Any] | None:
    raw = _json(path) if path.is_file() else None
    return raw if isinstance(raw, dict) and ("image_right_stamp" in raw or "image_left_stamp" in raw) else None


def _ns(stamp: Any) -> int:
    return int(stamp["sec"]) * NS + int(stamp.get("nsec", stamp.get("nanosec", 0))) if isinstance(stamp, dict) else 0


def _numbered(folder: Path) -> dict[str, Path]:
    """Pictures by their number."""
    if not folder.is_dir():
        return {}
    files = sorted(
        (path for path in folder.iterdir() if path.stem.isdigit()), key=lambda path: natural_order(path.name)
    )
    return {path.stem: path for path in files}


def _json(path: Path) -> Any:
    try:
        return json.loads(path.read_text(encoding="utf-8-sig"))
    except (OSError, ValueError) as problem:
        raise RecordingError(where=str(path), expected="a JSON file", found="other text") from problem


def _first(folder: Path, names: tuple[str, ...]) -> Path:
    for name in names:
        if (folder / name).is_file():
            return folder / name
    raise RecordingError(where=str(folder), expected=names[0], found="nothing")
