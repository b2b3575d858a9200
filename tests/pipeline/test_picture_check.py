"""Answers against the pictures: a right one agrees to a fifth of a pixel, and every kind of wrong one is found.

The pictures are the generator's, which shares no code with what is tested; what is wrong is what each test says.
"""

import json
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch
import yaml

import data_synth
import rmis_calib as rc
from rmis_calib.config import parse_config
from rmis_calib.geometry.cameras import Camera
from rmis_calib.geometry.rigid import RigidTransform, rigid_exp
from rmis_calib.pipeline.answer.run import CalibrationRun
from rmis_calib.pipeline.calibration import run_calibration
from rmis_calib.pipeline.checks.picture_check import bend, with_picture_check
from rmis_calib.results import CalibrationResult, PictureCheck

MOTIONS = 16
TOLD = parse_config({"solver": {"unknowns": {"intrinsics": False, "joint_offsets": "never"}}})
"""Cameras and joints are believed, so that nothing absorbs what is wrong in a file."""


@pytest.fixture(scope="module")
def path(tmp_path_factory) -> Path:
    """A stereo recording through lenses (k1 = -0.2), with little noise."""
    path = tmp_path_factory.mktemp("picture_check") / "recording"
    settings = {"motions": MOTIONS, "seed": 3, "noise": {"kinematics_mm": 0.02, "kinematics_deg": 0.01}}
    data_synth.write_recording(path, data_synth.load_synth_config(settings))
    return path


@pytest.fixture(scope="module")
def run(path) -> CalibrationRun:
    return run_calibration(rc.load_recording(path), TOLD)


def looked_at(run: CalibrationRun) -> PictureCheck:
    """What the pictures say of a run, as if it had been answered just now."""
    check = with_picture_check(run).result.picture
    assert check is not None
    return check


def moved(run: CalibrationRun, axis: int, deg: float = 0.0, mm: float = 0.0) -> CalibrationRun:
    """The run with its answer turned about an axis of the camera, or moved along it."""
    answer = run.result.camera_right_T_arm
    turn = torch.zeros(6, dtype=torch.float64)
    turn[axis] = np.deg2rad(deg)
    matrix = answer.matrix.clone()
    matrix[:3, :3] = rigid_exp(turn)[:3, :3] @ matrix[:3, :3]
    matrix[axis, 3] += mm
    wrong = RigidTransform("camera_right", "arm", matrix)
    return replace(run, result=replace(run.result, camera_right_T_arm=wrong))


def seen_by(run: CalibrationRun, change: Callable[[Camera], Camera]) -> CalibrationRun:
    """The run with other cameras."""
    return replace(run, views=tuple(replace(view, camera=change(view.camera)) for view in run.views))


def test_a_right_answer_agrees_with_the_pictures(run, path):
    truth = np.array(yaml.safe_load((path / "ground_truth.yaml").read_text())["camera_right_T_arm"])
    true = replace(run.result, camera_right_T_arm=RigidTransform("camera_right", "arm", torch.from_numpy(truth)))
    for right in (run, replace(run, result=true)):
        check = looked_at(right)
        assert check.passed and not check.sentences
        assert set(check.views) == {"right", "left"}
        for view in check.views.values():
            assert view.motions == MOTIONS and view.edge_share > 0.85
            for px in (view.median_px, view.right_px, view.outward_px):
                assert abs(px) < 0.2
            assert view.spread_px < 0.6
            assert np.abs(view.bend_px).max() < 0.15
            assert abs(view.lens_k1) < 3.0 * view.lens_k1_sigma


@pytest.mark.parametrize("axis", [0, 1, 2])
@pytest.mark.parametrize("by", [{"deg": 1.0}, {"mm": 3.0}], ids=["1 deg", "3 mm"])
def test_a_wrong_hand_eye_is_found(run, axis, by):
    assert looked_at(moved(run, axis, **by)).passed is False


