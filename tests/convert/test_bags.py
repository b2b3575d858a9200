"""Bags written by rosbags, converted back, against the recording that they were made of."""

import shutil
from pathlib import Path

import cv2
import numpy as np
import pytest
import yaml
from bag_writing import RIG, START_S, BagWriter, read_recording, to_ns, write_bag

from rmis_calib.cli import main
from rmis_calib.convert import ConvertSettings, convert
from rmis_calib.convert.topics import Choice, Topic, choose_topics
from rmis_calib.errors import FileError, RecordingError
from rmis_calib.io.recording import load_recording


def bag_path(folder: Path, kind: str) -> Path:
    return folder / ("a.bag" if kind == "ros1" else "a")


def settings(recording: Path, **more: object) -> ConvertSettings:
    return ConvertSettings(robot=str(recording / "robot.yaml"), **more)  # pyright: ignore[reportArgumentType]


@pytest.mark.parametrize("kind", ["ros1", "sqlite3", "mcap"])
def test_a_bag_gives_back_the_recording(rendered: Path, tmp_path: Path, kind: str) -> None:
    bag = write_bag(rendered, bag_path(tmp_path, kind), kind)
    notes = convert(bag, tmp_path / "out", settings(rendered))
    check_same(rendered, tmp_path / "out")
    assert any("the eyes are 0.4 ms apart" in note for note in notes)
    assert any(f"time 0 is {START_S + 1} s" in note for note in notes)
    # What was guessed is part of the recording, and of every result made from it.
    assert set(notes) <= set(load_recording(tmp_path / "out").notes)


def check_same(expected: Path, found: Path) -> None:
    times, columns, rows, stereo = read_recording(expected)
    new_times, new_columns, new_rows, new_stereo = read_recording(found)
    shift = int(times[0])  # the new clock starts at the second of the first picture
    np.testing.assert_allclose(new_times + shift, times, rtol=0, atol=2e-9)
    assert new_columns == columns
    new_rows[:, 0] += shift
    np.testing.assert_allclose(new_rows, rows, rtol=0, atol=2e-9)
    for side in ("right", "left"):
        for key in ("fx", "fy", "cx", "cy", "distortion"):
            np.testing.assert_allclose(new_stereo[side][key], stereo[side][key], rtol=0, atol=1e-12)
        pictures = sorted((expected / side).glob("*.png"))
        assert pictures and len(list((found / side).iterdir())) == len(pictures)
        for picture in pictures:
            np.testing.assert_array_equal(cv2.imread(str(found / side / picture.name)), cv2.imread(str(picture)))
    extrinsics = [np.array(s["camera_left_T_camera_right"]) for s in (stereo, new_stereo)]
    np.testing.assert_allclose(extrinsics[1], extrinsics[0], rtol=0, atol=1e-6)
    old, new = (yaml.safe_load((folder / "recording.yaml").read_text()) for folder in (expected, found))
    assert [new[key] for key in ("laparoscope_arm", "instrument_arm")] == [
        old[key] for key in ("laparoscope_arm", "instrument_arm")
    ]


def test_a_bare_mcap(rendered: Path, tmp_path: Path) -> None:
    bag = write_bag(rendered, tmp_path / "a", "mcap")
    (bare,) = bag.glob("*.mcap")
    convert(bare, tmp_path / "bare", settings(rendered))
    check_same(rendered, tmp_path / "bare")


def test_a_folder_of_split_bags(rendered: Path, tmp_path: Path) -> None:
    """A recorder that starts a new file every so often, and one that was killed before it wrote metadata.yaml."""
    times, columns, rows, _ = read_recording(rendered)
    middle = 0.5 * (times[2] + times[3])
    folder = tmp_path / "split"
    folder.mkdir()
    for number, (first, last) in enumerate(((-1.0, middle), (middle, 1e9))):
        part = tmp_path / f"part{number}"
        shutil.copytree(rendered, part)
        inside = (rows[:, 0] >= first) & (rows[:, 0] < last)
        shown = np.flatnonzero((times >= first) & (times < last))
        write_rows(part / "joints.csv", columns, rows[inside])
        write_rows(
            part / "frame_times.csv", ["frame", "timestamp_s"], np.stack([np.arange(len(shown)), times[shown]], 1)
        )
        for side in ("right", "left"):
            for new, old in enumerate(shown):
                shutil.copy(rendered / side / f"{old:06d}.png", part / side / f"{new:06d}.png")
        write_bag(part, folder / f"a_{number}.bag", "ros1")
    convert(folder, tmp_path / "out", settings(rendered))
    check_same(rendered, tmp_path / "out")
    bag = write_bag(rendered, tmp_path / "b", "sqlite3")
    (bag / "metadata.yaml").unlink()
    convert(bag, tmp_path / "killed", settings(rendered))
    check_same(rendered, tmp_path / "killed")


