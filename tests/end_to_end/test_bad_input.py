"""Hostile input at the command line: one clear line, exit code 2, and nothing written."""

import json
import os
import signal
import subprocess
import sys
import time
from functools import partial
from pathlib import Path

import cv2
import numpy as np
import pytest
import yaml

from rmis_calib.cli import main


def edit_yaml(path: Path, **changes) -> None:
    content = yaml.safe_load(path.read_text())
    for dotted, value in changes.items():
        node, keys = content, dotted.split("__")
        for key in keys[:-1]:
            node = node[int(key)] if key.isdigit() else node[key]
        if value is None and keys[-1] in node and keys[-1] != "laparoscope_arm":
            del node[keys[-1]]
        else:
            node[keys[-1]] = value
    path.write_text(yaml.safe_dump(content, sort_keys=False))


def edit_cell(path: Path, row: int, column: int, value: str) -> None:
    lines = path.read_text().splitlines()
    cells = lines[row].split(",")
    cells[column] = value
    lines[row] = ",".join(cells)
    path.write_text("\n".join(lines) + "\n")


def scale_columns(path: Path, suffix: str, factor: float) -> None:
    lines = path.read_text().splitlines()
    chosen = [index for index, name in enumerate(lines[0].split(",")) if name.endswith(suffix)]
    out = [lines[0]]
    for line in lines[1:]:
        cells = line.split(",")
        for index in chosen:
            cells[index] = repr(float(cells[index]) * factor)
        out.append(",".join(cells))
    path.write_text("\n".join(out) + "\n")


def cut_file(path: Path, keep: float) -> None:
    data = path.read_bytes()
    path.write_bytes(data[: int(len(data) * keep)])


def drop_last_row(path: Path) -> None:
    path.write_text("\n".join(path.read_text().splitlines()[:-1]) + "\n")


def repeat_last_row(path: Path) -> None:
    lines = path.read_text().splitlines()
    cells = lines[-1].split(",")
    lines.append(",".join([str(int(cells[0]) + 1), repr(float(cells[1]) + 0.5)]))
    path.write_text("\n".join(lines) + "\n")


def metres_extrinsics(path: Path) -> None:
    content = yaml.safe_load(path.read_text())
    for row in content["camera_left_T_camera_right"][:3]:
        row[3] *= 1e-3
    path.write_text(yaml.safe_dump(content))


def not_a_rotation(path: Path) -> None:
    content = yaml.safe_load(path.read_text())
    content["camera_left_T_camera_right"][0][0] = 1.2
    path.write_text(yaml.safe_dump(content))


def swap_rotation_sign(path: Path) -> None:
    content = yaml.safe_load(path.read_text())
    arm = content["arms"]["instrument"]
    arm["base_T_arm_base"] = [[1, 0, 0, 0], [0, 1, 0, 0], [0, 0, -1, 0], [0, 0, 0, 1]]
    path.write_text(yaml.safe_dump(content))


