"""Studies on rendered pictures: the board against OpenCV's own projection, pixels by hand, a small study end to end."""

import shutil
from dataclasses import replace
from pathlib import Path

import cv2
import numpy as np
import pytest

import rmis_calib as rc
from data_synth import SynthConfig
from data_synth.board import Board, BoardRenderer
from data_synth.kinematics import rigid, rotation_from_rotvec
from data_synth.world import build_world
from rmis_calib.cli import main
from rmis_calib.errors import InputError
from rmis_calib.studies import board as board_measurement
from rmis_calib.studies.experiment import Experiment, drawn_lines, head_errors_px
from rmis_calib.studies.pictures import Measured
from rmis_calib.studies.settings import (
    ComparisonStudySettings,
    EquipmentSettings,
    PictureSettings,
    ReprojectionStudySettings,
    RunSettings,
)

EXACT = PictureSettings(kinematics_noise_mm=0.0, kinematics_noise_deg=0.0, validation=2)
SMALL = PictureSettings(validation=3)


def experiment(pictures: PictureSettings, trials: int = 3) -> Experiment:
    return Experiment(0, Path("none"), pictures, EquipmentSettings(), (4,), (), (), trials, 7, (), ())


def measured(n: int = 10) -> Measured:
    """Heads on the optical axis, 100 mm away, 10 mm apart in y."""
    arm_T_rcm = np.broadcast_to(np.eye(4), (n, 4, 4)).copy()
    arm_T_rcm[:, 1, 3] = 10.0 * np.arange(n)
    head = np.broadcast_to([0.0, 0.0, 100.0], (n, 3)).copy()
    head_right = np.stack([np.zeros(n), 0.1 * np.arange(n)], axis=-1)
    axis = np.arange(n, dtype=float)[:, None, None] * np.ones((n, 2, 2))
    lines = {"arm_T_rcm": arm_T_rcm, "rcm_p_head": head, "head_right": head_right, "axis_right": axis}
    lines |= {"camera_left_T_camera_right": np.eye(4), "shaft_radius_mm": np.float64(4.0)}
    return Measured(lines, {}, np.eye(4), 700.0)


def test_corners_of_the_board_are_where_opencv_projects_them() -> None:
    world, board = build_world(SynthConfig(motions=4)), Board()
    camera = world.cameras["right"]
    camera_T_board = rigid(rotation_from_rotvec([0.35, -0.25, 0.1]), [-18.0, -8.0, 100.0])
    picture = BoardRenderer(camera, board).draw(camera_T_board, np.random.default_rng(0))
    K = np.array([[camera.fx, 0.0, camera.cx], [0.0, camera.fy, camera.cy], [0.0, 0.0, 1.0]])
    rotvec, _ = cv2.Rodrigues(camera_T_board[:3, :3])
    distortion = np.asarray(camera.distortion)
    expected, _ = cv2.projectPoints(board.corner_points(), rotvec, camera_T_board[:3, 3], K, distortion)
    found, corners = cv2.findChessboardCorners(picture, board.inner_corners)
    assert found
    corners = cv2.cornerSubPix(picture, corners, (5, 5), (-1, -1), board_measurement._STOP)
    assert np.linalg.norm(corners.reshape(-1, 2) - expected.reshape(-1, 2), axis=-1).max() < 0.15
    pose = board_measurement._pose(picture, camera, board)
    assert np.linalg.norm(pose[:3, 3] - camera_T_board[:3, 3]) < 0.3
    assert np.abs(pose[:3, :3] - camera_T_board[:3, :3]).max() < 0.01
    assert board_measurement._pose(np.full_like(picture, 90), camera, board) is None


def test_head_errors_by_hand() -> None:
    """The last two of ten poses: 1 mm along x at 100 mm is 7 px; a camera turned round sees nothing."""
    estimate = np.stack([np.eye(4), np.eye(4), np.diag([-1.0, 1.0, -1.0, 1.0])])
    estimate[1, 0, 3] = 1.0
    errors = head_errors_px(measured(), estimate, experiment(EXACT))
    assert errors[:2] == pytest.approx([0.0, 7.0])
    assert np.isinf(errors[2])