def write_rows(path: Path, columns: list[str], rows: np.ndarray) -> None:
    path.write_text("\n".join([",".join(columns), *(",".join(map(repr, row)) for row in rows.tolist())]) + "\n")


def test_overrides_and_a_still_camera(rendered: Path, tmp_path: Path) -> None:
    bag = write_bag(rendered, tmp_path / "a.bag", "ros1")
    chosen = settings(
        rendered, instrument="PSM1", laparoscope="none", right_topic=f"{RIG}/left/image_raw", shaft_diameter_mm=5.0,
        stereo=str(mono_file(rendered, tmp_path)),
    )  # fmt: skip
    convert(bag, tmp_path / "out", chosen)
    written = yaml.safe_load((tmp_path / "out" / "recording.yaml").read_text())
    assert written["laparoscope_arm"] is None and "left" not in written and written["shaft_diameter_mm"] == 5.0
    shown = cv2.imread(str(tmp_path / "out" / "right" / "000000.png"))
    np.testing.assert_array_equal(shown, cv2.imread(str(rendered / "left" / "000000.png")))


def mono_file(rendered: Path, folder: Path) -> Path:
    stereo = yaml.safe_load((rendered / "stereo.yaml").read_text())
    path = folder / "mono.yaml"
    path.write_text(yaml.safe_dump({"image_size": stereo["image_size"], "right": stereo["left"]}))
    return path


def truncated(path: Path, share: float) -> Path:
    file = path if path.is_file() else next(p for p in path.iterdir() if p.suffix in (".mcap", ".db3"))
    data = file.read_bytes()
    file.write_bytes(data[: int(share * len(data))])
    return path


@pytest.mark.parametrize("kind", ["ros1", "mcap", "sqlite3"])
def test_a_truncated_bag_is_one_clear_line_or_salvaged(
    rendered: Path, tmp_path: Path, kind: str, capsys: pytest.CaptureFixture[str]
) -> None:
    bag = truncated(write_bag(rendered, bag_path(tmp_path, kind), kind), 0.6)
    out = tmp_path / "out"
    command = ["convert", str(bag), "--out", str(out), "--robot", str(rendered / "robot.yaml")]
    assert main(command) == 2
    error = capsys.readouterr().err
    assert len(error.splitlines()) <= 3 and "expected a whole bag (--salvage converts what is whole of it)" in error
    assert not out.exists() and not list(tmp_path.glob(".out*"))
    assert main([*command, "--salvage"]) == 0
    times, _, rows, _ = read_recording(out)
    all_times, _, all_rows, _ = read_recording(rendered)
    # What is there is the beginning, whole and unchanged.
    assert 1 <= len(times) < len(all_times)
    rows[:, 0] += 1
    np.testing.assert_allclose(times + 1, all_times[: len(times)], rtol=0, atol=2e-9)
    np.testing.assert_allclose(rows, all_rows[: len(rows)], rtol=0, atol=2e-9)
    last = f"{len(times) - 1:06d}.png"
    for side in ("right", "left"):
        np.testing.assert_array_equal(cv2.imread(str(out / side / last)), cv2.imread(str(rendered / side / last)))


@pytest.mark.parametrize("name", ["a.bag", "a.mcap", "a.db3"])
def test_not_a_bag_at_all(tmp_path: Path, name: str) -> None:
    """Salvage is not offered where it cannot help."""
    for content in (b"", b"nonsense", b"#ROSBAG V2.0\n", b"SQLite format 3\0" + b"\0" * 84):
        (tmp_path / name).write_bytes(content)
        for salvage in (False, True):
            with pytest.raises(FileError, match="expected a bag with an intact part, found") as caught:
                convert(tmp_path / name, tmp_path / "out", ConvertSettings(salvage=salvage))
            assert "--salvage" not in str(caught.value)
    assert not (tmp_path / "out").exists()


