"""A recording folder of what a source held: joints.csv, frame_times.csv, stereo.yaml, recording.yaml."""

import csv
import shutil
from pathlib import Path

import numpy as np
import yaml

from rmis_calib.convert.bases import with_logged_bases
from rmis_calib.convert.joints import Readings, choose_robot, motion_of, readings_of, robot_arms
from rmis_calib.convert.material import NEEDS_STEREO, NS, ArmLog, Job, Material
from rmis_calib.convert.settings import STILL, ConvertSettings
from rmis_calib.errors import RecordingError
from rmis_calib.io.joints import JointLog
from rmis_calib.io.robot import load_robot, robot_to_dict
from rmis_calib.robot import Robot


def assemble(material: Material, job: Job, settings: ConvertSettings) -> None:
    """Write everything but the pictures, which are there already.

    Raises:
        RecordingError: no instrument's arm, no robot that can be told, no cameras; says what to give.
    """
    instrument = _instrument(material.logs.arms, settings, job)
    laparoscope = _laparoscope(material.logs.arms, instrument, settings, job)
    logs = [log for log in (instrument, laparoscope) if log is not None]
    name = settings.robot or material.robot or choose_robot(logs, job.note)
    robot = load_robot(name, job.note)
    instrument_arm, laparoscope_arm = robot_arms(robot)
    if laparoscope is not None and laparoscope_arm is None:
        raise RecordingError(where=name, expected=f"an arm for {laparoscope.name}, or --laparoscope none", found="none")
    arms, placed = {instrument_arm: instrument}, robot
    if laparoscope is not None and laparoscope_arm is not None:
        arms[laparoscope_arm] = laparoscope
        in_robot_and_source = (laparoscope_arm, laparoscope.name), (instrument_arm, instrument.name)
        placed = with_logged_bases(robot, *in_robot_and_source, material.logs.placings, job.note)
    origin_ns = int(material.frame_ns[0]) // NS * NS
    job.note(f"time 0 is {origin_ns // NS} s on the source's clock")
    _write_joints(job.folder / "joints.csv", robot, arms, origin_ns, job)
    _write_frame_times(job.folder / "frame_times.csv", material.frame_ns, origin_ns)
    content = {
        "format": "rmis-calib/1",
        "robot": _robot_entry(name, None if placed is robot else placed, job.folder),
        "stereo": _stereo_entry(material, job, settings),
        "right": material.right,
    }
    content |= {"left": material.left} if material.left is not None else {}
    content |= {"stereo_layout": material.stereo_layout} if material.stereo_layout is not None else {}
    content |= {"swapped": True} if material.swapped else {}
    content |= {"joints": "joints.csv", "frame_times": "frame_times.csv"}
    content |= {
        "laparoscope_arm": laparoscope_arm if laparoscope is not None else None,
        "instrument_arm": instrument_arm,
    }
    content |= {"shaft_diameter_mm": settings.shaft_diameter_mm}
    for key, crop in (("crop_right", settings.crop_right), ("crop_left", settings.crop_left)):
        content |= {key: list(crop)} if crop is not None else {}
    job.note(f"shaft_diameter_mm {settings.shaft_diameter_mm:g} is assumed (--shaft-diameter-mm for 5 mm tools)")
    (job.folder / "recording.yaml").write_text(yaml.safe_dump(content, sort_keys=False), encoding="utf-8")


def add_notes(folder: Path, notes: list[str]) -> None:
    """Keep what was guessed in recording.yaml."""
    path = folder / "recording.yaml"
    content = yaml.safe_load(path.read_text(encoding="utf-8")) | {"notes": list(notes)}
    path.write_text(yaml.safe_dump(content, sort_keys=False, width=200, allow_unicode=True), encoding="utf-8")


def _instrument(arms: dict[str, ArmLog], settings: ConvertSettings, job: Job) -> ArmLog:
    """The arm that was asked for, or the instrument that moves most."""
    if settings.instrument is not None:
        if settings.instrument not in arms:
            found = ", ".join(arms) or "no arm"
            raise RecordingError(where=str(job.source), expected=f"a log of {settings.instrument}", found=found)
        return arms[settings.instrument]
    candidates = [log for name, log in arms.items() if not name.upper().startswith(("ECM", "MTM", "SUJ"))]
    if not candidates:
        found = ", ".join(arms) or "no arm"
        raise RecordingError(where=str(job.source), expected="a log of an instrument's arm (PSM1, ...)", found=found)
    # Joints before poses alone: an arm that is only posed may not tell its shaft.
    best = max(candidates, key=lambda log: (log.has_joints, motion_of(log)))
    if len(candidates) > 1:
        others = ", ".join(log.name for log in candidates if log is not best)
        job.note(f"instrument: {best.name}, which moves more than {others} (--instrument names another)")
    else:
        job.note(f"instrument: {best.name}, the only instrument's arm that is logged")
    return best


