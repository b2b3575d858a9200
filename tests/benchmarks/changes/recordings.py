"""Ways in which users' recordings differ from ours: each changes a copy of a recording folder, and its files along, so
that the true answer stays known (`reference.yaml`, changed along too where it moves).

Recordings hold folders of pictures, as the real ones and `broken_recordings.write_rendered` do. Harmless changes say
the same thing otherwise: verdict and answer should stay. Harmful ones make a file wrong, or spoil pictures.
"""

from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import av
import cv2
import numpy as np
import yaml

from tests.benchmarks.broken_recordings import Yaml, bumped_half_way, each_camera, edited
from tests.benchmarks.changes import cameras, images
from tests.benchmarks.changes.files import (
    column,
    eyes,
    joints,
    pictures,
    pictures_of,
    read_table,
    some_pictures,
    stated,
    times,
    without_labels,
    write_table,
)


@dataclass(frozen=True)
class Change:
    """What is done to the folder, and what should come of it."""

    apply: Callable[[Path], None]
    harmful: str = ""
    """Words of which the message should have one (separated by |) where the answer is not trustworthy or off; empty:
    harmless, nothing should change."""
    needs: str = ""
    """`stereo`, `lens`, `video` (joints logged more often than pictures are taken) or `poses` (one row a picture)."""


def fits(folder: Path, change: Change) -> bool:
    """Whether the recording is of the kind that this change needs."""
    recording, stereo = (yaml.safe_load((folder / name).read_text()) for name in ("recording.yaml", "stereo.yaml"))
    rows = len(read_table(folder / "joints.csv")[1])
    return {
        "": True,
        "stereo": "left" in recording,
        "lens": any(stereo["right"]["distortion"]),
        "video": rows > len(pictures_of(folder, "right")),
        "poses": rows == len(pictures_of(folder, "right")),
        "laparoscope": recording["laparoscope_arm"] is not None,
    }[change.needs]


def as_video(crf: int) -> Callable[[Path], None]:
    """H.264 at this quality, 4:2:0, in place of folders of pictures."""

    def apply(folder: Path) -> None:
        for side in eyes(folder):
            paths = pictures_of(folder, side)
            with av.open(str(folder / f"{side}.mp4"), "w") as file:
                stream: Any = file.add_stream("libx264", rate=25, options={"crf": str(crf)})
                stream.pix_fmt = "yuv420p"
                for i, path in enumerate(paths):
                    picture = np.asarray(cv2.imread(str(path)))
                    if not i:
                        stream.height, stream.width = picture.shape[:2]
                    file.mux(stream.encode(av.VideoFrame.from_ndarray(picture, "bgr24")))
                file.mux(stream.encode())
            stated("recording.yaml", **{side: f"{side}.mp4"})(folder)

    return apply


def frames_kept(keep: Callable[[int], np.ndarray]) -> Callable[[Path], None]:
    """Only some pictures, in this order; times stay in order, and with one row of joints a picture these go along."""

    def apply(folder: Path) -> None:
        n = len(pictures_of(folder, "right"))
        order = keep(n)
        for side in eyes(folder):
            paths = pictures_of(folder, side)
            seen = {int(i): paths[i].read_bytes() for i in order}
            suffix = paths[0].suffix
            for path in paths:
                path.unlink()
            for i, frame in enumerate(order):
                (folder / side / f"{i:06d}{suffix}").write_bytes(seen[int(frame)])
        header, rows = read_table(folder / "frame_times.csv")
        stamps, in_order = rows[:, 1], bool((np.diff(order) > 0).all())
        times_s = stamps[order] if in_order else stamps[: len(order)]
        write_table(folder / "frame_times.csv", header, np.stack([np.arange(len(order)), times_s], axis=1))
        if not in_order:
            joint_header, joint_rows = read_table(folder / "joints.csv")
            joint_rows = joint_rows[order]
            joint_rows[:, 0] = times_s
            write_table(folder / "joints.csv", joint_header, joint_rows)
        without_labels(folder)

    return apply


def resampled(rate_hz: float) -> Callable[[Path], None]:
    """Joints at another rate, straight between the samples that there are."""

    def change(_: list[str], rows: np.ndarray) -> np.ndarray:
        first, last = rows[0, 0], rows[-1, 0]
        stamps = np.unique(np.append(np.arange(first, last, 1 / rate_hz), last))
        return np.stack([stamps, *(np.interp(stamps, rows[:, 0], values) for values in rows.T[1:])], axis=1)

    return joints(change)


def shuffled_rows(_: list[str], rows: np.ndarray) -> np.ndarray:
    return np.random.default_rng(0).permutation(rows)


def backwards(folder: Path) -> None:
    """The film runs backwards, the joints too."""
    last_s = read_table(folder / "joints.csv")[1][-1, 0]
    n = len(pictures_of(folder, "right"))
    for side in eyes(folder):
        paths = pictures_of(folder, side)
        seen = [path.read_bytes() for path in paths]
        for path, content in zip(paths, reversed(seen), strict=True):
            path.write_bytes(content)
    times(lambda t: last_s - t, ("frame_times.csv", "joints.csv"))(folder)
    header, rows = read_table(folder / "frame_times.csv")
    rows[:, 0] = np.arange(n)
    write_table(folder / "frame_times.csv", header, rows)
    without_labels(folder)