# name -> (what is done to the recording, words that the one line must hold)
DAMAGE = {
    "no recording.yaml": (lambda r: (r / "recording.yaml").unlink(), ["recording.yaml"]),
    "no video": (lambda r: (r / "right.mp4").unlink(), ["right.mp4"]),
    "no joints": (lambda r: (r / "joints.csv").unlink(), ["joints.csv"]),
    "no robot": (lambda r: (r / "robot.yaml").unlink(), ["robot.yaml"]),
    "no stereo": (lambda r: (r / "stereo.yaml").unlink(), ["stereo.yaml"]),
    "unknown key": (lambda r: edit_yaml(r / "recording.yaml", shaft_diametre_mm=8.0), ["shaft_diametre_mm"]),
    "unknown key deep": (lambda r: edit_yaml(r / "stereo.yaml", right__fz=1.0), ["fz"]),
    "missing key": (lambda r: edit_yaml(r / "recording.yaml", instrument_arm=None), ["instrument_arm"]),
    "wrong format": (lambda r: edit_yaml(r / "recording.yaml", format="rmis-calib/9"), ["rmis-calib/9"]),
    "unknown robot": (lambda r: edit_yaml(r / "recording.yaml", robot="dvrk-clasic"), ["dvrk-classic"]),
    "unknown arm": (lambda r: edit_yaml(r / "recording.yaml", instrument_arm="psm9"), ["psm9"]),
    "diameter in metres": (lambda r: edit_yaml(r / "recording.yaml", shaft_diameter_mm=0.008), ["shaft_diameter_mm"]),
    "NaN joint": (lambda r: edit_cell(r / "joints.csv", 3, 2, "nan"), ["joints.csv", "4"]),
    "text joint": (lambda r: edit_cell(r / "joints.csv", 3, 2, "abc"), ["joints.csv", "4", "abc"]),
    "time backwards": (lambda r: edit_cell(r / "joints.csv", 5, 0, "-1.0"), ["joints.csv", "timestamp_s"]),
    "frame time backwards": (lambda r: edit_cell(r / "frame_times.csv", 3, 1, "-1.0"), ["frame_times.csv"]),
    "video too short": (lambda r: repeat_last_row(r / "frame_times.csv"), ["frame"]),
    "video too long": (lambda r: drop_last_row(r / "frame_times.csv"), ["frame"]),
    "truncated video": (lambda r: cut_file(r / "right.mp4", 0.6), ["right.mp4"]),
    "zero-byte video": (lambda r: (r / "left.mp4").write_bytes(b""), ["left.mp4"]),
    "not a video": (lambda r: (r / "right.mp4").write_text("hello"), ["right.mp4"]),
    "wrong frame size": (lambda r: edit_yaml(r / "stereo.yaml", image_size=[320, 240]), ["320"]),
    "joint beyond its limit": (
        lambda r: edit_yaml(
            r / "robot.yaml", arms__instrument__joints__0__min=2.0, arms__instrument__joints__0__max=3.0
        ),
        ["joints.csv", "instrument"],
    ),
    "degrees for radians": (lambda r: scale_columns(r / "joints.csv", "_rad", 57.29578 * 20), ["joints.csv"]),
    "insertion in metres": (lambda r: scale_columns(r / "joints.csv", "_mm", 1e-3), ["metres"]),
    "baseline in metres": (lambda r: metres_extrinsics(r / "stereo.yaml"), ["metres"]),
    "not a rotation": (lambda r: not_a_rotation(r / "stereo.yaml"), ["camera_left_T_camera_right"]),
    "a reflection": (lambda r: swap_rotation_sign(r / "robot.yaml"), ["base_T_arm_base"]),
    "not YAML": (lambda r: (r / "stereo.yaml").write_text("{: ["), ["stereo.yaml"]),
    "negative focal length": (lambda r: edit_yaml(r / "stereo.yaml", right__fx=-700.0), ["fx"]),
    "NaN intrinsics": (lambda r: edit_yaml(r / "stereo.yaml", right__cx=float("nan")), ["cx"]),
}


@pytest.mark.parametrize("case", DAMAGE)
def test_damaged_recording_is_one_clear_line(case, recording, tmp_path, capsys):
    damage, words = DAMAGE[case]
    damage(recording)
    out = tmp_path / "out"
    assert main(["calibrate", str(recording), "--out", str(out)]) == 2
    error_lines = [line for line in capsys.readouterr().err.splitlines() if line.startswith("rmis-calib: error:")]
    assert len(error_lines) == 1
    assert all(word in error_lines[0] for word in words), error_lines[0]
    assert not out.exists()
    assert sorted(p.name for p in tmp_path.iterdir()) == ["recording"]


def test_too_few_motions_is_a_result_that_says_so(recording, tmp_path, capsys):
    out = tmp_path / "out"
    assert main(["calibrate", str(recording), "--out", str(out), "--overlays", "0"]) == 1
    result = json.loads((out / "result.json").read_text())
    assert result["status"] == "insufficient_data"
    assert result["camera_right_T_arm"] is None
    assert "4 of 4 motions are usable, 6 are needed" in result["message"]
    assert (out / "report.html").is_file()


def test_output_that_exists_is_kept(recording, tmp_path, capsys):
    out = tmp_path / "out"
    out.mkdir()
    (out / "precious.txt").write_text("mine")
    assert main(["calibrate", str(recording), "--out", str(out)]) == 2
    assert "--overwrite" in capsys.readouterr().err or (out / "precious.txt").read_text() == "mine"
    assert (out / "precious.txt").read_text() == "mine"


def test_output_below_a_file_cannot_be_written(recording, tmp_path, capsys):
    (tmp_path / "file").write_text("")
    assert main(["calibrate", str(recording), "--out", str(tmp_path / "file" / "out")]) == 2
    assert "error" in capsys.readouterr().err


