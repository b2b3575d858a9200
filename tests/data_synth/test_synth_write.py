"""Recordings: what is in the folder, and that the folder and the truth tell one story, read back by other means."""

import csv
import dataclasses
import subprocess
import sys
from pathlib import Path
from typing import Any

import av
import numpy as np
import pytest
import yaml
from pydantic import ValidationError

from data_synth import SynthConfig, load_synth_config, synth_presets, write_recording
from data_synth.kinematics import arms_from_dict, rigid_inverse, transform_points

SMALL: dict[str, Any] = {
    "width_px": 160,
    "height_px": 120,
    "right": {"fx_px": 175.0, "fy_px": 175.0, "cx_px": 80.0, "cy_px": 60.0},
    "left": {"fx_px": 176.0, "fy_px": 175.5, "cx_px": 78.0, "cy_px": 61.0},
}
EXACT = {"kinematics_mm": 0.0, "kinematics_deg": 0.0, "head_point_px": 0.0}


def recording(path: Path, **content: Any) -> Path:
    return write_recording(path, load_synth_config({"motions": 5, "camera": SMALL} | content))


def read_csv(path: Path) -> tuple[list[str], np.ndarray]:
    with path.open() as stream:
        header, *rows = csv.reader(stream)
    return header, np.array(rows, dtype=np.float64)


def logged_poses(folder: Path, clock_offset_s: float = 0.0) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """arm_T_rcm, rcm_v_axis and rcm_p_head of every frame, from the files alone."""
    header, log = read_csv(folder / "joints.csv")
    _, frames = read_csv(folder / "frame_times.csv")
    at = frames[:, 1] + clock_offset_s
    arms = arms_from_dict(yaml.safe_load((folder / "robot.yaml").read_text()))
    readings = {
        name: np.stack(
            [np.interp(at, log[:, 0], log[:, i]) for i, c in enumerate(header) if c.startswith(f"{name}.")], -1
        )
        for name in arms
    }
    shaft = arms["instrument"].shaft(readings["instrument"])
    base_T_rcm = shaft.base_T_rcm
    if "laparoscope" in arms:
        base_T_rcm = rigid_inverse(arms["laparoscope"].tool(readings["laparoscope"])) @ base_T_rcm
    return base_T_rcm, shaft.rcm_v_axis, shaft.rcm_p_head


@pytest.mark.parametrize("laparoscope", ["moving", "static", "unlogged"])
def test_files_reproduce_the_truth(tmp_path: Path, laparoscope: str) -> None:
    folder = recording(tmp_path / "r", noise=EXACT, motion={"laparoscope": laparoscope})
    truth = yaml.safe_load((folder / "ground_truth.yaml").read_text())
    frames = np.load(folder / "truth.npz")
    arm_T_rcm, rcm_v_axis, rcm_p_head = logged_poses(folder)
    camera_right_T_rcm = np.array(truth["camera_right_T_arm"]) @ arm_T_rcm
    # joints.csv holds nine decimals: 1e-9 rad over 130 mm.
    np.testing.assert_allclose(camera_right_T_rcm, frames["right_camera_T_rcm"], atol=1e-6)
    v = np.einsum("nij,nj->ni", camera_right_T_rcm[:, :3, :3], rcm_v_axis)
    np.testing.assert_allclose(v, frames["right_camera_v_axis"], atol=1e-8)
    left = np.array(yaml.safe_load((folder / "stereo.yaml").read_text())["camera_left_T_camera_right"])
    np.testing.assert_allclose(left @ camera_right_T_rcm, frames["left_camera_T_rcm"], atol=1e-6)
    p_head = transform_points(camera_right_T_rcm, rcm_p_head)
    np.testing.assert_allclose(p_head[:, :2] / p_head[:, 2:], frames["right_head_xy"], atol=1e-7)
    s_end = np.einsum("ni,ni->n", rcm_v_axis, rcm_p_head) + truth["shaft_end_offset_mm"]
    np.testing.assert_allclose(s_end, frames["right_s_end_mm"], atol=1e-6)
    content = yaml.safe_load((folder / "recording.yaml").read_text())
    assert content["laparoscope_arm"] == (None if laparoscope == "unlogged" else "laparoscope")
    header, rows = read_csv(folder / "head_points.csv")
    assert header == ["frame", "u_right_px", "v_right_px", "u_left_px", "v_left_px"]
    np.testing.assert_allclose(rows[:, 1:3], frames["right_head_uv"][rows[:, 0].astype(int)], atol=6e-4)


def test_pose_noise_is_on_the_right_of_the_logged_pose(tmp_path: Path) -> None:
    noise = EXACT | {"kinematics_mm": 0.4, "kinematics_deg": 0.2}
    folder = recording(tmp_path / "r", noise=noise, motions=60, camera=SMALL | {"left": None}, output={"crf": 40})
    truth = yaml.safe_load((folder / "ground_truth.yaml").read_text())
    arm_T_rcm, _, _ = logged_poses(folder)
    seen = np.load(folder / "truth.npz")["right_camera_T_rcm"]
    error = rigid_inverse(np.array(truth["camera_right_T_arm"]) @ arm_T_rcm) @ seen
    # 180 samples: 1 sigma of the estimate is 5 %.
    assert error[:, :3, 3].std() == pytest.approx(0.4, rel=0.2)
    assert np.stack([error[:, 2, 1], error[:, 0, 2], error[:, 1, 0]]).std() == pytest.approx(np.deg2rad(0.2), rel=0.2)


