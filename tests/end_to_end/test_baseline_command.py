"""`rmis-calib baseline`: the table, the transforms, and what it refuses."""

import json
import sys
from pathlib import Path

import numpy as np
import pytest

from rmis_calib.cli import main

sys.path.insert(0, str(Path(__file__).resolve().parents[1] / "baselines"))
from scenes import RCM_IN_BASE, noisy, scene


@pytest.fixture
def pairs(tmp_path: Path):
    data = noisy(scene(3, 20), 4, camera=(0.002, 0.3))
    np.savez(tmp_path / "pairs.npz", base_T_flange=data.base_T_flange, camera_T_board=data.camera_T_board)
    return data, tmp_path / "pairs.npz"


def test_every_method_side_by_side(pairs, tmp_path: Path, capsys: pytest.CaptureFixture) -> None:
    data, path = pairs
    board_p_rcm = data.inputs("rcm")["board_p_rcm"]
    centre = ["--rcm-base-mm", *map(str, RCM_IN_BASE), "--rcm-board-mm", *map(str, board_p_rcm)]
    assert main(["baseline", str(path), *centre, "--out", str(tmp_path / "all.json")]) == 0
    printed = capsys.readouterr().out
    for name in ("tsai", "rcm", "refine", "flange_T_camera", "camera_T_flange", "base_T_board", "board_T_base"):
        assert name in printed
    written = json.loads((tmp_path / "all.json").read_text())
    assert list(written["methods"]) == [
        "tsai",
        "park",
        "horaud",
        "andreff",
        "daniilidis",
        "ata",
        "rcm",
        "shah",
        "li",
        "refine",
    ]
    for method in written["methods"].values():
        found = np.array(method["transforms_mm"]["flange_T_camera"])
        assert method["status"] == "ok" and np.abs(found - data.flange_T_camera).max() < 3.0
    # The program's own file may be replaced when asked, another one never.
    assert main(["baseline", str(path), "--method", "park", "--out", str(tmp_path / "all.json"), "--overwrite"]) == 0
    assert main(["baseline", str(path), "--out", str(path), "--overwrite"]) == 2


def test_degenerate_motion_is_named(tmp_path: Path, capsys: pytest.CaptureFixture) -> None:
    turns = np.random.default_rng(0).normal(size=(12, 1)) * np.array([0.0, 0.0, 0.5])
    data = scene(5, 12, turns=turns)
    np.savez(tmp_path / "one_axis.npz", base_T_flange=data.base_T_flange, camera_T_board=data.camera_T_board)
    assert main(["baseline", str(tmp_path / "one_axis.npz")]) == 1
    printed = capsys.readouterr().out
    assert printed.count("not answered: single axis") == 10  # nine methods, and the summary
    assert "degenerate: all rotations share one axis" in printed and "flange_T_camera, mm" not in printed


def test_a_transform_read_the_wrong_way_round_is_named(pairs, capsys: pytest.CaptureFixture) -> None:
    _, path = pairs
    assert main(["baseline", str(path), "--setup", "eye_to_hand", "--method", "park"]) == 1
    assert "do fit if either base_T_flange or camera_T_board is inverted" in capsys.readouterr().out


def test_bad_usage(pairs, tmp_path: Path, capsys: pytest.CaptureFixture) -> None:
    _, path = pairs
    for words, message in (
        ([str(tmp_path / "nothing.npz")], "found nothing there"),
        ([str(path), "--method", "rcm"], "expected base_p_rcm and board_p_rcm"),
        ([str(path), "--method", "parc"], "found parc (did you mean park?)"),
        ([str(path), "--unit", "m"], "pass --unit mm"),
    ):
        assert main(["baseline", *words]) == 2
        assert message in capsys.readouterr().err