def test_trials_draw_motions_and_noise_but_not_the_validation() -> None:
    source = measured()
    arrays = drawn_lines(source, 4, experiment(EXACT), np.random.default_rng(0))
    place = arrays["axis_right"][..., 0, 0]
    assert place.shape == (3, 4)
    assert all(len(set(row)) == 4 for row in place.tolist())
    assert place.max() < 8  # the last two are for validation
    assert np.array_equal(arrays["arm_T_rcm"][..., 1, 3], 10.0 * place)
    assert arrays["camera_left_T_camera_right"].shape == (3, 4, 4)
    noisy = replace(EXACT, kinematics_noise_mm=0.5)
    moved = drawn_lines(source, 8, experiment(noisy, 500), np.random.default_rng(0))
    offset = (
        moved["arm_T_rcm"][..., :3, 3] - source.lines["arm_T_rcm"][moved["axis_right"][..., 0, 0].astype(int), :3, 3]
    )
    assert offset.std() == pytest.approx(0.5 * np.sqrt(2.0), rel=0.03)  # both arms


@pytest.fixture(scope="module")
def compared(tmp_path_factory) -> tuple[Path, ComparisonStudySettings]:
    out = tmp_path_factory.mktemp("study") / "out"
    settings = ComparisonStudySettings(
        methods=("joint",), board_methods=("park", "ata"), experiments=1, motions=(12,), board_motions=(6,),
        pictures=SMALL, run=RunSettings(trials=3, workers=1),
    )  # fmt: skip
    rc.study_comparison(out, settings)
    return out, settings


@pytest.mark.slow
def test_board_and_instrument_are_compared(compared, tmp_path) -> None:
    out, settings = compared
    shutil.copytree(out, tmp_path / "again")
    result = rc.study_comparison(tmp_path / "again", settings)  # nothing is rendered again
    rows = result.table.to_pylist()
    assert [(row["target"], row["method"], row["motions"]) for row in rows[::3]] == [
        ("lines", "joint", 12), ("board", "park", 6), ("board", "ata", 6)
    ]  # fmt: skip
    for row in rows[:3]:  # 12 rendered motions, 0.3 mm and 0.1 deg in each arm
        assert row["rotation_error_deg"] < 2.0
        assert row["translation_error_mm"] < 6.0
    for row in rows[3:6]:
        assert row["rotation_error_deg"] < 4.0
        assert row["reprojection_of_truth_px"] < 12.0
    assert (tmp_path / "again/comparison_motions.pdf").is_file()
    assert (tmp_path / "again/comparison_experiments.png").is_file()


@pytest.mark.slow
def test_reprojection_by_command(tmp_path, capsys) -> None:
    """Experiment 0 has the same pictures in both studies, but for the board."""
    words = [
        "study",
        "reprojection",
        "--methods",
        "global",
        "--motions",
        "4",
        "8",
        "--validation",
        "3",
        "--trials",
        "2",
    ]
    assert main([*words, "--cameras", "stereo", "--workers", "1", "--out", str(tmp_path / "out")]) == 0
    assert "Median head-point error, px / deg / mm" in capsys.readouterr().out


def test_mistakes_are_named_before_anything_is_rendered(tmp_path, capsys) -> None:
    with pytest.raises(InputError, match="--board-methods: expected one of tsai"):
        rc.study_comparison(tmp_path / "a", ComparisonStudySettings(board_methods=("parc",)))
    with pytest.raises(InputError, match="no such|expected|preset"):
        pictures = PictureSettings(preset="nowhere")
        settings = ReprojectionStudySettings(pictures=pictures, motions=(4,), run=RunSettings(workers=1, trials=1))
        rc.study_reprojection(tmp_path / "b", settings)
