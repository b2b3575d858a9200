"""YAML as people write it, refused where it is ambiguous; shipped presets by name."""

from pathlib import Path

import pytest

from rmis_calib.errors import ConfigError, FileError, RobotError
from rmis_calib.io.configs import config_names, config_path, load_yaml


def parse(tmp_path: Path, text: str | bytes) -> dict:
    path = tmp_path / "a.yaml"
    path.write_bytes(text if isinstance(text, bytes) else text.encode())
    return load_yaml(path)


@pytest.mark.parametrize(
    ("text", "value"),
    [
        ("1e-3", 1e-3),  # PyYAML's YAML 1.1: the string "1e-3"
        ("-1.5E+3", -1500.0),
        (".5", 0.5),
        ("1.", 1.0),
        ("+5", 5),
        ("010", 10),  # YAML 1.1: octal, 8
        ("0x1F", 31),
        ("0o17", 15),
        ("no", "no"),  # YAML 1.1: false
        ("1:30", "1:30"),  # YAML 1.1: base 60, 90
        ("1_000", "1_000"),  # YAML 1.1: 1000
        ("2020-01-01", "2020-01-01"),
        ("true", True),
        ("~", None),
        ("", None),
        ("'1'", "1"),
        (".inf", float("inf")),
    ],
)
def test_scalars_are_yaml_1_2(tmp_path: Path, text: str, value: object) -> None:
    parsed = parse(tmp_path, f"a: {text}\n")["a"]
    assert parsed == value and type(parsed) is type(value)


def test_byte_order_mark_and_crlf(tmp_path: Path) -> None:
    assert parse(tmp_path, "\ufeffa: 1\r\nb: é\r\n") == {"a": 1, "b": "é"}


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("a: 1\nb: 2\na: 3\n", "line 3: expected valid YAML, found key 'a' twice"),
        ("x: {a: 1, a: 2}\n", "line 1: expected valid YAML, found key 'a' twice"),
        ("a: [1,\n", "line 2: expected valid YAML"),
        ("1: 2\n", "a key that is not a word: 1"),
        ("? [1]\n: 2\n", "a key that is not a word"),
        ("- 1\n", "expected a mapping of keys to values, found list"),
        ("", "found an empty file"),
        ("a: !!python/object/apply:os.system ['true']\n", "found a tag (! or !!), which is not read"),
        (b"a: \xff\n", "expected UTF-8 text, found byte 0xff"),
        ("a: " + "[" * 20_000, "too many nested brackets"),
        ("a: " + "9" * 5_000, "expected valid YAML"),
        ("a: \x01\n", "expected valid YAML"),
    ],
)
def test_what_is_refused_in_one_line(tmp_path: Path, text: str | bytes, message: str) -> None:
    with pytest.raises(ConfigError) as caught:
        parse(tmp_path, text)
    assert message in str(caught.value) and "a.yaml" in str(caught.value) and "\n" not in str(caught.value)


def test_missing_file(tmp_path: Path) -> None:
    with pytest.raises(FileError, match=r"none\.yaml: expected a readable file, found nothing there"):
        load_yaml(tmp_path / "none.yaml")
    with pytest.raises(FileError, match="found a folder"):
        load_yaml(tmp_path)


def test_presets_by_name() -> None:
    assert {"dvrk-classic", "dvrk-si", "rcm-3x3"} <= set(config_names("robots"))
    assert config_path("robots", "dvrk-si").name == "dvrk-si.yaml"
    with pytest.raises(RobotError, match=r"robot preset: expected one of .*dvrk-si.*\(did you mean dvrk-classic\?\)"):
        config_path("robots", "dvrk-clasic", RobotError)
    with pytest.raises(ConfigError, match=r"none shipped"):
        config_path("nonsense", "x")