def test_pictures_of_every_encoding(tmp_path: Path) -> None:
    """Each encoding of one picture of flat quadrants, so that demosaicing and chroma have nothing to blur in them."""
    from rmis_calib.convert.messages import bgr_of, write_picture

    rgb = np.zeros((16, 24, 3), np.uint8)
    rgb[:8, :12], rgb[:8, 12:], rgb[8:, :12], rgb[8:, 12:] = (200, 30, 30), (30, 200, 30), (30, 30, 200), (90, 90, 90)
    grey = cv2.cvtColor(rgb, cv2.COLOR_RGB2GRAY)
    rgba = np.concatenate([rgb, np.full((16, 24, 1), 255, np.uint8)], axis=2)
    v, u = np.mgrid[:16, :24]
    patterns = {
        "bayer_rggb8": [[0, 1], [1, 2]],
        "bayer_bggr8": [[2, 1], [1, 0]],
        "bayer_gbrg8": [[1, 2], [0, 1]],
        "bayer_grbg8": [[1, 0], [2, 1]],
    }
    cases = {"rgb8": (rgb, rgb), "bgr8": (rgb, rgb), "rgba8": (rgba, rgb), "mono8": (grey, grey)}
    for name, pattern in patterns.items():
        mosaic = rgb[v, u, np.array(pattern)[v % 2, u % 2]]
        cases[name] = (np.ascontiguousarray(mosaic), rgb)
    bag = tmp_path / "a.bag"
    with BagWriter(bag, "ros1") as writer:
        for number, (encoding, (data, _)) in enumerate(cases.items()):
            writer.image(f"/{encoding}", to_ns(number), data, encoding, padding=5)
        deep = (grey.astype(np.uint16) * 16).astype("<u2")
        writer.image("/mono16", to_ns(50), deep, "mono16")
        writer.compressed("/jpeg", to_ns(51), cv2.imencode(".jpg", rgb)[1].tobytes(), "rgb8; jpeg compressed bgr8")
    from rosbags.highlevel import AnyReader

    with AnyReader([bag]) as reader:
        messages = {c.topic.strip("/"): reader.deserialize(raw, c.msgtype) for c, _, raw in reader.messages()}
    inner = np.zeros((16, 24), bool)
    inner[3:5, 3:9], inner[3:5, 15:21], inner[11:13, 3:9], inner[11:13, 15:21] = True, True, True, True
    for encoding, (_, expected) in cases.items():
        found = bgr_of(messages[encoding], encoding)
        found = found[..., ::-1] if found.ndim == 3 else found
        np.testing.assert_array_equal(found[inner], expected[inner], err_msg=encoding)
    np.testing.assert_array_equal(bgr_of(messages["mono16"], "mono16"), deep)
    path, _ = write_picture(messages["jpeg"], tmp_path / "x", "jpeg")
    # The camera's own bytes, not a second compression of them.
    assert path.suffix == ".jpg" and path.read_bytes() == bytes(messages["jpeg"].data)
    messages["rgb8"].encoding = "32FC1"
    with pytest.raises(RecordingError, match="expected an encoding of rgb8"):
        bgr_of(messages["rgb8"], "x")


def test_pairs_drop_what_has_no_partner(rendered: Path, tmp_path: Path) -> None:
    times, _, rows, _ = read_recording(rendered)
    bag = tmp_path / "a.bag"
    picture = cv2.imread(str(rendered / "right" / "000000.png"))
    with BagWriter(bag, "ros1") as writer:
        for row in rows:
            writer.joints("/PSM1/measured_js", to_ns(row[0]), ["yaw", "pitch", "insertion"], row[4:7] * [1, 1, 1e-3])
        for i, time_s in enumerate(times):
            for side in ("right", "left"):
                if (i, side) not in ((1, "left"), (3, "right")):
                    writer.image(f"{RIG}/{side}/image_raw", to_ns(time_s), np.full_like(picture, 10 * i), "rgb8")
    convert(bag, tmp_path / "out", settings(rendered, stereo=str(rendered / "stereo.yaml")))
    found, _, _, _ = read_recording(tmp_path / "out")
    kept = [i for i in range(len(times)) if i not in (1, 3)]
    np.testing.assert_allclose(found + 1, times[kept], atol=2e-9)
    for number, i in enumerate(kept):
        for side in ("right", "left"):
            assert cv2.imread(str(tmp_path / "out" / side / f"{number:06d}.png"))[0, 0, 0] == 10 * i


