"""Shipped configuration files by name, and YAML read the way people write numbers."""

import difflib
import json
import re
import stat
from collections.abc import Hashable
from pathlib import Path
from typing import Any

import yaml
from yaml.composer import ComposerError

from rmis_calib.errors import ConfigError, FileError, InputError

LARGEST_YAML, LARGEST_JSON = 16 << 20, 1 << 30
"""Bytes of a description that people write, and of a result that holds a line for each of millions of motions."""
_PACKAGE = Path(__file__).resolve().parents[1]


def config_names(kind: str) -> list[str]:
    """Names of the shipped files `configs/<kind>/<name>.yaml`, sorted."""
    return sorted(path.stem for folder in _config_folders(kind) for path in folder.glob("*.yaml"))


def config_path(kind: str, name: str, error: type[InputError] = ConfigError) -> Path:
    """File of a shipped configuration, in the source tree or in the installed package.

    Raises:
        ConfigError: (or the `error` given) no such name; lists the shipped ones.
    """
    known = config_names(kind)
    if name in known:
        return next(path for folder in _config_folders(kind) if (path := folder / f"{name}.yaml").is_file())
    found = f"{name!r}{did_you_mean(name, known)}"
    raise error(
        where=f"{kind.removesuffix('s')} preset", expected=f"one of {', '.join(known) or '(none shipped)'}", found=found
    )


def load_yaml(path: str | Path, error: type[InputError] = ConfigError) -> dict[str, Any]:
    """The mapping in a YAML file: safe tags only, YAML 1.2 scalars (`1e-3` is a number, `no` is a word), no key twice.

    Raises:
        FileError: the file is absent or unreadable.
        ConfigError: (or the `error` given) it is not YAML, or not a mapping; names the line.
    """
    value = load_yaml_value(path, error)
    if not isinstance(value, dict):
        found = "an empty file" if value is None else type(value).__name__
        raise error(where=str(path), expected="a mapping of keys to values", found=found)
    return value


def load_yaml_value(path: str | Path, error: type[InputError] = ConfigError) -> Any:
    """Whatever a YAML file holds, read as `load_yaml` does: a mapping, a list, ...

    Raises:
        FileError: the file is absent or unreadable.
        ConfigError: (or the `error` given) it is not YAML; names the line.
    """
    raw = read_bytes(path, LARGEST_YAML)
    try:
        # Thousands of nested brackets end in a recursion error, thousands of digits in a value error.
        return yaml.load(raw.decode("utf-8-sig"), Loader=_Yaml12Loader)
    except (yaml.YAMLError, ValueError, RecursionError) as problem:
        raise _yaml_error(path, problem, error) from problem


def yaml_value(text: str) -> Any:
    """A value as YAML files write it: `1e-3` a number, `[1, 2]` a list, `ends` a word.

    Raises:
        ConfigError: it is none.
    """
    try:
        return yaml.load(text, Loader=_Yaml12Loader)
    except (yaml.YAMLError, ValueError, RecursionError) as problem:
        raise ConfigError(where=repr(text[:80]), expected="a value as in YAML", found="something else") from problem


def load_json(path: str | Path, error: type[InputError] = InputError) -> dict[str, Any]:
    """The mapping in a JSON file.

    Raises:
        FileError: the file is absent, unreadable or too large.
        InputError: (or the `error` given) it is not JSON, or not a mapping.
    """
    raw = read_bytes(path, LARGEST_JSON)
    try:
        value = json.loads(raw.decode("utf-8-sig"))
    except (ValueError, RecursionError) as problem:
        found = "other text" if raw.strip() else "an empty file"
        raise error(where=str(path), expected="a JSON file", found=found) from problem
    if not isinstance(value, dict):
        raise error(where=str(path), expected="a JSON mapping of keys to values", found=type(value).__name__)
    return value


def read_bytes(path: str | Path, most: int | None = None) -> bytes:
    """Content of an ordinary file.

    Args:
        path: the file.
        most: bytes that such a file may have at most.

    Raises:
        FileError: it is absent, unreadable, too large, or a folder, pipe or device (which might never end).
    """
    check_regular(path, most)
    try:
        return Path(path).read_bytes()
    except OSError as problem:
        raise FileError(where=str(path), expected="a readable file", found=problem.strerror) from problem


