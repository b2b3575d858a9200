"""Configuration: one definition, unknown keys and impossible values refused with their names."""

import pytest

from rmis_calib.cli.commands import parse
from rmis_calib.config import CalibrationConfig, load_config, parse_config
from rmis_calib.errors import ConfigError, FileError, InputError
from rmis_calib.io import config_names


def test_defaults_run_everything():
    assert parse_config({}) == CalibrationConfig()


def test_nested_values_are_taken():
    config = parse_config({"device": "cuda:1", "solver": {"method": "paper"}, "detector": {"max_shafts": 2}})
    assert (config.device, config.solver.method, config.detector.max_shafts) == ("cuda:1", "paper", 2)


@pytest.mark.parametrize(
    ("raw", "words"),
    [
        ({"divice": "cpu"}, ["divice", "did you mean device"]),
        ({"solver": {"metod": "paper"}}, ["solver.metod", "did you mean method"]),
        ({"solver": {"method": "magic"}}, ["solver.method", "magic"]),
        ({"device": "gpu"}, ["device", "gpu"]),
        ({"device": "cuda:"}, ["device"]),
        ({"batch_size": 0}, ["batch_size"]),
        ({"batch_size": float("nan")}, ["batch_size"]),
        ({"measurements": ["ends"]}, ["measurements"]),
        ({"measurements": ["lines"]}, ["measurements", "lines"]),
    ],
)
def test_mistakes_are_named(raw, words):
    with pytest.raises(ConfigError) as caught:
        parse_config(raw, where="my.yaml")
    assert all(word in str(caught.value) for word in ["my.yaml", *words])
    assert "\n" not in str(caught.value)


def test_a_setting_that_moved_is_refused_with_its_new_place():
    with pytest.raises(
        ConfigError, match=r"my\.yaml.*expected edge_bias_px in the group picture_errors, found it outside"
    ):
        parse_config({"edge_bias_px": 0.02}, where="my.yaml")
    with pytest.raises(InputError, match="did you mean --picture-errors.edge-bias-px"):
        parse("Calibrate", "calibrate", ["recording", "--edge-bias-px", "0.02"])


@pytest.mark.parametrize(
    ("raw", "option", "words"),
    [
        ({"solver": {"grid": 3}}, ["--solver.grid", "3"], "expected 24 or more, found 3"),
        ({"solver": {"noise": {"image": -1}}}, ["--solver.noise.image", "-1"], "expected more than 0, found -1"),
        (
            {"picture_errors": {"edge_bias_px": -1}},
            ["--picture-errors.edge-bias-px", "-1"],
            "expected 0 or more, found -1",
        ),
        (
            {"solver": {"verdict": {"trustworthy_mm": 30}}},
            ["--solver.verdict.trustworthy-mm", "30"],
            "expected trustworthy_mm at most unobservable_mm, found 30 and 10",
        ),
    ],
)
def test_a_file_and_an_option_are_refused_in_the_same_words(raw, option, words):
    with pytest.raises(ConfigError) as of_file:
        parse_config(raw, where="my.yaml")
    with pytest.raises(ConfigError) as of_option:
        parse("Calibrate", "calibrate", ["recording", *option])
    assert words in str(of_file.value) and words in str(of_option.value)


@pytest.mark.parametrize(
    ("raw", "words"),
    [
        ({"solver": {"verdict": {"working_point_mm": [1.0, 2.0]}}}, "working_point_mm: expected 3 entries, found [1.0"),
        ({"solver": {"verdict": {"working_point_mm": [1.0] * 4}}}, "working_point_mm: expected 3 entries, found [1.0"),
        ({"instrument_at": [1, 2.0]}, "instrument_at: expected 3 entries, found [1, 2.0]"),
        ({"mask_labels": 3}, "mask_labels: expected a list, found 3"),
    ],
)
def test_lists_of_another_length_say_which_is_meant(raw, words):
    with pytest.raises(ConfigError) as caught:
        parse_config(raw)
    assert words in str(caught.value)


def test_yaml_file(tmp_path):
    path = tmp_path / "mine.yaml"
    path.write_text("batch_size: 3\nsolver: {tolerance_sigma: 1e-4}\n")
    config = load_config(path)
    assert (config.batch_size, config.solver.tolerance_sigma) == (3, 1e-4)


def test_missing_file_and_preset(tmp_path):
    with pytest.raises(FileError):
        load_config(tmp_path / "absent.yaml")
    with pytest.raises(InputError, match="no-such-preset"):
        load_config("no-such-preset")


@pytest.mark.parametrize("name", config_names("calibration"))
def test_shipped_presets_change_something(name):
    assert load_config(name) != CalibrationConfig()


def test_round_trip_through_plain_values():
    config = parse_config({"measurements": ["contours"], "solver": {"method": "global"}})
    assert parse_config(config.to_dict()) == config
