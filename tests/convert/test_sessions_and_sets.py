"""Recorder sessions, data sets, and pictures with a table: each laid out by the test from one rendered recording."""

import csv
import json
import shutil
from pathlib import Path

import av
import cv2
import numpy as np
import pytest
import yaml
from bag_writing import BagWriter, camera_infos, read_recording, to_ns

from rmis_calib.cli import main
from rmis_calib.convert import ConvertSettings, convert
from rmis_calib.errors import FileError, RecordingError
from rmis_calib.io.recording import load_recording

NAMES = ["yaw", "pitch", "insertion"]


def pictures(rendered: Path, side: str) -> list[np.ndarray]:
    return [cv2.imread(str(path)) for path in sorted((rendered / side).glob("*.png"))]


def write_video(path: Path, frames: list[np.ndarray], rate: int = 2) -> Path:
    """Lossless, in mp4."""
    with av.open(str(path), "w") as container:
        stream = container.add_stream("libx264rgb", rate=rate, options={"crf": "0"})
        stream.height, stream.width = frames[0].shape[:2]
        stream.pix_fmt = "rgb24"
        for frame in frames:
            container.mux(stream.encode(av.VideoFrame.from_ndarray(frame, format="bgr24")))
        container.mux(stream.encode())
    return path


def sidecar(rendered: Path, form: str, **more: object) -> dict:
    """Every form that recorders have written; `late_s` after the exposure where the form says so."""
    times, *_ = read_recording(rendered)
    ns = [to_ns(t) for t in times]
    if form == "list_ns":
        return {"timestamps_ns": ns} | more
    if form == "list_ms":
        return {"timestamps_ms": [value / 1e6 for value in ns]} | more
    if form == "list_s":
        return {"timestamps": [value / 1e9 for value in ns]} | more
    late = 7_000_000
    if form == "2025":
        frames = [
            {"cpu_ns": v + late, "gst_ns": 1000, "mono_source_ns": 0, "left_source_ns": v - 500,
             "right_source_ns": v + 500, "stereo_output_ns": v + late, "overlay_output_ns": 0} for v in ns
        ]  # fmt: skip
        return {"type": "dvrk_data:sidecar@1.0.0", "frames": frames} | more
    frames = [
        {
            "cpu_realtime": {"mono_source_ns": v, "recorder_reception_ns": v + late},
            "derived": {"preferred_capture_time_ns": v + late},
        }
        for v in ns
    ]
    return {"type": "dvrk_data:video_sidecar@1.0.0", "frames": frames} | more