def late_by_one(folder: Path) -> None:
    """The first picture was lost, and the others were counted on from there."""
    frames_kept(lambda n: np.arange(1, n))(folder)
    header, rows = read_table(folder / "frame_times.csv")
    step = np.median(np.diff(rows[:, 1]))
    rows[:, 1] = np.append(rows[0, 1] - step, rows[:-1, 1])
    write_table(folder / "frame_times.csv", header, rows)


def robot(change: Callable[[Yaml], Any]) -> Callable[[Path], None]:
    return lambda folder: edited(folder / "robot.yaml", change)


def rcm_missed(content: Yaml) -> None:
    """The axes of the first two joints pass each other 5 mm apart."""
    content["arms"]["instrument"]["joints"][1]["a_mm"] += 5.0


def bases_exchanged(content: Yaml) -> None:
    """Each arm with the other one's base."""
    one, other = content["arms"]["laparoscope"], content["arms"]["instrument"]
    one["base_T_arm_base"], other["base_T_arm_base"] = other["base_T_arm_base"], one["base_T_arm_base"]


def joints_exchanged(header: list[str], rows: np.ndarray) -> np.ndarray:
    yaw, pitch = header.index("instrument.yaw_rad"), header.index("instrument.pitch_rad")
    rows[:, [yaw, pitch]] = rows[:, [pitch, yaw]]
    return rows


def larger_radius(content: Yaml) -> None:
    content["shaft_diameter_mm"] *= 1.1


_BOTH = ("frame_times.csv", "joints.csv")
CHANGES: dict[str, Change] = {
    "as it is": Change(lambda folder: None),
    "half resolution": Change(pictures(images.resized(0.5), cameras.scaled_camera(0.5))),
    "double resolution": Change(pictures(images.resized(2.0), cameras.scaled_camera(2.0))),
    "crop, centre moved": Change(cameras.crop_told_in("stereo.yaml")),
    "crop, told": Change(cameras.crop_told_in("recording.yaml")),
    "JPEG 40": Change(pictures(images.recoded(40))),
    "H.264 crf 35": Change(as_video(35)),
    "grey": Change(pictures(images.grey)),
    "gamma 0.6": Change(pictures(images.gamma(0.6))),
    "gamma 1.6": Change(pictures(images.gamma(1.6))),
    "warm light": Change(pictures(images.tinted)),
    "noise": Change(pictures(images.noisy)),
    "blur": Change(pictures(images.blurred)),
    "lens undone": Change(cameras.lens(undo=True), needs="lens"),
    "lens added": Change(cameras.lens(undo=False)),
    "mirrored world": Change(cameras.mirrored_world),
    "camera upside down": Change(cameras.turned_half),
    "text": Change(pictures(images.with_text)),
    "logo": Change(pictures(images.with_logo)),
    "round field": Change(pictures(images.vignetted)),
    "black borders": Change(cameras.framed),
    "lines doubled": Change(pictures(images.line_doubled)),
    "interlaced": Change(pictures(images.combed)),
    "eyes exchanged": Change(cameras.roles_exchanged, needs="stereo"),
    "right eye only": Change(cameras.one_eye("right"), needs="stereo"),
    "left eye only": Change(cameras.one_eye("left"), needs="stereo"),
    "every second motion": Change(frames_kept(lambda n: np.arange(0, n, 2))),
    "first 8 motions": Change(frames_kept(lambda n: np.arange(8))),
    "other order": Change(frames_kept(lambda n: np.random.default_rng(0).permutation(n)), needs="poses"),
    "backwards": Change(backwards),
    "stamps since 1970": Change(times(lambda t: t + 1.7e9, _BOTH)),
    "ten times faster": Change(times(lambda t: 0.1 * t, _BOTH)),
    "joints 1 kHz": Change(resampled(1000.0)),
    "joints 10 Hz": Change(resampled(10.0)),
    "rows shuffled": Change(joints(shuffled_rows), harmful="timestamp"),
    "10 % black": Change(some_pictures(lambda seen, i: np.zeros_like(seen[i]))),
    "10 % frozen": Change(some_pictures(lambda seen, i: seen[i - 1]), harmful="repeat"),
    "diameter 10 % off": Change(lambda folder: edited(folder / "recording.yaml", larger_radius), "diameter|radius"),
    "yaw's sign": Change(column("instrument.yaw", np.negative), "sign"),
    "pitch's sign": Change(column("instrument.pitch", np.negative), "sign"),
    "yaw and pitch exchanged": Change(joints(joints_exchanged), "exchanged"),
    "insertion 50.8 mm off": Change(column("instrument.insertion", lambda d: d + 50.8), "insertion|offset|tool"),
    "RCM 5 mm off": Change(robot(rcm_missed), "remote centre|RCM|rcm_frame|misses"),
    "clock 50 ms off": Change(times(lambda t: t + 0.05), "clock", needs="video"),
    "one picture late": Change(late_by_one, "clock|out of step"),
    "bases exchanged": Change(robot(bases_exchanged), "base", needs="laparoscope"),
    "degrees for radians": Change(column("_rad", np.rad2deg), "deg|range|unit"),
    "metres for millimetres": Change(column("_mm", lambda d: d / 1000), "metre| m |unit|range"),
    "intrinsics of 1.5 times the size": Change(each_camera(cameras.scaled_camera(1.5)), "focal|size"),
    "eyes swapped, not told": Change(cameras.pictures_exchanged, "swapped", needs="stereo"),
    "mirrored, not told": Change(cameras.mirrored_untold, "mirror|sign"),
    "camera bumped half-way": Change(bumped_half_way, "moved"),
}
