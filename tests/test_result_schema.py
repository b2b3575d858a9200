"""The published schema of result.json: it is the one of the code, says every unit, and fits what is written."""

import json
import subprocess
import sys
from pathlib import Path

import jsonschema
import pytest

import rmis_calib as rc
from rmis_calib.results.schema import result_schema

PUBLISHED = Path(__file__).parents[1] / "docs" / "result.schema.json"
WRITTEN_BEFORE = sorted((Path(__file__).parent / "results_written_before").glob("*.json"))


@pytest.fixture(scope="module")
def validator():
    jsonschema.Draft202012Validator.check_schema(json.loads(PUBLISHED.read_text()))
    return jsonschema.Draft202012Validator(json.loads(PUBLISHED.read_text()))


def test_the_published_schema_is_that_of_the_code():
    """`python -m rmis_calib.results.schema > docs/result.schema.json` brings it up to date."""
    assert json.loads(PUBLISHED.read_text()) == result_schema()


def test_the_command_prints_it():
    command = [sys.executable, "-W", "error", "-m", "rmis_calib.results.schema"]
    assert subprocess.run(command, check=True, capture_output=True, text=True).stdout == PUBLISHED.read_text()


def test_every_key_is_described(validator):
    schema = validator.schema
    for part in (schema, *schema["$defs"].values()):
        for key, told in part.get("properties", {}).items():
            described = told.get("description") or schema["$defs"][told["$ref"].rpartition("/")[2]]["description"]
            assert len(described.split()) >= 3, key


def test_a_key_with_a_unit_in_its_name_says_it_in_words(validator):
    units = {"_mm": "mm", "_px": "px", "_deg": "degrees", "_s": "seconds"}
    schema = validator.schema
    named = [
        (key, told["description"], unit)
        for part in (schema, *schema["$defs"].values())
        for key, told in part.get("properties", {}).items()
        for ending, unit in units.items()
        if key.endswith(ending)
    ]
    assert len(named) >= 10
    for key, description, unit in named:
        assert unit in description, key


@pytest.mark.parametrize("path", WRITTEN_BEFORE, ids=lambda path: path.stem)
def test_results_of_earlier_versions_load_without_loss_and_fit(path, validator):
    raw = json.loads(path.read_text())
    validator.validate(raw)
    assert rc.CalibrationResult.read(path).to_dict() == raw


def test_there_are_results_of_earlier_versions():
    """Written before the result had types: trustworthy, weak with advice, and insufficient data."""
    assert {json.loads(path.read_text())["status"] for path in WRITTEN_BEFORE} == {"ok", "weak", "insufficient_data"}


@pytest.mark.parametrize(
    ("change", "where"),
    [
        ({"status": "fine"}, "status: expected 'ok', 'weak', 'unobservable', 'solver_failed' or 'insufficient_data'"),
        ({"covariance": [[1.0, 2.0]]}, "covariance: expected 6 rows of 6 numbers"),
        ({"covariance": [[1.0], [1.0, 2.0]]}, "covariance: expected numbers or null, in rows of one length"),
        ({"camera_right_T_arm": [1.0]}, "camera_right_T_arm: expected dst, src and matrix of a rigid transform"),
        ({"nuisances": {"clock": {"value": "0.1", "sigma": None}}}, "nuisances.clock.unit: expected this key"),
        ({"nuisances": {"clock": {"value": "soon", "sigma": None, "unit": "s"}}}, "clock.value: expected a number"),
        ({"residuals": {"end_right": {"unit": "px", "median": 1.0, "rms": 1.0, "by_motion": ["1"]}}}, "by_motion"),
        ({"motions": {"used_by_motion": [1, 0], "reason_by_motion": ["", ""]}}, "a list of true and false"),
        ({"information": {"shared_names": [], "shared_prior_sigma": [], "matrix": [[1.0]], "vector": [1.0]}},
         "information: expected a vector and a matrix of 6 and the 0 shared_names"),
    ],
)  # fmt: skip
def test_a_value_that_cannot_be_is_named(change, where, tmp_path):
    path = tmp_path / "result.json"
    path.write_text(json.dumps(json.loads(WRITTEN_BEFORE[0].read_text()) | change))
    with pytest.raises(rc.InputError) as caught:
        rc.CalibrationResult.read(path)
    assert str(caught.value).startswith(str(path)) and where in str(caught.value)
