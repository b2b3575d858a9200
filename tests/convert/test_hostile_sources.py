"""Sources as they should not be: one clear line, exit code 2, and nothing of an output."""

import json
import re
import shutil
from collections.abc import Callable
from pathlib import Path

import cv2
import numpy as np
import pytest
import yaml
from bag_writing import RIG, BagWriter, camera_infos, read_recording, to_ns, write_bag
from test_sessions_and_sets import pictures, sidecar, surgsync, write_joint_csv, write_video

from rmis_calib.cli import main

JOINTS = ["yaw", "pitch", "insertion"]


def bag(
    rendered: Path,
    path: Path,
    joints: Callable[[int, np.ndarray], np.ndarray] = lambda i, values: values,
    picture: Callable[[int, np.ndarray], np.ndarray | bytes] = lambda i, rgb: rgb,
    late_s: float = 0.0,
) -> Path:
    """A ROS1 bag of the recording whose instrument's joints, or pictures, are changed."""
    times, columns, rows, stereo = read_recording(rendered)
    index = {
        arm: [i for i, c in enumerate(columns) if c.startswith(f"{arm}.")] for arm in ("laparoscope", "instrument")
    }
    with BagWriter(path, "ros1") as writer:
        for i, row in enumerate(rows):
            writer.joints("/ECM/measured_js", to_ns(row[0]), JOINTS, row[index["laparoscope"]] * [1, 1, 1e-3])
            values = joints(i, row[index["instrument"]] * [1, 1, 1e-3])
            writer.joints("/PSM1/measured_js", to_ns(row[0]), JOINTS, values)
        for i, time_s in enumerate(times):
            for side, info in camera_infos(stereo).items():
                shown = picture(i, cv2.imread(str(rendered / side / f"{i:06d}.png"))[..., ::-1])
                ns, topic = to_ns(time_s + late_s), f"{RIG}/{side}/image_raw"
                if isinstance(shown, bytes):
                    writer.compressed(f"{topic}/compressed", ns, shown, "jpeg")
                else:
                    writer.image(topic, ns, np.ascontiguousarray(shown))
                writer.camera_info(f"{RIG}/{side}/camera_info", ns, *info)
    return path


def refused(capsys: pytest.CaptureFixture[str], *command: object) -> str:
    """The one line of a conversion that is refused, with nothing left behind."""
    words = [str(word) for word in command]
    out = Path(words[words.index("--out") + 1])
    before = sorted(out.parent.iterdir())
    assert main(["convert", *words]) == 2
    assert sorted(out.parent.iterdir()) == before
    lines = [line for line in capsys.readouterr().err.splitlines() if not line.startswith("reading the bag")]
    assert len(lines) == 1
    return lines[0]


def degrees(i: int, values: np.ndarray) -> np.ndarray:
    return values * [57.3, 57.3, 1]


def numbers_missing(i: int, values: np.ndarray) -> np.ndarray:
    return values * np.nan


def resized(i: int, rgb: np.ndarray) -> np.ndarray:
    return cv2.resize(rgb, (320, 240))


def cropped_later(i: int, rgb: np.ndarray) -> np.ndarray:
    return rgb if i < 3 else rgb[:100]


@pytest.mark.parametrize(
    ("change", "message"),
    [
        (
            {"joints": degrees},
            r"a.bag, as a recording: joints.csv line 2, column instrument.yaw_rad: looks like degrees",
        ),
        ({"joints": numbers_missing}, "PSM1: expected joints or poses that are numbers, found none in"),
        (
            {"picture": resized},
            r"expected frames of 160 x 120 px as in stereo.yaml, found 320 x 240: the same shape at 2",
        ),
        ({"picture": cropped_later}, "expected pictures of 160 x 120 px, found 160 x 100 in picture 3"),
        ({"late_s": 5000.0}, "expected joints at the time of some frame"),
    ],
)
def test_a_bag_that_is_wrong_in_one_thing(
    rendered: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str], change: dict, message: str
) -> None:
    source = bag(rendered, tmp_path / "a.bag", **change)
    line = refused(capsys, source, "--out", tmp_path / "out", "--robot", rendered / "robot.yaml")
    assert re.search(message, line) and ".tmp" not in line