def _laparoscope(arms: dict[str, ArmLog], instrument: ArmLog, settings: ConvertSettings, job: Job) -> ArmLog | None:
    if settings.laparoscope in STILL:
        job.note("laparoscope: the camera stands still; the frame `arm` is the instrument's base")
        return None
    if settings.laparoscope is not None:
        if settings.laparoscope not in arms:
            found = ", ".join(arms) or "no arm"
            raise RecordingError(where=str(job.source), expected=f"a log of {settings.laparoscope}", found=found)
        return arms[settings.laparoscope]
    found = next((log for name, log in arms.items() if name.upper().startswith("ECM") and log is not instrument), None)
    if found is None:
        job.note("laparoscope: no arm of it is logged; the camera is taken to stand still")
    else:
        job.note(f"laparoscope: {found.name}")
    return found


def _write_joints(path: Path, robot: Robot, arms: dict[str, ArmLog], origin_ns: int, job: Job) -> None:
    """One table on the instrument's stamps; the other arm's readings are interpolated to them."""
    readings = {name: readings_of(log, name, robot.arms[name], job.note) for name, log in arms.items()}
    names = list(readings)
    base = readings[names[0]]
    ns = base.ns
    for other in names[1:]:
        ns = ns[(ns >= readings[other].ns[0]) & (ns <= readings[other].ns[-1])]
    if not len(ns):
        spans = ", ".join(f"{name} {(r.ns[-1] - r.ns[0]) / NS:.3g} s" for name, r in readings.items())
        raise RecordingError(where=str(job.source), expected="logs of both arms at the same time", found=spans)
    order = [name for name in robot.arms if name in readings]
    columns = [column for name in order for column in robot.columns(name)]
    found = [_at(readings[name], robot.columns(name), ns) for name in order]
    known = np.logical_and.reduce([valid for _, valid in found])
    if not known.all():
        job.note(f"{int((~known).sum())} of {len(ns)} samples were left out: one arm's log has a gap there")
    values, ns = np.concatenate([rows for rows, _ in found], axis=1)[known], ns[known]
    with path.open("w", newline="", encoding="utf-8") as file:
        writer = csv.writer(file, lineterminator="\n")
        writer.writerow(["timestamp_s", *columns])
        for stamp, row in zip(ns.tolist(), values.tolist(), strict=True):
            writer.writerow([_seconds(stamp - origin_ns), *(repr(value) for value in row)])


def _at(readings: Readings, columns: tuple[str, ...], ns: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """(T, J) at some stamps and (T,) where they are known: never across a gap in the arm's log."""
    start = readings.ns[0]
    return JointLog((readings.ns - start) / NS, columns, readings.values).at((ns - start) / NS)


def _write_frame_times(path: Path, frame_ns: np.ndarray, origin_ns: int) -> None:
    lines = ["frame,timestamp_s", *(f"{i},{_seconds(ns - origin_ns)}" for i, ns in enumerate(frame_ns.tolist()))]
    path.write_text("\n".join(lines) + "\n", encoding="utf-8")


def _seconds(ns: int) -> str:
    """Nanoseconds as seconds, to the last digit."""
    sign, size = ("-", -ns) if ns < 0 else ("", ns)
    return f"{sign}{size // NS}.{size % NS:09d}"


def _robot_entry(name: str, placed: Robot | None, folder: Path) -> str:
    """A shipped robot by name; a file is copied into the recording; one whose bases were found is written."""
    if placed is not None:
        text = yaml.safe_dump(robot_to_dict(placed), sort_keys=False, default_flow_style=None, width=200)
        (folder / "robot.yaml").write_text(text, encoding="utf-8")
        return "robot.yaml"
    if Path(name).suffix.lower() in (".yaml", ".yml"):
        shutil.copyfile(name, folder / "robot.yaml")
        return "robot.yaml"
    return name


def _stereo_entry(material: Material, job: Job, settings: ConvertSettings) -> str:
    from rmis_calib.io.readers import open_reader
    from rmis_calib.io.stereo import read_stereo

    def picture_size() -> tuple[int, int]:
        height, width = open_reader(job.folder / material.right).size
        return (height, width // 2) if material.stereo_layout == "side_by_side" else (height, width)

    cameras = material.cameras
    if settings.stereo is not None:
        cameras = read_stereo(settings.stereo, job.note, picture_size)
    if cameras is None:
        raise RecordingError(where=str(job.source), expected=NEEDS_STEREO, found="no calibration in the source")
    text = yaml.safe_dump(cameras.to_dict(), sort_keys=False, default_flow_style=None, width=200)
    (job.folder / "stereo.yaml").write_text(text, encoding="utf-8")
    return "stereo.yaml"
