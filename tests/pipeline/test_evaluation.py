"""`evaluate` says what `calibrate` said, and compares with references that are themselves uncertain."""

import math
from dataclasses import asdict, replace
from pathlib import Path

import numpy as np
import pytest
import torch
import yaml

import data_synth
import rmis_calib as rc
from rmis_calib.config import parse_config
from rmis_calib.errors import InputError
from rmis_calib.geometry import RigidTransform
from rmis_calib.geometry.rotations import rotvec_to_matrix
from rmis_calib.pipeline.evaluation import mahalanobis
from rmis_calib.results import CalibrationResult, Motions
from rmis_calib.solver.observability import Observability

DATA = Path(__file__).resolve().parents[3] / "shared" / "data"
FEW = {"solver": {"bias_correction": False, "advice": {"motions": 0}}}
SMOOTH = {
    "motions": 60,
    "motion": {"kind": "smooth", "speed": 3.0, "joint_rate_hz": 200.0},
    "noise": {"clock_offset_s": 0.4, "kinematics_mm": 0.0, "kinematics_deg": 0.0},
}
CASES = {
    "clean": ({}, {}),
    "clock off": (SMOOTH, {}),
    "joint offsets": ({"noise": {"joint_offset_deg": 0.5, "joint_offset_mm": 0.5}}, {"joint_offsets": "always"}),
    "RCM offset": ({}, {"rcm_offset": "always"}),
    "still": ({"motion": {"laparoscope": "static"}}, {}),
}


def changed(config, changes):
    """A frozen configuration with some nested fields replaced."""
    for key, value in changes.items():
        config = replace(config, **{key: changed(getattr(config, key), value) if isinstance(value, dict) else value})
    return config


@pytest.mark.slow
@pytest.mark.parametrize("case", sorted(CASES))
def test_the_same_numbers_from_the_file_as_from_the_calibration(case, tmp_path) -> None:
    scene, unknowns = CASES[case]
    config = changed(data_synth.load_synth_config("demo"), {"motions": 24, "seed": 3} | scene)
    recording = rc.load_recording(data_synth.write_recording(tmp_path / "recording", config))
    settings = parse_config(FEW | {"solver": FEW["solver"] | {"unknowns": unknowns}})
    result = rc.calibrate(recording, settings, throw=False)
    assert result.camera_right_T_arm is not None and result.head_point_error_px is not None, result.message
    result.write(tmp_path / "result.json")
    again = rc.evaluate(CalibrationResult.read(tmp_path / "result.json"), tmp_path / "recording")
    assert again.head_point_error_px is not None
    for camera, error in result.head_point_error_px.items():
        assert asdict(again.head_point_error_px[camera]) == pytest.approx(asdict(error), abs=1e-9)
    if case == "clock off":
        assert result.kinematic_offsets.clock_s == pytest.approx(0.4, abs=0.05)
        # Counter-literal: without the clock that was found, the head points are elsewhere.
        without = replace(result, nuisances={k: v for k, v in result.nuisances.items() if k != "clock"})
        worse = rc.evaluate(without, recording).head_point_error_px
        assert worse is not None and worse["right"].median > 2 * result.head_point_error_px["right"].median
    if case == "RCM offset":
        assert any(result.kinematic_offsets.rcm_mm)
    if case == "joint offsets":
        assert set(result.kinematic_offsets.joints) == {
            column for arm in ("laparoscope", "instrument") for column in recording.robot.columns(arm)
        }


@pytest.fixture(scope="module")
def answer(tmp_path_factory):
    """A result on a rendered recording, and the recording's folder."""
    folder = tmp_path_factory.mktemp("answer") / "recording"
    config = replace(data_synth.load_synth_config("clean"), motions=24)
    recording = rc.load_recording(data_synth.write_recording(folder, config))
    return rc.calibrate(recording, parse_config(FEW), throw=False), folder


def reference(answer, tmp_path, turn_deg: float, shift_mm: float, **uncertainty) -> Path:
    """A file whose transform is off by a turn about x and a shift along z."""
    matrix = answer[0].camera_right_T_arm.matrix.clone()
    matrix[:3, :3] = rotvec_to_matrix(torch.tensor([math.radians(turn_deg), 0.0, 0.0]).double()) @ matrix[:3, :3]
    matrix[2, 3] += shift_mm
    path = tmp_path / "reference.yaml"
    path.write_text(yaml.safe_dump({"camera_right_T_arm": matrix.tolist()} | uncertainty))
    return path


