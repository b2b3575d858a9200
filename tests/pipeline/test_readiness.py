"""`rc.check`: a good recording is called fit, and each mistake is told in words before anything is calibrated."""

import csv
import shutil
from dataclasses import replace
from pathlib import Path

import cv2
import numpy as np
import pytest
import torch
import yaml

import data_synth
import rmis_calib as rc
from rmis_calib.cli import main
from rmis_calib.pipeline.checks.stereo_order import inverse_depth, looks_swapped

MOTIONS = 20


@pytest.fixture(scope="module")
def rendered(tmp_path_factory) -> Path:
    """Stereo pictures at stops of both arms."""
    config = data_synth.load_synth_config("demo")
    config = replace(config, motions=MOTIONS, seed=3, output=replace(config.output, pictures="images"))
    return data_synth.write_recording(tmp_path_factory.mktemp("rendered") / "recording", config)


@pytest.fixture
def folder(rendered: Path, tmp_path: Path) -> Path:
    """A copy of it that a test may spoil."""
    return Path(shutil.copytree(rendered, tmp_path / "recording"))


def doubts(folder: Path) -> dict[str, str]:
    """Doubts by their topic."""
    return {finding.topic: finding.sentence for finding in rc.check(folder).doubts}


def edit_joints(folder: Path, change) -> None:
    with (folder / "joints.csv").open(newline="") as file:
        header, *rows = csv.reader(file)
    values = np.array(rows, dtype=float)
    change(header, values)
    with (folder / "joints.csv").open("w", newline="") as file:
        csv.writer(file).writerows([header, *values.tolist()])


def test_a_good_recording_is_fit(rendered: Path) -> None:
    check = rc.check(rendered)
    assert check.fit, check.doubts
    said = {finding.topic: finding.sentence for finding in check.findings}
    assert f"{MOTIONS} stereo pairs, 640 x 480 px" in said["files"]
    assert f"joints are known at {MOTIONS} of {MOTIONS} frames" in said["clocks"]
    # The scene has the instrument's target at 100 mm, its wrist about there.
    assert "in front of the cameras" in said["stereo"]
    assert check.expected_sigma_mm is not None and 0.05 < check.expected_sigma_mm < 2.5
    assert check.expected_sigma_deg is not None and 0.01 < check.expected_sigma_deg < 2.0


def test_swapped_cameras(folder: Path) -> None:
    (folder / "right").rename(folder / "other")
    (folder / "left").rename(folder / "right")
    (folder / "other").rename(folder / "left")
    assert "the right and the left pictures look swapped" in doubts(folder)["stereo"]


def test_extrinsics_the_wrong_way_round(folder: Path) -> None:
    stereo = yaml.safe_load((folder / "stereo.yaml").read_text())
    stereo["camera_left_T_camera_right"] = np.linalg.inv(stereo["camera_left_T_camera_right"]).tolist()
    (folder / "stereo.yaml").write_text(yaml.safe_dump(stereo))
    assert "the inverse of what it should be" in doubts(folder)["stereo"]


def test_a_grabber_that_hangs(folder: Path) -> None:
    pictures = sorted((folder / "right").iterdir())
    for picture in pictures[6:]:
        shutil.copyfile(pictures[5], picture)
    found = doubts(folder)
    assert (
        "camera_right" in found["repeated"] and "repeat the one before although the joints moved" in found["repeated"]
    )


def test_a_log_that_covers_few_frames(folder: Path) -> None:
    with (folder / "frame_times.csv").open() as file:
        times = [float(row["timestamp_s"]) for row in csv.DictReader(file)]
    late = times[-1] - times[MOTIONS // 4]

    def shift(header: list[str], values: np.ndarray) -> None:
        values[:, 0] -= late + values[-1, 0] - times[-1]

    edit_joints(folder, shift)
    known = doubts(folder)["clocks"]
    assert known.endswith(f"of {MOTIONS} frames") and int(known.split()[4]) < MOTIONS / 2


def test_arms_that_stand_still_are_told_here_and_by_calibrate(folder: Path) -> None:
    def stop(header: list[str], values: np.ndarray) -> None:
        values[:, 1:] = values[0, 1:]

    edit_joints(folder, stop)
    assert doubts(folder)["motion"].startswith("1 distinct motions: at least 6")
    result = rc.calibrate(rc.load_recording(folder), throw=False)
    assert not result.trustworthy
    assert any(note.startswith("motion: 1 distinct motions") for note in result.notes)


def test_pictures_without_a_shaft(folder: Path) -> None:
    for number, picture in enumerate(sorted((folder / "left").iterdir())):
        grey = np.full((480, 640, 3), 160 + number, np.uint8)
        assert cv2.imwrite(str(picture), grey)
    assert doubts(folder)["shaft"] == "camera_left: found in 0 of 10 frames looked at"


def test_too_little_motion_is_predicted_to_be_too_little(shared_data: Path) -> None:
    sentence = doubts(shared_data / "ucsd_easy")["expected"]
    assert "the motion is below the noise of the kinematics" in sentence


@pytest.mark.parametrize("name", ["recode_recording", "thrust_recording", "cwru_jul23"])
def test_real_recordings_are_fit(shared_data: Path, name: str) -> None:
    check = rc.check(shared_data / name)
    assert check.fit, check.doubts
    assert check.expected_sigma_mm is not None and 0.1 < check.expected_sigma_mm < 2.5


def test_a_recording_that_calibrates_weakly_is_predicted_to(shared_data: Path) -> None:
    """`calibrate` calls it weak, at 10 mm."""
    assert set(doubts(shared_data / "ucsd_0617_sync")) == {"expected"}


def test_exit_codes(folder: Path, capsys) -> None:
    before = sorted(path.name for path in folder.parent.iterdir())
    assert main(["check", str(folder)]) == 0
    assert "nothing speaks against calibrating it" in capsys.readouterr().out
    for picture in (folder / "right").iterdir():
        assert cv2.imwrite(str(picture), np.full((480, 640, 3), 160, np.uint8))
    assert main(["check", str(folder)]) == 1
    assert "DOUBT" in capsys.readouterr().out
    (folder / "joints.csv").write_text("nonsense\n")
    assert main(["check", str(folder)]) == 2
    assert "joints.csv" in capsys.readouterr().err
    assert sorted(path.name for path in folder.parent.iterdir()) == before


def test_inverse_depth_of_a_hand_made_pair() -> None:
    # A vertical axis at 100 mm: straight ahead of the right camera, 5 mm to the right of the left one's axis.
    left_T_right = torch.eye(4, dtype=torch.float64)
    left_T_right[0, 3] = 5.0

    def upright(x: float) -> torch.Tensor:
        return torch.tensor([[[x, -0.1], [x, 0.2]]], dtype=torch.float64)

    assert inverse_depth(left_T_right, upright(0.0), upright(0.05)).item() == pytest.approx(0.01)
    assert inverse_depth(left_T_right, upright(0.05), upright(0.0)).item() == pytest.approx(-0.01)
    # Along the baseline a line tells nothing.
    level = torch.tensor([[[-0.1, 0.0], [0.2, 0.0]]], dtype=torch.float64)
    assert torch.isnan(inverse_depth(left_T_right, level, level)).all()
    assert looks_swapped(-0.01) and not looks_swapped(0.01) and not looks_swapped(-1e-5) and not looks_swapped(None)