def test_a_gap_in_one_arms_log_is_not_bridged(rendered: Path, tmp_path: Path) -> None:
    times, _, rows, _ = read_recording(rendered)
    picture = cv2.imread(str(rendered / "right" / "000000.png"))
    gap = (rows[:, 0] > 1.6) & (rows[:, 0] < 2.4)
    with BagWriter(tmp_path / "a.bag", "ros1") as writer:
        for row, is_gap in zip(rows, gap, strict=True):
            names, metres = ["yaw", "pitch", "insertion"], np.array([1, 1, 1e-3])
            writer.joints("/PSM1/measured_js", to_ns(row[0]), names, row[4:7] * metres)
            if not is_gap:  # and at other times than the instrument's
                writer.joints("/ECM/measured_js", to_ns(row[0]) + 1_000_000, names, row[1:4] * metres)
        for time_s in times:
            for side in ("right", "left"):
                writer.image(f"{RIG}/{side}/image_raw", to_ns(time_s), picture, "rgb8")
    notes = convert(tmp_path / "a.bag", tmp_path / "out", settings(rendered, stereo=str(rendered / "stereo.yaml")))
    _, _, found, _ = read_recording(tmp_path / "out")
    inside = (found[:, 0] + 1 > 1.65) & (found[:, 0] + 1 < 2.35)
    assert not inside.any() and len(found) > 0.5 * len(rows)
    assert any("one arm's log has a gap there" in note for note in notes)
    recording = load_recording(tmp_path / "out")
    valid = recording.joints_at_frames(recording.laparoscope_arm)[1]
    assert not valid[(times > 1.7) & (times < 2.3)].any() and valid.any()


def test_what_a_bag_lacks_is_said(rendered: Path, tmp_path: Path) -> None:
    times, _, rows, _ = read_recording(rendered)
    picture = cv2.imread(str(rendered / "right" / "000000.png"))

    def bag(name: str, joints: bool, poses: bool = False, images: bool = True) -> Path:
        with BagWriter(tmp_path / name, "ros1") as writer:
            for row in rows[:40]:
                if joints:
                    writer.joints(
                        "/PSM1/measured_js", to_ns(row[0]), ["yaw", "pitch", "insertion"], row[4:7] * [1, 1, 1e-3]
                    )
                if poses:
                    writer.pose("/PSM1/measured_cp", to_ns(row[0]), row[4:7] * 0.1, np.array([0, 0, 0, 1.0]), "ECM")
            for time_s in times if images else ():
                writer.image("/camera/image_raw", to_ns(time_s), picture, "rgb8")
        return tmp_path / name

    stereo, mono = str(rendered / "stereo.yaml"), str(mono_file(rendered, tmp_path))
    cases = [
        (
            bag("a.bag", joints=False),
            {},
            "expected measured_js or measured_cp of an instrument's arm, found /camera/image_raw",
        ),
        (bag("b.bag", joints=True, images=False), {}, "expected pictures"),
        (
            bag("c.bag", joints=True),
            {"robot": None, "stereo": stereo},
            "alone do not tell a Classic arm from an S or Si",
        ),
        (bag("d.bag", joints=True), {}, "expected --stereo FILE"),
        (
            bag("e.bag", joints=False, poses=True),
            {"stereo": mono},
            "expected measured_js, or local/measured_cp, of PSM1",
        ),
        (bag("f.bag", joints=True), {"instrument": "PSM2", "stereo": mono}, "expected a log of PSM2, found PSM1"),
        (bag("g.bag", joints=True), {"right_topic": "/nowhere"}, "expected pictures on topic /nowhere"),
    ]
    for path, change, message in cases:
        chosen = ConvertSettings(**({"robot": str(rendered / "robot.yaml")} | change))
        with pytest.raises(RecordingError, match=message):
            convert(path, tmp_path / "out", chosen)
        assert not (tmp_path / "out").exists()


