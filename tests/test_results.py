"""result.json: what is written is what is read, and nothing unknown looks like a number."""

import json
import math

import numpy as np
import pytest
import torch

from rmis_calib.errors import FileError, InputError, OutputError
from rmis_calib.geometry.rigid import RigidTransform
from rmis_calib.io.plain_values import finite_or_none
from rmis_calib.results import CalibrationResult, Motions


def transform(dst: str, src: str, x_mm: float) -> RigidTransform:
    matrix = torch.eye(4, dtype=torch.float64)
    matrix[0, 3] = x_mm
    return RigidTransform(dst, src, matrix)


@pytest.fixture
def result() -> CalibrationResult:
    return CalibrationResult(
        status="ok",
        message="The result passed its own checks",
        method="joint",
        camera_right_T_arm=transform("camera_right", "arm", 10.0),
        camera_left_T_camera_right=transform("camera_left", "camera_right", 5.0),
        covariance=np.diag([1e-6, 1e-6, 2e-6, 0.01, 0.01, 0.02]),
        observability={"verdict": "trustworthy", "sentences": ["all seen"]},
        motions=Motions(np.array([True, False]), ("", "no dark region"), np.array([0.0, 0.5])),
        residuals={"contour_right": {"unit": "px", "median": 0.1, "rms": 0.2, "by_motion": np.array([0.1, np.nan])}},
    )


def test_round_trip(result, tmp_path):
    result.write(tmp_path / "result.json")
    again = CalibrationResult.read(tmp_path / "result.json")
    assert again.to_dict() == result.to_dict()


def test_left_transform_is_the_product_in_frame_order(result):
    # camera_left_T_arm = camera_left_T_camera_right @ camera_right_T_arm: 5 + 10 along x.
    assert result.camera_left_T_arm.name == "camera_left_T_arm"
    assert result.camera_left_T_arm.t.tolist() == [15.0, 0.0, 0.0]


def test_sigmas_are_roots_of_traces_in_their_units(result):
    assert result.rotation_sigma_deg == pytest.approx(math.degrees(math.sqrt(4e-6)))
    assert result.translation_sigma_mm == pytest.approx(0.2)


def test_file_has_the_contract_keys_and_no_nan(result, tmp_path):
    result.write(tmp_path / "result.json")
    text = (tmp_path / "result.json").read_text()
    raw = json.loads(text)
    contract = "format status method camera_right_T_arm camera_left_T_arm camera_left_T_camera_right covariance"
    contract += (
        " rotation_sigma_deg translation_sigma_mm observability motions residuals head_point_error_px config versions"
    )
    assert set(contract.split()) <= set(raw)
    assert raw["format"] == "rmis-calib-result/1"
    assert "NaN" not in text
    assert raw["residuals"]["contour_right"]["by_motion"] == [0.1, None]
    assert raw["motions"]["rejected"] == {"no dark region": 1}
    assert set(raw["camera_right_T_arm"]) == {"dst", "src", "matrix", "quat_wxyz", "translation_mm"}


def test_unknown_numbers_become_null():
    record = finite_or_none({"a": float("nan"), "b": np.array([1.0, np.inf]), "c": np.float64("-inf"), 3: (True, None)})
    assert record == {"a": None, "b": [1.0, None], "c": None, "3": [True, None]}


def test_mono_result_has_no_left(result):
    mono = CalibrationResult.from_dict(
        result.to_dict() | {"camera_left_T_camera_right": None, "camera_left_T_arm": None}
    )
    assert mono.camera_left_T_arm is None


@pytest.mark.parametrize(
    ("text", "error", "words"),
    [
        ("{", InputError, "JSON"),
        ("[]", InputError, "a JSON mapping of keys to values"),
        ('{"format": "rmis-calib-result/2"}', InputError, "rmis-calib-result/2"),
        ('{"format": "rmis-calib-result/1"}', InputError, "status: expected this key, found nothing"),
    ],
)
def test_reading_something_else_names_it(tmp_path, text, error, words):
    path = tmp_path / "result.json"
    path.write_text(text)
    with pytest.raises(error, match="result.json") as caught:
        CalibrationResult.read(path)
    assert words in str(caught.value)


def test_missing_file(tmp_path):
    with pytest.raises(FileError, match="nowhere.json"):
        CalibrationResult.read(tmp_path / "nowhere.json")


def test_unwritable_place(result, tmp_path):
    (tmp_path / "file").write_text("")
    with pytest.raises(OutputError):
        result.write(tmp_path / "file" / "result.json")
