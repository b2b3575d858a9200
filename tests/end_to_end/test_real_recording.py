"""A real recording (dVRK, one fixed camera, 50 poses) without hints, beside `reference.yaml`, itself good to 0.8 mm."""

import json

import pytest

import rmis_calib as rc
from rmis_calib.cli import main
from rmis_calib.pipeline.evaluation import CHI_3_SIGMA


@pytest.fixture(scope="module")
def calibrated(shared_data, tmp_path_factory):
    out = tmp_path_factory.mktemp("real") / "out"
    code = main(["calibrate", str(shared_data / "recode_recording"), "--out", str(out), "--overlays", "2"])
    return code, out


@pytest.mark.slow
def test_real_recording_is_calibrated(calibrated, shared_data):
    code, out = calibrated
    recording = shared_data / "recode_recording"
    result = rc.CalibrationResult.read(out / "result.json")
    # A still camera whose intrinsics nobody vouches for is 3 to 4 mm off here: told to 3 mm, it is weak or just not.
    assert (code, result.status) in ((0, "ok"), (1, "weak"))
    assert int(result.motions.used.sum()) >= 40
    evaluation = rc.evaluate(result, recording, recording / "reference.yaml")
    assert evaluation.head_point_error_px["right"].median <= 8.0
    assert evaluation.rotation_error_deg <= 1.5
    assert evaluation.translation_error_mm <= 6.0
    assert evaluation.error_sigmas <= CHI_3_SIGMA


@pytest.mark.slow
def test_contours_alone_are_not_to_be_trusted(calibrated, tmp_path, capsys):
    """Residuals below a pixel and an answer that is degrees off: it has to say so."""
    _, out = calibrated
    answer = tmp_path / "contours.json"
    command = ["solve", str(out / "observations.npz"), "--measurements", "axis", "contours", "--out", str(answer)]
    assert main(command) == 1
    assert json.loads(answer.read_text())["status"] in ("weak", "unobservable")