def write_joint_csv(rendered: Path, folder: Path, arm: str, prefix: str) -> None:
    _, columns, rows, _ = read_recording(rendered)
    index = [i for i, column in enumerate(columns) if column.startswith(f"{prefix}.")]
    with (folder / f"{arm}_measured_js.csv").open("w", newline="") as file:
        writer = csv.writer(file)
        writer.writerow(
            ["timestamp", "header.stamp.sec", "header.stamp.nanosec", *(f"position.{i}" for i in range(len(index)))]
        )
        for row in rows:
            ns = to_ns(row[0])
            values = row[index] * [1.0 if columns[i].endswith("_rad") else 1e-3 for i in index]
            writer.writerow([ns + 5, ns // 10**9, ns % 10**9, *map(repr, values.tolist())])


def check(rendered: Path, found: Path, atol: float = 2e-9) -> None:
    """Clock, joints and, exactly, every picture."""
    times, columns, rows, _ = read_recording(rendered)
    new_times, new_columns, new_rows, _ = read_recording(found)
    shift = int(times[0])
    np.testing.assert_allclose(new_times + shift, times, rtol=0, atol=max(atol, 1e-6))
    kept = [columns.index(column) for column in new_columns]
    new_rows[:, 0] += shift
    np.testing.assert_allclose(new_rows, rows[:, kept], rtol=0, atol=atol)
    recording = load_recording(found)
    assert recording.left is not None
    for side, source in (("right", recording.right), ("left", recording.left)):
        expected = pictures(rendered, side)
        assert source.count == len(expected)
        for i, picture in enumerate(expected):
            np.testing.assert_array_equal(source.frame(i).permute(1, 2, 0).numpy()[..., ::-1], picture)


@pytest.mark.parametrize("form", ["2025", "2026", "list_ns", "list_ms", "list_s"])
def test_a_side_by_side_session_with_tables(rendered: Path, tmp_path: Path, form: str) -> None:
    session = tmp_path / "session"
    session.mkdir()
    both = [
        np.concatenate(pair, axis=1)
        for pair in zip(pictures(rendered, "right"), pictures(rendered, "left"), strict=True)
    ]
    write_video(session / "stereo_260101_120000.mp4", both)
    (session / "stereo_260101_120000.json").write_text(json.dumps(sidecar(rendered, form, side_by_side="RL")))
    write_joint_csv(rendered, session, "PSM1", "instrument")
    write_joint_csv(rendered, session, "ECM", "laparoscope")
    chosen = ConvertSettings(robot=str(rendered / "robot.yaml"), stereo=str(rendered / "stereo.yaml"))
    convert(session, tmp_path / "out", chosen)
    check(rendered, tmp_path / "out", atol=2e-7 if form in ("list_ms", "list_s") else 2e-9)


def test_latency_that_a_sidecar_states_is_taken_off(rendered: Path, tmp_path: Path) -> None:
    session = tmp_path / "session"
    session.mkdir()
    write_video(session / "right.mp4", pictures(rendered, "right"))
    (session / "right.json").write_text(json.dumps(sidecar(rendered, "2026", estimated_latency_ms=125.0)))
    write_joint_csv(rendered, session, "PSM1", "instrument")
    stereo = yaml.safe_load((rendered / "stereo.yaml").read_text())
    (tmp_path / "mono.yaml").write_text(yaml.safe_dump({"image_size": stereo["image_size"], "right": stereo["right"]}))
    convert(
        session,
        tmp_path / "out",
        ConvertSettings(robot=str(rendered / "robot.yaml"), stereo=str(tmp_path / "mono.yaml")),
    )
    times, *_ = read_recording(rendered)
    found, *_ = read_recording(tmp_path / "out")
    np.testing.assert_allclose(found - found[0] + (times[0] - 0.125), times - 0.125, atol=1e-6)
    written = yaml.safe_load((tmp_path / "out" / "recording.yaml").read_text())
    assert written["laparoscope_arm"] is None
    assert any("less the latency of 125 ms" in note for note in written["notes"])


def test_two_videos_and_a_bag(rendered: Path, tmp_path: Path) -> None:
    session = tmp_path / "session"
    session.mkdir()
    for side in ("right", "left"):
        write_video(session / f"{side}_camera.mp4", pictures(rendered, side))
        (session / f"{side}_camera.json").write_text(json.dumps(sidecar(rendered, "2026")))
    _, columns, rows, stereo = read_recording(rendered)
    with BagWriter(session / "bag", "sqlite3") as writer:
        for side, info in camera_infos(stereo).items():
            writer.camera_info(f"/rig/{side}/camera_info", to_ns(0.0), *info)
        for row in rows:
            writer.joints("/ECM/measured_js", to_ns(row[0]), NAMES, row[1:4] * [1, 1, 1e-3])
            writer.joints("/PSM1/measured_js", to_ns(row[0]), NAMES, row[4:7] * [1, 1, 1e-3])
    assert [column.split(".")[0] for column in columns[1:]] == ["laparoscope"] * 3 + ["instrument"] * 3
    convert(session, tmp_path / "out", ConvertSettings(robot=str(rendered / "robot.yaml")))
    check(rendered, tmp_path / "out")
    new = yaml.safe_load((tmp_path / "out" / "stereo.yaml").read_text())
    np.testing.assert_allclose(new["camera_left_T_camera_right"], stereo["camera_left_T_camera_right"], atol=1e-6)


def test_a_sidecar_that_does_not_fit_is_refused(rendered: Path, tmp_path: Path) -> None:
    session = tmp_path / "session"
    session.mkdir()
    write_video(session / "a.mp4", pictures(rendered, "right"))
    write_joint_csv(rendered, session, "PSM1", "instrument")
    chosen = ConvertSettings(robot=str(rendered / "robot.yaml"), stereo=str(rendered / "stereo.yaml"))
    short = sidecar(rendered, "2026")
    short["frames"] = short["frames"][:-1]
    for content, message in (
        (short, "expected a time stamp for each of the 6 frames, found 5"),
        ({"frames": []}, "frames with time stamps"),
    ):
        (session / "a.json").write_text(json.dumps(content))
        with pytest.raises(RecordingError, match=message):
            convert(session, tmp_path / "out", chosen)
    assert not (tmp_path / "out").exists()


def dvrk_log(count: int = 6) -> np.ndarray:
    t = np.arange(count)[:, None]
    return np.array([0.1, -0.2, 0.12, 0.5, 0.1, -0.1]) + 0.01 * t * [1, -1, 0.5, 2, 1, -1]


def test_surgpose(rendered: Path, tmp_path: Path) -> None:
    folder = tmp_path / "000003"
    (folder / "regular").mkdir(parents=True)
    for side in ("right", "left"):
        write_video(folder / "regular" / f"{side}_video.mp4", pictures(rendered, side), rate=30)
    joints = dvrk_log()
    still = np.tile(joints[0], (6, 1))
    data = {str(i): {"PSM1": joints[i].tolist(), "PSM3": still[i].tolist()} for i in range(6)}
    (folder / "api_jp_data.yaml").write_text(yaml.safe_dump(data))
    stereo = yaml.safe_load((rendered / "stereo.yaml").read_text())
    right_T_left = np.linalg.inv(np.array(stereo["camera_left_T_camera_right"]))
    lines = []
    for name, side in (("StereoLeft", "left"), ("StereoRight", "right")):
        c = stereo[side]
        k1, k2, p1, p2, k3 = c["distortion"]
        lines += [
            f"[{name}]",
            "res_x=160",
            "res_y=120",
            f"fc_x={c['fx']}",
            f"fc_y={c['fy']}",
            f"cc_x={c['cx']}",
            f"cc_y={c['cy']}",
        ]
        lines += [f"kc_{i}={v}" for i, v in enumerate((k1, k2, p1, p2, k3, 0, 0, 0))]
    lines += [f"R_{i}={float(v)!r}" for i, v in enumerate(right_T_left[:3, :3].ravel())]
    lines += [f"T_{i}={float(v)!r}" for i, v in enumerate(right_T_left[:3, 3])]
    (folder / "StereoCalibrationDVRK.ini").write_text("\n".join(lines))
    notes = convert(folder, tmp_path / "out")
    times, columns, rows, found = read_recording(tmp_path / "out")
    np.testing.assert_allclose(times, np.arange(6) / 30, atol=1e-8)
    np.testing.assert_allclose(rows[:, 1:], joints * [1, 1, 1000, 1, 1, 1], atol=1e-9)
    assert columns[1:4] == ["instrument.yaw_rad", "instrument.pitch_rad", "instrument.insertion_mm"]
    np.testing.assert_allclose(found["camera_left_T_camera_right"], stereo["camera_left_T_camera_right"], atol=1e-9)
    assert any("PSM1, which moves more than PSM3" in note for note in notes)
    assert yaml.safe_load((tmp_path / "out" / "recording.yaml").read_text())["robot"] == "dvrk-classic"


def surgsync(rendered: Path, folder: Path) -> tuple[np.ndarray, np.ndarray]:
    """A raw clip as SurgSync's toolkit writes it; joints of PSM1, and stamps of the pictures in ns."""
    times, _, _, stereo = read_recording(rendered)
    stamps = np.array([to_ns(t) for t in times])
    joints = dvrk_log()
    for name in ("image/right", "image/left", "kinematic/PSM1", "time_syn", "camera_calibration"):
        (folder / name).mkdir(parents=True)
    for i, ns in enumerate(stamps):
        number = i + 5  # clips need not start at 0, and 10 sorts after 9
        for side in ("right", "left"):
            shutil.copy(rendered / side / f"{i:06d}.png", folder / "image" / side / f"{number}.png")
        pose = {"position": [0.1, 0.0, 0.1], "orientation": [0, 0, 0, 1]}
        data = {
            "local_measured_cp": pose,
            "measured_js": {"position": joints[i].tolist(), "velocity": [], "effort": []},
        }
        (folder / "kinematic/PSM1" / f"{number}.json").write_text(json.dumps([{"arm": {"measured_data": data}}]))
        js = int(ns) + 3_000_000
        stamp = {"sec": js // 10**9, "nsec": js % 10**9}
        syn = {
            "frame": number, "image_right_stamp": {"sec": int(ns) // 10**9, "nsec": int(ns) % 10**9},
            "Kinematics_set_1": {"PSM1": {"measured_data": {"measured_js_stamp": stamp}}},
        }  # fmt: skip
        (folder / "time_syn" / f"{number}.json").write_text(json.dumps(syn))
    for side, (size, K, D, R, P) in camera_infos(stereo).items():
        content = {"image_width": size[1], "image_height": size[0], "distortion_model": "plumb_bob"}
        matrices = {
            "camera_matrix": K,
            "distortion_coefficients": np.array(D),
            "rectification_matrix": R,
            "projection_matrix": P,
        }
        content |= {name: {"data": np.ravel(value).tolist()} for name, value in matrices.items()}
        (folder / "camera_calibration" / f"{side}.yaml").write_text(yaml.safe_dump(content))
    return joints, stamps


def test_surgsync(rendered: Path, tmp_path: Path) -> None:
    joints, stamps = surgsync(rendered, tmp_path / "clip")
    convert(tmp_path / "clip", tmp_path / "out", ConvertSettings(robot="dvrk-classic"))
    times, _, rows, stereo = read_recording(tmp_path / "out")
    origin = stamps[0] // 10**9 * 10**9
    np.testing.assert_allclose(times, (stamps - origin) / 1e9, atol=1e-9)
    # Each arm's readings have stamps of their own.
    np.testing.assert_allclose(rows[:, 0], (stamps + 3_000_000 - origin) / 1e9, atol=1e-9)
    np.testing.assert_allclose(rows[:, 1:], joints * [1, 1, 1000, 1, 1, 1], atol=1e-9)
    expected = yaml.safe_load((rendered / "stereo.yaml").read_text())
    np.testing.assert_allclose(stereo["camera_left_T_camera_right"], expected["camera_left_T_camera_right"], atol=1e-6)
    for i, name in enumerate(sorted(path.name for path in (tmp_path / "out" / "left").iterdir())):
        np.testing.assert_array_equal(cv2.imread(str(tmp_path / "out" / "left" / name)), pictures(rendered, "left")[i])


def test_pictures_with_a_table(rendered: Path, tmp_path: Path) -> None:
    folder = tmp_path / "mine"
    for side in ("right", "left"):
        shutil.copytree(rendered / side, folder / side)
    shutil.copy(rendered / "frame_times.csv", folder)
    _, columns, rows, _ = read_recording(rendered)
    with (folder / "robot_log.csv").open("w", newline="") as file:
        writer = csv.writer(file)
        writer.writerow(["t_ms", "e1", "e2", "e3", "q1", "q2", "q3"])
        for row in rows:
            values = [row[0] * 1e3, *row[1:4], np.rad2deg(row[4]), row[5], row[6] * 1e-3]
            writer.writerow([repr(float(value)) for value in values])
    mapping = dict(zip(columns[1:], ("e1", "e2", "e3", "q1:deg", "q2", "q3:m"), strict=True)) | {
        "timestamp_s": "t_ms:ms"
    }
    command = ["convert", str(folder), "--out", str(tmp_path / "out"), "--robot", str(rendered / "robot.yaml")]
    command += ["--stereo", str(rendered / "stereo.yaml")]
    assert main([*command, "--map", *(word for pair in mapping.items() for word in pair)]) == 0
    check(rendered, tmp_path / "out")
    chosen = ConvertSettings(
        robot=str(rendered / "robot.yaml"), stereo=str(rendered / "stereo.yaml"), map={"timestamp_s": "t_ms:ms"}
    )
    with pytest.raises(RecordingError, match=r"expected columns instrument.yaw_rad, .*--map COLUMN NAME:UNIT"):
        convert(folder, tmp_path / "other", chosen)
    wrong = ConvertSettings(robot=str(rendered / "robot.yaml"), map=mapping | {columns[1]: "e1:furlong"})
    with pytest.raises(RecordingError, match="expected a unit of rad, deg, found furlong"):
        convert(folder, tmp_path / "other", wrong)


def test_still_poses_a_row_a_picture(rendered: Path, tmp_path: Path) -> None:
    folder = tmp_path / "mine"
    shutil.copytree(rendered / "right", folder / "right")
    stereo = yaml.safe_load((rendered / "stereo.yaml").read_text())
    (tmp_path / "mono.yaml").write_text(yaml.safe_dump({"image_size": stereo["image_size"], "right": stereo["right"]}))
    values = np.random.default_rng(0).uniform([-0.1, -0.1, 100], [0.1, 0.1, 120], (6, 3))
    lines = [
        "instrument.yaw_rad,instrument.pitch_rad,instrument.insertion_mm",
        *(",".join(map(repr, v)) for v in values.tolist()),
    ]
    (folder / "poses.csv").write_text("\n".join(lines))
    notes = convert(
        folder,
        tmp_path / "out",
        ConvertSettings(robot=str(rendered / "robot.yaml"), stereo=str(tmp_path / "mono.yaml")),
    )
    recording = load_recording(tmp_path / "out")
    readings, valid = recording.joints_at_frames("instrument")
    assert bool(valid.all())
    np.testing.assert_allclose(readings, values, atol=1e-9)
    assert any("row i belongs to picture i" in note for note in notes)


def test_jigsaws_and_other_sources_are_refused_with_the_reason(tmp_path: Path) -> None:
    kinematics = tmp_path / "Suturing" / "kinematics" / "AllGestures"
    kinematics.mkdir(parents=True)
    (kinematics / "Suturing_B001.txt").write_text(" ".join(["0.1"] * 76) + "\n")
    for source in (tmp_path / "Suturing", kinematics / "Suturing_B001.txt"):
        with pytest.raises(
            RecordingError, match="kinematics of JIGSAWS: tip poses only, without RCM, joints or camera"
        ):
            convert(source, tmp_path / "out")
    with pytest.raises(RecordingError, match="expected a ROS1 .bag.* found an empty folder"):
        (tmp_path / "empty").mkdir()
        convert(tmp_path / "empty", tmp_path / "out")
    with pytest.raises(FileError, match="found nothing there"):
        convert(tmp_path / "nowhere", tmp_path / "out")
    assert not (tmp_path / "out").exists()