def test_a_reference_with_its_own_sigma_counts_with_both(answer, tmp_path) -> None:
    result, folder = answer
    exact = rc.evaluate(result, folder, reference(answer, tmp_path, 3.0, 6.0))
    assert exact.rotation_error_deg == pytest.approx(3.0) and exact.translation_error_mm == pytest.approx(6.0)
    assert exact.reference_sigma_deg == 0.0
    path = reference(answer, tmp_path, 3.0, 6.0, sigma_deg=1.5, sigma_mm=4.0)
    loose = rc.evaluate(result, folder, path)
    assert loose.reference_sigma_deg == pytest.approx(1.5 * math.sqrt(3))
    assert loose.reference_sigma_mm == pytest.approx(4.0 * math.sqrt(3))
    assert (loose.result_sigma_deg, loose.result_sigma_mm) == (result.rotation_sigma_deg, result.translation_sigma_mm)
    # By hand, were the result exact: (3 / 1.5)^2 + (6 / 4)^2 = 6.25. Its own sigma only takes away from it.
    assert loose.error_sigmas == pytest.approx(2.5, rel=0.05) and loose.error_sigmas < 2.5
    assert exact.error_sigmas > 5 * loose.error_sigmas
    C = np.diag([math.radians(1.5) ** 2] * 3 + [16.0] * 3).tolist()
    same = rc.evaluate(result, folder, reference(answer, tmp_path, 3.0, 6.0, covariance=C))
    assert same.error_sigmas == pytest.approx(loose.error_sigmas, rel=1e-9)
    rows = dict(loose.rows())
    assert rows["1 sigma of the reference"] == "2.598 deg, 6.928 mm" and "1 sigma of the result" in rows
    assert dict(exact.rows())["1 sigma of the reference"] == "none stated: it counts as exact"


@pytest.mark.parametrize(
    ("uncertainty", "message"),
    [
        ({"sigma_deg": -1.0, "sigma_mm": 1.0}, "sigma_deg: expected a positive number, found -1.0"),
        ({"sigma_deg": 1.0}, "expected sigma_deg and sigma_mm together, found only sigma_deg"),
        ({"sigma_deg": "one", "sigma_mm": 1.0}, "sigma_deg: expected a positive number, found 'one'"),
        ({"covariance": [[1.0]]}, "covariance: expected 6x6 rows of finite numbers"),
        ({"covariance": (-np.eye(6)).tolist()}, "without a negative eigenvalue"),
        ({"covariance": np.triu(np.ones((6, 6))).tolist()}, "a symmetric matrix"),
    ],
)
def test_an_uncertainty_that_cannot_be_is_refused(answer, tmp_path, uncertainty, message) -> None:
    with pytest.raises(InputError, match=message):
        rc.evaluate(*answer, reference(answer, tmp_path, 0.0, 0.0, **uncertainty))


def test_a_distance_in_units_that_differ_by_1e12() -> None:
    C = np.diag([1e-12, 1e-12, 1e-12, 1e12, 1e12, 1e12])
    assert mahalanobis(np.array([1e-6, 0, 0, 0, 1e6, 0]), C) == pytest.approx(math.sqrt(2.0), rel=1e-9)


@pytest.mark.skipif(not (DATA / "recode_recording").is_dir(), reason="no ../shared/data/recode_recording")
def test_the_real_reference_is_not_exact(tmp_path) -> None:
    folder = DATA / "recode_recording"
    known = yaml.safe_load((folder / "reference.yaml").read_text())
    matrix = np.array(known["camera_right_T_arm"])
    matrix[0, 3] += 2.0
    (tmp_path / "near.yaml").write_text(yaml.safe_dump({"camera_right_T_arm": matrix.tolist()}))
    recording = rc.load_recording(folder)
    result = CalibrationResult(
        "ok", "", "joint", RigidTransform("camera_right", "arm", torch.from_numpy(matrix)), None,
        np.diag([1e-6] * 3 + [0.01] * 3), Observability(), Motions(np.ones(1, bool), ("",)),
    )  # fmt: skip
    measured = rc.evaluate(result, recording, folder / "reference.yaml")
    # 2 mm along one axis at 1.2 mm of the reference and 0.1 mm of the result.
    assert measured.error_sigmas == pytest.approx(2.0 / math.hypot(1.2, 0.1), rel=1e-6)