@pytest.mark.parametrize("factor", [0.95, 1.05])
def test_a_wrong_radius_is_found_with_its_sign(run, factor):
    radius = run.result.nuisances["radius"]
    entries = run.result.nuisances | {"radius": replace(radius, value=radius.value * factor)}
    check = looked_at(replace(run, result=replace(run.result, nuisances=entries)))
    assert check.passed is False and "diameter" in check.sentences[0]
    # A shaft of 72 px: 5 per cent of it are 1.8 px a side.
    side_px = 36.0 * (1.0 - factor)
    assert check.views["right"].outward_px == pytest.approx(side_px, abs=0.5)


@pytest.mark.parametrize("shift", [(4.0, 0.0), (0.0, 4.0)])
def test_a_crop_that_was_not_told_is_found(run, shift):
    check = looked_at(seen_by(run, lambda c: replace(c, cx=c.cx + shift[0], cy=c.cy + shift[1])))
    assert check.passed is False


def test_a_wrong_focal_length_is_found(run):
    check = looked_at(seen_by(run, lambda c: replace(c, fx=1.03 * c.fx, fy=1.03 * c.fy)))
    assert check.passed is False and "focal length" in " ".join(check.sentences)


def test_an_ignored_lens_is_found_although_the_answer_was_fitted_to_it(path, tmp_path):
    """The lines are fitted as well as they can be; what is left is bent, and tells how much lens there is."""
    stereo = yaml.safe_load((path / "stereo.yaml").read_text())
    for side in ("right", "left"):
        stereo[side]["distortion"] = [0.0] * 5
    for entry in path.iterdir():
        (tmp_path / entry.name).symlink_to(entry)
    (tmp_path / "stereo.yaml").unlink()
    (tmp_path / "stereo.yaml").write_text(yaml.safe_dump(stereo))
    result = run_calibration(rc.load_recording(tmp_path), TOLD).result
    assert result.picture.passed is False and "k1 of the lens" in " ".join(result.picture.sentences)
    assert result.status != "ok"
    for view in result.picture.views.values():
        # k2 = 0.05 takes a little of k1 = -0.2 away.
        assert view.lens_k1 == pytest.approx(-0.19, abs=3.0 * view.lens_k1_sigma) and view.lens_k1_sigma < 0.03


def test_where_no_shaft_is_few_edges_are_found(run):
    """The picture decides: beside the shaft the stations do not find one, and that is said."""
    check = looked_at(moved(run, 1, mm=40.0))
    assert check.passed is False
    assert all(view.edge_share < 0.35 for view in check.views.values())
    assert "no shaft is where the answer predicts one" in check.sentences[0]


def test_ok_is_taken_away_with_the_reason(run):
    trusted = replace(run.result, status="ok", message="The result passed its own checks")
    result = with_picture_check(moved(replace(run, result=trusted), 0, deg=1.0)).result
    assert result.status == "weak" and "the pictures contradict it: camera_right" in result.message


def test_masks_of_your_own_are_not_held_against_the_picture(run):
    check = with_picture_check(run, own_masks=True).result.picture
    assert check.passed is None and "masks" in check.sentences[0] and not check.views


def test_the_summary_survives_its_file(run, tmp_path):
    run.result.write(tmp_path / "result.json")
    again = CalibrationResult.read(tmp_path / "result.json").picture
    assert again.views["left"].by_place_right_px[0].shape == (4,)
    assert json.loads((tmp_path / "result.json").read_text())["picture"]["passed"] is True
    np.testing.assert_allclose(again.views["right"].along_right_px, run.result.picture.views["right"].along_right_px)


def test_a_bend_is_what_a_line_leaves():
    x = np.arange(6.0)
    bow = np.array([5.0, -1.0, -4.0, -4.0, -1.0, 5.0])  # orthogonal to 1 and x
    px = np.stack([0.3 - 2.0 * x + 0.1 * bow, 0.1 * bow])
    px[1, 3:] = np.nan
    found = bend(px)
    np.testing.assert_allclose(found[0], 0.1 * bow, atol=1e-12)
    assert np.isnan(found[1]).all()  # three stretches tell no bend