@pytest.mark.parametrize(
    ("argv", "words"),
    [
        ([], "usage"),
        (["calibrat"], "unknown command"),
        (["calibrate"], "expected RECORDING, found nothing"),
        (["calibrate", "nowhere", "--out", "o"], "nowhere"),
        (["calibrate", "nowhere", "--out", "o", "--methode", "joint"], "found --methode (did you mean --method?)"),
        (["calibrate", "nowhere", "--method", "magic"], "--method: expected one of global, joint, paper, found magic"),
        (["calibrate", "nowhere", "--out", "o", "--config", "absent.yaml"], "absent.yaml"),
        (
            ["detect", "nowhere", "--out", "o", "--every", "0"],
            "--every: expected 1 or more, found 0",
        ),
        (
            ["calibrate", "nowhere", "--out", "o", "--picture-errors.edge-bias-px", "-1"],
            "--picture-errors.edge-bias-px: expected 0 or more, found -1",
        ),
        (["solve", "absent.npz", "--out", "o.json"], "absent.npz"),
        (["evaluate", "absent.json", "nowhere"], "absent.json"),
        (["detect", "absent.mp4", "--out", "o"], "absent.mp4"),
        (["synth", "o", "--preset", "no-such-preset"], "no-such-preset"),
        (["synth", "o", "--motions", "0"], "motions: expected 1 or more, found 0"),
        (["calibarte"], "did you mean calibrate?"),
        (["calibrate", "nowhere", "--every"], "--every: expected a value after it"),
        (["calibrate", "nowhere", "--every", "two"], "--every: expected a whole number, found two"),
        (
            ["calibrate", "nowhere", "--solver.noise.image", "-1"],
            "--solver.noise.image: expected more than 0, found -1",
        ),
        (["calibrate", "nowhere", "--solver.noise.image", "nan"], "--solver.noise.image: expected a finite number"),
        (["calibrate", "nowhere", "--instrument-at", "3", "4"], "--instrument-at: expected FRAME U V, found 3 4"),
        (["solve", "a.npz", "b.npz"], "found 'b.npz', which is one too many"),
        (["calibrate", "nowhere", "--masks", "absent"], "nowhere"),
    ],
)
def test_bad_usage(argv, words, tmp_path, monkeypatch, capsys):
    monkeypatch.chdir(tmp_path)
    assert main(argv) == 2
    captured = capsys.readouterr()
    assert words in captured.out + captured.err
    if argv:  # one line, in our words
        assert captured.err.count("\n") == 1 and captured.err.startswith("rmis-calib: error: ")
        assert not any(alien in captured.err for alien in ("pydantic", "http", "Value error", "Input should", "╭"))
    assert list(tmp_path.iterdir()) == []


def test_solve_refuses_a_broken_npz(tmp_path, capsys):
    path = tmp_path / "obs.npz"
    np.savez(path, arm_T_rcm=np.eye(4)[None], rcm_v_axis=np.array([[0.0, 0.0, 1.0]]), surprise=1.0)
    assert main(["solve", str(path), "--out", str(tmp_path / "r.json")]) == 2
    assert "surprise" in capsys.readouterr().err
    path.write_bytes(path.read_bytes()[:100])
    assert main(["solve", str(path), "--out", str(tmp_path / "r.json")]) == 2
    assert "obs.npz" in capsys.readouterr().err
    assert not (tmp_path / "r.json").exists()


def test_interrupted_run_leaves_no_result(tmp_path):
    """Ctrl-C while frames are being detected."""
    pictures, out = tmp_path / "pictures", tmp_path / "out"
    pictures.mkdir()
    image = np.random.default_rng(0).integers(0, 255, (240, 320, 3), dtype=np.uint8)
    cv2.imwrite(str(pictures / "0000.png"), image)
    for number in range(1, 3000):
        os.link(pictures / "0000.png", pictures / f"{number:04d}.png")
    command = [sys.executable, "-m", "rmis_calib", "detect", str(pictures), "--out", str(out), "--overlays", "0"]
    with subprocess.Popen(
        command,
        stderr=subprocess.PIPE,
        text=True,
        env=os.environ | {"PYTHONUNBUFFERED": "1"},
        preexec_fn=partial(signal.signal, signal.SIGINT, signal.SIG_DFL),  # a shell's background jobs ignore it
    ) as process:
        assert process.stderr is not None
        seen = ""
        deadline = time.monotonic() + 120
        while "detecting" not in seen and time.monotonic() < deadline:
            seen += process.stderr.readline()
        process.send_signal(signal.SIGINT)
        rest = process.communicate(timeout=60)[1]
    assert process.returncode == 130, seen + rest
    assert "interrupted" in rest
    assert list(tmp_path.iterdir()) == [pictures]
