"""Recordings that are right: what is read, and the variations that the format allows."""

from pathlib import Path

import numpy as np
import torch
from recording_files import COLUMNS, FPS, FRAMES, HEIGHT, WIDTH, RecordingFolder, joint_rows, write_csv, write_images

from rmis_calib.io.recording import load_recording


def test_a_stereo_recording(folder: RecordingFolder) -> None:
    recording = load_recording(folder.path)
    assert recording.n_frames == FRAMES and recording.left is not None
    assert recording.right.size == recording.left.size == (HEIGHT, WIDTH)
    assert (recording.laparoscope_arm, recording.instrument_arm) == ("laparoscope", "instrument")
    assert (recording.shaft_diameter_mm, recording.clock_offset_s) == (8.0, 0.02)
    assert recording.stereo.right.image_size == (HEIGHT, WIDTH)
    assert recording.stereo.right.fy.item() == 91.0 and recording.stereo.right.fx.dtype == torch.float64
    extrinsics = recording.stereo.camera_left_T_camera_right
    assert extrinsics is not None and extrinsics.t.tolist() == [5.0, 0.0, 0.0]
    assert recording.head_points is None
    np.testing.assert_allclose(recording.frame_times_s, np.arange(FRAMES) / FPS)


def test_joints_come_by_time_with_the_clock_offset(folder: RecordingFolder) -> None:
    recording = load_recording(folder.path)
    values, valid = recording.joints_at_frames("instrument")
    assert valid.all()
    # joint time = frame time + clock_offset_s; the log is linear in time.
    t = np.arange(FRAMES) / FPS + 0.02
    np.testing.assert_allclose(values, np.stack([-0.3 + 0.1 * t, 0.1 - 0.2 * t, 150 + 10 * t], axis=1), rtol=1e-8)
    late, valid = load_recording(folder.path, clock_offset_s=0.3).joints_at_frames("laparoscope")
    assert valid.tolist() == [i / FPS + 0.3 <= 0.59 for i in range(FRAMES)]
    assert np.isnan(late[~valid]).all()
    nothing, valid = recording.joints_at_frames(None)
    assert nothing.shape == (FRAMES, 0) and valid.all()


def test_recording_yaml_itself_may_be_named(folder: RecordingFolder) -> None:
    assert load_recording(folder.path / "recording.yaml").path == folder.path


def test_without_frame_times_the_video_tells(folder: RecordingFolder) -> None:
    folder.edit("recording.yaml", lambda raw: (raw.pop("frame_times"), raw.pop("clock_offset_s")))
    recording = load_recording(folder.path)
    np.testing.assert_allclose(recording.frame_times_s, np.arange(FRAMES) / FPS, atol=1e-9)
    assert recording.clock_offset_s == 0.0


def test_mono_with_a_camera_that_stands_still(folder: RecordingFolder) -> None:
    folder.edit("recording.yaml", lambda raw: (raw.pop("left"), raw.update(laparoscope_arm=None)))
    folder.edit("stereo.yaml", lambda raw: (raw.pop("left"), raw.pop("camera_left_T_camera_right")))
    folder.edit("robot.yaml", lambda raw: raw["arms"].pop("laparoscope"))
    keep = [0, 3, 4, 5]
    write_csv(folder.path / "joints.csv", tuple(COLUMNS[i] for i in keep), joint_rows()[:, keep])
    recording = load_recording(folder.path)
    assert recording.left is None and recording.laparoscope_arm is None and recording.stereo.left is None


def test_image_folders_and_head_points(folder: RecordingFolder) -> None:
    for side in ("right", "left"):
        write_images(folder.path / side)
        folder.edit("recording.yaml", lambda raw, side=side: raw.update({side: side}))
    heads = folder.path / "head_points.csv"
    heads.write_text("frame,u_right_px,v_right_px,u_left_px,v_left_px\n2,10.5,20.25,-3,21\n7,11,22,12,23\n")
    points = load_recording(folder.path).head_points
    assert points is not None and points.uv_left is not None
    assert points.frames.tolist() == [2, 7]
    assert points.uv_right.tolist() == [[10.5, 20.25], [11.0, 22.0]]
    assert points.uv_left.tolist() == [[-3.0, 21.0], [12.0, 23.0]]
    heads.write_text("frame,u_right_px,v_right_px\n0,1,2\n")
    points = load_recording(folder.path).head_points
    assert points is not None and points.uv_left is None
    heads.write_text("frame,u_right_px,v_right_px\n")
    assert load_recording(folder.path).head_points is None


def test_byte_order_mark_crlf_and_blank_end(folder: RecordingFolder) -> None:
    for name in ("joints.csv", "frame_times.csv"):
        path = folder.path / name
        text = path.read_text().replace("\n", "\r\n")
        path.write_bytes(b"\xef\xbb\xbf" + text.encode() + b"\r\n\r\n")
    reference = load_recording(folder.path)
    np.testing.assert_allclose(reference.joints.values, joint_rows()[:, 1:], rtol=1e-8)


def test_preset_by_name(folder: RecordingFolder) -> None:
    folder.edit("recording.yaml", lambda raw: raw.update(robot="rcm-3x3"))
    rows = joint_rows()
    columns = [
        f"{arm}.{name}" for arm in ("laparoscope", "instrument") for name in ("yaw_rad", "pitch_rad", "insertion_mm")
    ]
    values = np.column_stack([rows[:, 0], rows[:, 1], 0 * rows[:, 1], rows[:, 2], rows[:, 3:]])
    write_csv(folder.path / "joints.csv", ("timestamp_s", *columns), values)
    recording = load_recording(folder.path)
    assert recording.robot.name == "rcm-3x3"
    assert recording.joints_at_frames("laparoscope")[0].shape == (FRAMES, 3)


def test_real_recording(shared_data: Path) -> None:
    recording = load_recording(shared_data / "recode_recording")
    assert recording.n_frames == recording.right.count == 50 and recording.left is None
    assert recording.right.size == (600, 800)
    values, valid = recording.joints_at_frames("instrument")
    assert valid.all() and values.shape == (50, 3)
    np.testing.assert_allclose(values[0], [-0.439716744, -0.103990542, 236.085388])
    assert recording.head_points is not None
    assert recording.head_points.frames.tolist() == list(range(50)) and recording.head_points.uv_left is None
    batches = list(recording.right.batches(16))
    assert [len(batch.images) for batch in batches] == [16, 16, 16, 2]
    assert torch.equal(batches[2].images[3], recording.right.frame(35))