def test_a_real_bag_without_pictures(shared_data: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    bag = shared_data / "dvrk" / "pitch_exp_traj_01_test_cropped.bag"
    assert main(["convert", str(bag), "--out", str(tmp_path / "out")]) == 2
    error = capsys.readouterr().err
    assert (
        "expected pictures (sensor_msgs Image or CompressedImage)" in error
        and "/PSM2/measured_js (JointState)" in error
    )
    assert not (tmp_path / "out").exists()


def test_the_output_may_not_lie_in_the_source(
    rendered: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    bag = write_bag(rendered, tmp_path / "a", "sqlite3")
    assert main(["convert", str(bag), "--out", str(bag / "out")]) == 2
    assert "expected an output apart from the input" in capsys.readouterr().err
    shutil.copytree(rendered, tmp_path / "other")
    command = [
        "convert",
        str(bag),
        "--out",
        str(tmp_path / "other"),
        "--robot",
        str(rendered / "robot.yaml"),
        "--overwrite",
    ]
    before = sorted(path.name for path in (tmp_path / "other").iterdir())
    (tmp_path / "other" / "mine.txt").write_text("a person's")
    assert main(command) == 2
    assert sorted(path.name for path in (tmp_path / "other").iterdir()) == sorted([*before, "mine.txt"])


def test_topics_by_structure() -> None:
    joint, pose, image = "sensor_msgs/msg/JointState", "geometry_msgs/msg/PoseStamped", "sensor_msgs/msg/Image"
    info = "sensor_msgs/msg/CameraInfo"
    notes: list[str] = []

    def chosen(*topics: tuple[str, str]) -> Choice:
        return choose_topics([Topic(name, kind, 5) for name, kind in topics], ConvertSettings(), notes.append, "bag")

    old = chosen(("/dvrk/PSM1/state_joint_current", joint), ("/dvrk/PSM1/state_jaw_current", joint))
    assert {arm: topic.name for arm, topic in old.joints.items()} == {"PSM1": "/dvrk/PSM1/state_joint_current"}
    local = chosen(
        ("/PSM1/measured_cp", pose),
        ("/PSM1/local/measured_cp", pose),
        ("/PSM1/setpoint_cp", pose),
        ("/SUJ/PSM1/measured_cp", pose),
    )
    assert {arm: topic.name for arm, topic in local.poses.items()} == {"PSM1": "/PSM1/local/measured_cp"}
    assert {(key.arm, key.what, key.is_local): topic.name for key, topic in local.placings.items()} == {
        ("PSM1", "tip", False): "/PSM1/measured_cp",
        ("PSM1", "tip", True): "/PSM1/local/measured_cp",
        ("PSM1", "base", False): "/SUJ/PSM1/measured_cp",
    }
    other = chosen(("/lbr/joints", joint), ("/lbr/command_joints", joint))
    assert {arm: topic.name for arm, topic in other.joints.items()} == {"lbr": "/lbr/joints"}
    assert any("lbr: /lbr/joints, by its type (JointState)" in note for note in notes)
    rig = chosen(
        ("/r/left/image_rect_color", image), ("/r/right/image_rect_color", image), ("/r/left/image_raw", image),
        ("/r/right/image_raw", image), ("/r/left/camera_info", info), ("/r/right/camera_info", info),
        ("/r/depth/right", image),
    )  # fmt: skip
    assert rig.right is not None and rig.left is not None
    assert (rig.right.name, rig.left.name) == ("/r/right/image_raw", "/r/left/image_raw")
    assert {side: topic.name for side, topic in rig.infos.items()} == {
        "right": "/r/right/camera_info", "left": "/r/left/camera_info",
    }  # fmt: skip
    with pytest.raises(RecordingError, match="since several fit"):
        chosen(("/a/left/image", image), ("/a/right/image", image), ("/b/left/image", image), ("/b/right/image", image))