def test_arms_that_are_not_there_are_told_before_the_bag_is_read(
    rendered: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    source = bag(rendered, tmp_path / "a.bag")
    command = [source, "--out", tmp_path / "out", "--robot", rendered / "robot.yaml", "--instrument", "PSM9"]
    assert main(["convert", *map(str, command)]) == 2
    error = capsys.readouterr().err
    assert "expected a log of PSM9, found ECM, PSM1" in error and "reading the bag" not in error


def test_messages_without_all_joints_and_pictures_that_break_off_are_left_out(rendered: Path, tmp_path: Path) -> None:
    def jpeg(i: int, rgb: np.ndarray) -> bytes:
        encoded = cv2.imencode(".jpg", rgb[..., ::-1])[1].tobytes()
        return encoded if i != 2 else encoded[:300]

    source = bag(rendered, tmp_path / "a.bag", joints=lambda i, v: v if i % 7 else v[:2], picture=jpeg)
    assert main(["convert", str(source), "--out", str(tmp_path / "out"), "--robot", str(rendered / "robot.yaml")]) == 0
    times, _, rows, _ = read_recording(tmp_path / "out")
    all_times, _, all_rows, _ = read_recording(rendered)
    assert len(times) == len(all_times) - 1 and len(list((tmp_path / "out" / "left").iterdir())) == len(times)
    assert len(rows) == len(all_rows) - len(all_rows[::7])
    notes = yaml.safe_load((tmp_path / "out" / "recording.yaml").read_text())["notes"]
    assert "2 pictures that break off were left out" in notes


def test_a_damaged_database(rendered: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    source = write_bag(rendered, tmp_path / "a", "sqlite3")
    (database,) = source.glob("*.db3")
    data = bytearray(database.read_bytes())
    data[len(data) // 3 : len(data) // 3 + 40_000] = np.random.default_rng(0).bytes(40_000)
    database.write_bytes(data)
    line = refused(capsys, source, "--out", tmp_path / "out", "--robot", rendered / "robot.yaml")
    assert "expected a whole bag (--salvage converts what is whole of it)" in line


def session(rendered: Path, folder: Path, content: object) -> Path:
    folder.mkdir()
    pairs = zip(pictures(rendered, "right"), pictures(rendered, "left"), strict=True)
    write_video(folder / "a.mp4", [np.concatenate(pair, axis=1) for pair in pairs])
    (folder / "a.json").write_text(content if isinstance(content, str) else json.dumps(content))
    for arm, name in (("PSM1", "instrument"), ("ECM", "laparoscope")):
        write_joint_csv(rendered, folder, arm, name)
    return folder


def test_sidecars_of_other_videos_and_other_files(
    rendered: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    good = sidecar(rendered, "list_s", side_by_side="RL")
    first = good["timestamps"][0]
    cases = {
        "rate": (good | {"timestamps": [first + 10 * i for i in range(6)]}, "stamps over 50 s: the sidecar of another"),
        "later": (good | {"timestamps": [t + 9999 for t in good["timestamps"]]}, "none close enough to one"),
        "null": (
            good | {"timestamps": [first, None, *good["timestamps"][2:]]},
            "timestamps: expected a list of numbers",
        ),
        "words": (good | {"timestamps": ["x"] * 6}, "timestamps: expected a list of numbers"),
        "list": ("[1, 2]", "expected a JSON mapping of keys to values, found list"),
        "cut": ('{"frames": [', "expected a JSON file, found other text"),
    }
    command = ["--robot", rendered / "robot.yaml", "--stereo", rendered / "stereo.yaml"]
    for name, (content, message) in cases.items():
        source = session(rendered, tmp_path / name, content)
        assert message in refused(capsys, source, "--out", tmp_path / "out", *command), name
    table = tmp_path / "words" / "PSM1_measured_js.csv"
    table.write_text(table.read_text() + "1,2,3,x,y,z\n")
    (tmp_path / "words" / "a.json").write_text(json.dumps(good))
    assert "expected numbers in every row" in refused(capsys, table.parent, "--out", tmp_path / "out", *command)


def test_data_sets_with_broken_files(rendered: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    folder = tmp_path / "surgpose"
    (folder / "regular").mkdir(parents=True)
    for side in ("right", "left"):
        write_video(folder / "regular" / f"{side}_video.mp4", pictures(rendered, side), rate=30)
    for text in ("{a: [}", "hello", "[1]", '{"0": {PSM1: [1, 2]}}', '{"0": 5}'):
        (folder / "api_jp_data.yaml").write_text(text)
        line = refused(capsys, folder, "--out", tmp_path / "out", "--stereo", rendered / "stereo.yaml")
        assert "expected a mapping of frame numbers to arms with 6 joints each" in line, text
    clip = tmp_path / "clip"
    surgsync(rendered, clip)
    (clip / "kinematic" / "PSM1" / "7.json").write_text("[]")
    line = refused(capsys, clip, "--out", tmp_path / "out", "--robot", "dvrk-classic")
    assert "7.json: expected arm.measured_data" in line
    shutil.rmtree(clip / "kinematic")
    assert "expected a ROS1 .bag" in refused(capsys, clip, "--out", tmp_path / "out", "--robot", "dvrk-classic")