def check_regular(path: str | Path, most: int | None = None) -> None:
    """Refuse what is not an ordinary file of at most `most` bytes.

    Raises:
        FileError: see `read_bytes`.
    """
    try:
        status = Path(path).stat()
    except OSError as problem:
        found = "nothing there" if isinstance(problem, FileNotFoundError) else problem.strerror
        raise FileError(where=str(path), expected="a readable file", found=found) from problem
    except ValueError as problem:  # a NUL in the name
        raise FileError(where=repr(str(path)), expected="a file name", found=str(problem)) from problem
    if not stat.S_ISREG(status.st_mode):
        kind = "a folder" if stat.S_ISDIR(status.st_mode) else "a pipe, socket or device"
        raise FileError(where=str(path), expected="a readable file", found=kind)
    if most is not None and status.st_size > most:
        expected = f"at most {most / 2**20:g} MB"
        raise FileError(where=str(path), expected=expected, found=f"{status.st_size / 2**20:.0f} MB")


def did_you_mean(word: str, known: list[str]) -> str:
    """` (did you mean x?)` with the nearest known word, or nothing."""
    near = difflib.get_close_matches(word, known, n=1)
    return f" (did you mean {near[0]}?)" if near else ""


def _config_folders(kind: str) -> list[Path]:
    # A wheel carries configs inside the package; a source tree has it beside the package.
    return [folder for root in (_PACKAGE, _PACKAGE.parent) if (folder := root / "configs" / kind).is_dir()]


def _yaml_error(path: str | Path, problem: Exception, error: type[InputError]) -> InputError:
    if isinstance(problem, yaml.MarkedYAMLError) and problem.problem_mark is not None:
        place = f"{path} line {problem.problem_mark.line + 1}"
        return error(where=place, expected="valid YAML", found=_yaml_problem(problem))
    if isinstance(problem, UnicodeDecodeError):
        return error(where=str(path), expected="UTF-8 text", found=f"byte 0x{problem.object[problem.start]:02x}")
    found = "too many nested brackets" if isinstance(problem, RecursionError) else "something else"
    return error(where=str(path), expected="valid YAML", found=found)


def _yaml_problem(problem: yaml.MarkedYAMLError) -> str:
    """What is wrong at a mark, in our words."""
    text = problem.problem or ""
    if isinstance(problem, yaml.constructor.ConstructorError):
        return "a tag (! or !!), which is not read" if "tag" in text else text
    if isinstance(problem, ComposerError):
        return "an alias (*name) without its anchor (&name)"
    if "\\t" in text or "tab" in text:
        return "a tab: indent by blanks"
    return "a stray bracket, quote, colon or indent, here or on the line before"


class _Yaml12Loader(yaml.SafeLoader):
    """Safe loader with the YAML 1.2 core schema; PyYAML's own is 1.1: `1e-3` a string, `no` false, `1:30` ninety."""

    yaml_implicit_resolvers: dict[str, list[tuple[str, re.Pattern[str]]]] = {}

    def construct_mapping(self, node: yaml.MappingNode, deep: bool = False) -> dict[Hashable, Any]:
        seen: set[Any] = set()
        for key_node, _ in node.value:
            key = self.construct_object(key_node, deep=True)
            problem = f"key {key!r} twice" if isinstance(key, str) else f"a key that is not a word: {key!r}"
            if not isinstance(key, str) or key in seen:
                raise yaml.constructor.ConstructorError(None, None, problem, key_node.start_mark)
            seen.add(key)
        return super().construct_mapping(node, deep)

    def construct_int12(self, node: yaml.ScalarNode) -> int:
        text = self.construct_scalar(node)
        return int(text, 0) if text[:2] in ("0o", "0x") else int(text)

    def construct_float12(self, node: yaml.ScalarNode) -> float:
        return float(self.construct_scalar(node).lower().replace(".inf", "inf").replace(".nan", "nan"))


_RESOLVERS = (
    ("null", r"~|null|Null|NULL|", "~nN\0"),
    ("bool", r"true|True|TRUE|false|False|FALSE", "tTfF"),
    ("int", r"[-+]?[0-9]+|0o[0-7]+|0x[0-9a-fA-F]+", "-+0123456789"),
    ("float", r"[-+]?(\.[0-9]+|[0-9]+(\.[0-9]*)?)([eE][-+]?[0-9]+)?", "-+.0123456789"),
    ("float", r"[-+]?\.(inf|Inf|INF)|\.(nan|NaN|NAN)", "-+."),
)
for _kind, _pattern, _first in _RESOLVERS:
    _letters = [*_first.replace("\0", ""), *([""] if "\0" in _first else [])]
    _Yaml12Loader.add_implicit_resolver(f"tag:yaml.org,2002:{_kind}", re.compile(rf"(?:{_pattern})\Z"), _letters)
_Yaml12Loader.add_constructor("tag:yaml.org,2002:int", _Yaml12Loader.construct_int12)
_Yaml12Loader.add_constructor("tag:yaml.org,2002:float", _Yaml12Loader.construct_float12)
