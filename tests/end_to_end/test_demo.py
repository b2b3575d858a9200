"""The whole path on rendered recordings: what a user types, and how far the answer is from the truth."""

import json
from dataclasses import replace
from pathlib import Path

import jsonschema
import numpy as np
import pytest

import data_synth
import rmis_calib as rc
from rmis_calib.cli import main
from rmis_calib.pipeline.evaluation import CHI_3_SIGMA


@pytest.mark.slow
def test_demo_is_within_a_tenth_of_a_degree_and_its_own_sigmas(demo_output):
    result = rc.CalibrationResult.read(demo_output / "calibration" / "result.json")
    evaluation = rc.evaluate(result, demo_output / "recording")
    assert evaluation.rotation_error_deg <= 0.10
    assert evaluation.translation_error_mm <= 0.3
    assert evaluation.error_sigmas <= CHI_3_SIGMA
    assert evaluation.head_point_error_px["right"].median < 2.0


@pytest.mark.slow
def test_demo_leaves_everything_a_user_looks_at(demo_output):
    calibration = demo_output / "calibration"
    names = {path.name for path in calibration.iterdir()}
    assert {"result.json", "report.html", "observations.npz", "config.yaml", "overlays"} <= names
    result = json.loads((calibration / "result.json").read_text())
    assert result["status"] == "ok"
    assert result["motions"]["used"] >= 54
    schema = Path(__file__).parents[2] / "docs" / "result.schema.json"
    jsonschema.validate(result, json.loads(schema.read_text()))
    assert "ground_truth" not in (calibration / "report.html").read_text()


@pytest.mark.slow
def test_solving_the_written_observations_gives_the_same_answer(demo_output, tmp_path):
    calibration = demo_output / "calibration"
    assert main(["solve", str(calibration / "observations.npz"), "--out", str(tmp_path / "again.json")]) == 0
    first = rc.CalibrationResult.read(calibration / "result.json")
    again = rc.CalibrationResult.read(tmp_path / "again.json")
    np.testing.assert_allclose(again.camera_right_T_arm.matrix, first.camera_right_T_arm.matrix, atol=1e-9)
    # The covariance allows for joint offsets, whose effect the file tells to first order: measured 1 per cent apart.
    sigma = np.sqrt(np.diag(first.covariance))
    np.testing.assert_allclose(
        again.covariance / np.outer(sigma, sigma), first.covariance / np.outer(sigma, sigma), atol=0.02
    )


@pytest.mark.slow
def test_config_file_written_beside_the_result_repeats_it(demo_output):
    config = rc.load_config(demo_output / "calibration" / "config.yaml")
    assert config == rc.CalibrationConfig()


@pytest.mark.slow
def test_swapped_cameras_are_noticed(demo_output):
    """Left pictures taken for right ones still fit a rig of another shape: the answer must not look right."""
    seen = rc.ShaftObservations.load(demo_output / "calibration" / "observations.npz")
    sides = {"right": "left", "left": "right"}
    swapped = {
        f"{name}_{side}": getattr(seen, f"{name}_{other}")
        for name in ("axis", "contour", "end", "valid", "sigma_axis", "sigma_contour", "sigma_end")
        for side, other in sides.items()
    }
    with pytest.raises(rc.CalibrationFailed, match="are the cameras swapped"):
        rc.solve(replace(seen, head_right=None, head_left=None, rcm_p_head=None, **swapped))


@pytest.fixture(scope="module")
def static_observations(tmp_path_factory):
    """Detections of a rendered recording whose laparoscope stands still."""
    path = tmp_path_factory.mktemp("static") / "recording"
    config = {"motions": 60, "seed": 11, "motion": {"laparoscope": "static"}}
    data_synth.write_recording(path, data_synth.load_synth_config(config))
    run = rc.run_calibration(rc.load_recording(path))
    return path, run.result, run.observations


def mono(observations):
    """The same motions seen by the right camera alone."""
    left = [name for name in vars(observations) if name.endswith("_left")]
    return replace(observations, camera_left_T_camera_right=None, **dict.fromkeys(left))


@pytest.mark.slow
def test_static_laparoscope_stereo(static_observations):
    path, result, _ = static_observations
    assert result.status == "ok"
    evaluation = rc.evaluate(result, path)
    assert evaluation.rotation_error_deg <= 0.15
    assert evaluation.translation_error_mm <= 0.6
    assert evaluation.error_sigmas <= CHI_3_SIGMA


@pytest.mark.slow
def test_static_laparoscope_mono(static_observations):
    path, _, observations = static_observations
    evaluation = rc.evaluate(rc.solve(mono(observations)), path)
    assert evaluation.rotation_error_deg <= 0.15
    assert evaluation.translation_error_mm <= 0.6
    assert evaluation.error_sigmas <= CHI_3_SIGMA


@pytest.mark.slow
def test_static_laparoscope_mono_axis_lines_only_is_refused_by_name(static_observations):
    _, _, observations = static_observations
    config = rc.CalibrationConfig(measurements=("axis",))
    with pytest.raises(rc.CalibrationFailed) as caught:
        rc.solve(mono(observations), config)
    words = str(caught.value)
    assert "translation along" in words
    assert "did not move" in words
    assert caught.value.result.status == "unobservable"
