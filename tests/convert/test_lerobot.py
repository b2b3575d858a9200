"""An episode of a LeRobot data set, laid out as LeRobot 2.1 does."""

import json
from pathlib import Path

import numpy as np
import pyarrow
import pyarrow.parquet
import pytest
import yaml
from bag_writing import camera_infos, read_recording
from test_sessions_and_sets import pictures, write_video

from rmis_calib.convert import ConvertSettings, convert
from rmis_calib.errors import FileError, RecordingError
from rmis_calib.io.recording import load_recording

STATE = "observation.state"
NAMES = ["ecm_yaw", "ecm_pitch", "ecm_insertion", "psm1_yaw_deg", "psm1_pitch", "psm1_insertion", "psm1_jaw"]


@pytest.fixture
def data_set(rendered: Path, tmp_path: Path) -> Path:
    """Two episodes of which the second is the recording; joints in rad and m, but one in degrees."""
    root = tmp_path / "set"
    recording = load_recording(rendered)
    laparoscope, _ = recording.joints_at_frames("laparoscope")
    instrument, _ = recording.joints_at_frames("instrument")
    jaw = np.full((6, 1), 0.3)
    state = np.concatenate([laparoscope * [1, 1, 1e-3], instrument * [180 / np.pi, 1, 1e-3], jaw], axis=1)
    names = {"motors": NAMES}
    features = {
        STATE: {"dtype": "float64", "shape": [7], "names": names},
        "timestamp": {"dtype": "float32", "shape": [1], "names": None},
    }
    features |= {f"observation.images.{side}": {"dtype": "video"} for side in ("endoscope_left", "endoscope_right")}
    info = {"codebase_version": "v2.1", "total_episodes": 2, "chunks_size": 1000, "fps": 2, "features": features}
    info["data_path"] = "data/chunk-{episode_chunk:03d}/episode_{episode_index:06d}.parquet"
    info["video_path"] = "videos/chunk-{episode_chunk:03d}/{video_key}/episode_{episode_index:06d}.mp4"
    for folder in ("meta", "data/chunk-000", "camera_calibration"):
        (root / folder).mkdir(parents=True)
    (root / "meta" / "info.json").write_text(json.dumps(info))
    for episode, factor in ((0, 0.0), (1, 1.0)):
        columns = {STATE: (factor * state).tolist(), "timestamp": (0.5 * np.arange(6)).tolist()}
        pyarrow.parquet.write_table(
            pyarrow.table(columns), root / info["data_path"].format(episode_chunk=0, episode_index=episode)
        )
        for side in ("right", "left"):
            key = f"observation.images.endoscope_{side}"
            video = root / info["video_path"].format(episode_chunk=0, episode_index=episode, video_key=key)
            video.parent.mkdir(parents=True, exist_ok=True)
            write_video(video, pictures(rendered, side))
    for side, (size, K, D, R, P) in camera_infos(read_recording(rendered)[3]).items():
        content = {"image_width": size[1], "image_height": size[0], "distortion_model": "plumb_bob"}
        matrices = {"camera_matrix": K, "distortion_coefficients": np.array(D), "rectification_matrix": R}
        matrices["projection_matrix"] = P
        content |= {name: {"data": np.ravel(value).tolist()} for name, value in matrices.items()}
        (root / "camera_calibration" / f"{side}.yaml").write_text(yaml.safe_dump(content))
    return root


def settings(rendered: Path, **more: object) -> ConvertSettings:
    columns = read_recording(rendered)[1][1:]
    units = ["", "", ":m", ":deg", "", ":m"]
    mapping = {ours: f"{STATE}/{name}{unit}" for ours, name, unit in zip(columns, NAMES, units, strict=False)}
    return ConvertSettings(**{"robot": str(rendered / "robot.yaml"), "map": mapping, "episode": 1} | more)  # pyright: ignore


def test_an_episode(rendered: Path, data_set: Path, tmp_path: Path) -> None:
    notes = convert(data_set, tmp_path / "out", settings(rendered))
    found, expected = load_recording(tmp_path / "out"), load_recording(rendered)
    np.testing.assert_allclose(found.frame_times_s - found.frame_times_s[0], 0.5 * np.arange(6), atol=1e-9)
    for arm in ("laparoscope", "instrument"):
        # In degrees the yaw would be 57 times as large, in metres the insertion a thousandth.
        np.testing.assert_allclose(found.joints_at_frames(arm)[0], expected.joints_at_frames(arm)[0], atol=1e-6)
    for side, source in (("right", found.right), ("left", found.left)):
        assert source is not None
        for i, picture in enumerate(pictures(rendered, side)):
            np.testing.assert_array_equal(source.frame(i).permute(1, 2, 0).numpy()[..., ::-1], picture)
    extrinsics = read_recording(rendered)[3]["camera_left_T_camera_right"]
    written = yaml.safe_load((tmp_path / "out" / "stereo.yaml").read_text())["camera_left_T_camera_right"]
    np.testing.assert_allclose(written, extrinsics, atol=1e-6)
    assert any("right observation.images.endoscope_right" in note for note in notes)


def test_what_an_episode_lacks_is_told(rendered: Path, data_set: Path, tmp_path: Path) -> None:
    out, info = tmp_path / "out", data_set / "meta" / "info.json"
    for more, message in (
        ({"episode": None}, "expected --episode, 0 to 1, found none"),
        ({"episode": 2}, "expected --episode, 0 to 1, found 2"),
        ({"robot": None}, "expected --robot"),
        ({"map": {}}, "expected columns instrument.yaw_rad, .*found observation.state/ecm_yaw"),
        ({"right_topic": "nothing"}, "expected --right-topic, a video, found observation.images"),
    ):
        with pytest.raises(RecordingError, match=message):
            convert(data_set, out, settings(rendered, **more))
    parquet = data_set / "data" / "chunk-000" / "episode_000001.parquet"
    whole = parquet.read_bytes()
    parquet.write_bytes(whole[: len(whole) // 2])
    with pytest.raises(FileError, match="expected a Parquet file"):
        convert(data_set, out, settings(rendered))
    raw = json.loads(info.read_text())
    info.write_text(json.dumps(raw | {"codebase_version": "v3.0"}))
    with pytest.raises(RecordingError, match="version 2, .*found v3.0"):
        convert(data_set, out, settings(rendered))
    info.write_text("{}")
    with pytest.raises(RecordingError, match="version 2"):
        convert(data_set, out, settings(rendered))
    info.write_text(json.dumps({"codebase_version": "v2.1", "features": 5}))
    with pytest.raises(RecordingError, match="expected total_episodes, features"):
        convert(data_set, out, settings(rendered))
    assert not out.exists()