def test_clock_and_joint_offsets_are_those_of_the_truth(tmp_path: Path) -> None:
    noise = EXACT | {"clock_offset_s": 0.3, "joint_offset_deg": 0.5, "joint_offset_mm": 1.0}
    motion = {"kind": "smooth", "joint_rate_hz": 500.0}
    folder = recording(tmp_path / "r", noise=noise, motion=motion)
    truth = yaml.safe_load((folder / "ground_truth.yaml").read_text())
    assert truth["clock_offset_s"] == 0.3
    assert "clock_offset_s" not in yaml.safe_load((folder / "recording.yaml").read_text())
    header, log = read_csv(folder / "joints.csv")
    log[:, 1:] += [truth["joint_offsets"][column] for column in header[1:]]
    with (folder / "joints.csv").open("w") as stream:
        stream.write(",".join(header) + "\n" + "\n".join(",".join(map(repr, row)) for row in log.tolist()))
    arm_T_rcm, _, _ = logged_poses(folder, clock_offset_s=0.3)
    seen = np.load(folder / "truth.npz")["right_camera_T_rcm"]
    # Linear interpolation of 500 Hz: well below a micrometre.
    np.testing.assert_allclose(np.array(truth["camera_right_T_arm"]) @ arm_T_rcm, seen, atol=1e-3)
    assert np.abs(np.array(truth["camera_right_T_arm"]) @ logged_poses(folder)[0] - seen).max() > 0.01


def test_frames_jitter_and_drop_but_keep_their_order(tmp_path: Path) -> None:
    noise = {"frame_jitter_s": 0.002, "dropped_fraction": 0.3}
    folder = recording(tmp_path / "r", motions=40, noise=noise, motion={"kind": "smooth"}, output={"crf": 40})
    steps = np.diff(read_csv(folder / "frame_times.csv")[1][:, 1]) * 30.0
    assert (steps > 0).all()
    assert (np.abs(steps - np.round(steps)) > 0.01).any()
    assert (steps > 1.5).any()


def decode(path: Path) -> np.ndarray:
    with av.open(str(path)) as container:
        return np.stack([frame.to_ndarray(format="rgb24") for frame in container.decode(video=0)])


def test_video_and_images_show_the_same(tmp_path: Path) -> None:
    video = decode(recording(tmp_path / "v") / "left.mp4").astype(float)
    folder = recording(tmp_path / "i", output={"pictures": "images"})
    paths = sorted((folder / "left").iterdir())
    images = np.stack([decode(path)[0] for path in paths]).astype(float)
    assert [path.name for path in paths][:2] == ["000000.png", "000001.png"]
    assert video.shape == images.shape == (5, 120, 160, 3)
    assert np.sqrt(((video - images) ** 2).mean()) < 2.0


def test_interrupted_and_refused_writing_leaves_nothing_new(tmp_path: Path) -> None:
    def stop(done: int, total: int) -> None:
        raise KeyboardInterrupt

    config = load_synth_config({"motions": 2, "camera": SMALL})
    with pytest.raises(KeyboardInterrupt):
        write_recording(tmp_path / "r", config, on_progress=stop)
    assert list(tmp_path.iterdir()) == []
    (tmp_path / "r").mkdir()
    (tmp_path / "r" / "recording.yaml").write_text("mine")
    for overwrite, message in ((False, "a new name, or --overwrite"), (True, "not one with recording.yaml")):
        with pytest.raises(FileExistsError, match=message):
            write_recording(tmp_path / "r", config, overwrite=overwrite)
    seen = []
    (tmp_path / "r" / "recording.yaml").unlink()  # an empty folder may be filled
    write_recording(tmp_path / "r", config, on_progress=lambda done, total: seen.append((done, total)))
    assert seen == [(1, 2), (2, 2)]
    assert write_recording(tmp_path / "r", config, overwrite=True).is_dir()


@pytest.mark.parametrize("name", sorted(synth_presets()))
def test_presets_load_and_hold_only_what_differs(name: str) -> None:
    config = load_synth_config(name)
    content = yaml.safe_load(synth_presets()[name].read_text())

    def check(given: dict, default: Any) -> None:
        for key, value in given.items():
            if key in ("left", "right"):  # a camera is given whole
                continue
            if dataclasses.is_dataclass(getattr(default, key)):
                check(value, getattr(default, key))
            else:
                assert value != getattr(default, key) or name == "demo", f"{key} is the default"

    assert config.motions >= 1
    check(content, SynthConfig())


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("motion_s: 3", "Unexpected keyword argument"),
        ("camera: {widthpx: 3}", "Unexpected keyword argument"),
        ("motions: 0", "greater than or equal to 1"),
        ("noise: {kinematics_mm: .nan}", "finite"),
        ("noise: {kinematics_mm: -1.0}", "greater than or equal to 0"),
        ("motions: 3\nmotions: 4", "expected every key once"),
        ("- 3", "expected a mapping"),
    ],
)
def test_bad_configurations_are_refused(tmp_path: Path, text: str, message: str) -> None:
    path = tmp_path / "c.yaml"
    path.write_text(text)
    with pytest.raises((ValidationError, ValueError), match=message):
        load_synth_config(path)


def test_numbers_in_exponent_form_are_numbers(tmp_path: Path) -> None:
    path = tmp_path / "c.yaml"
    path.write_text("noise: {kinematics_mm: 1e-3}")
    assert load_synth_config(path).noise.kinematics_mm == 0.001
    with pytest.raises(FileNotFoundError, match=r"expected a file or one of .*demo"):
        load_synth_config("no-such-preset")


def test_importing_the_package_is_light() -> None:
    code = "import sys, data_synth; assert not {'torch', 'cv2', 'av', 'numpy'} & set(sys.modules), sorted(sys.modules)"
    subprocess.run([sys.executable, "-c", code], check=True)
