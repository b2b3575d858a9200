"""Configurations from YAML: presets by name, files, or mappings. Unknown and repeated keys and impossible values are
refused."""

from __future__ import annotations

import re
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import yaml
from pydantic import TypeAdapter

from data_synth.settings import SynthConfig

_HERE = Path(__file__).resolve().parent
_FOLDERS = (_HERE.parent / "configs" / "synth", _HERE.parent / "rmis_calib" / "configs" / "synth")


class _Loader(yaml.SafeLoader):
    """Safe YAML that reads 1e-3 as a number and refuses a key that is given twice."""

    def construct_mapping(self, node: yaml.MappingNode, deep: bool = False) -> dict:
        keys = [self.construct_object(key, deep=True) for key, _ in node.value]
        for key in keys:
            if keys.count(key) > 1:
                raise ValueError(f"{node.start_mark.name}: expected every key once, found {key!r} twice")
        return super().construct_mapping(node, deep)


_Loader.add_implicit_resolver(
    "tag:yaml.org,2002:float", re.compile(r"^[-+]?[0-9]+(\.[0-9]*)?[eE][-+]?[0-9]+$"), list("-+0123456789")
)


def synth_presets() -> dict[str, Path]:
    """Shipped presets by name."""
    return {
        path.stem: path for folder in reversed(_FOLDERS) if folder.is_dir() for path in sorted(folder.glob("*.yaml"))
    }


def load_synth_config(source: str | Path | Mapping[str, Any]) -> SynthConfig:
    """Configuration of a preset's name, a YAML file or a mapping; keys that are absent keep their defaults.

    Raises:
        FileNotFoundError: neither a preset nor a file.
        ValueError: a key is unknown or repeated, or a value impossible (pydantic's ValidationError is one).
    """
    if isinstance(source, Mapping):
        return TypeAdapter(SynthConfig).validate_python(dict(source))
    path = synth_presets().get(str(source), Path(source))
    if not path.is_file():
        raise FileNotFoundError(f"{source}: expected a file or one of {sorted(synth_presets())}")
    with path.open(encoding="utf-8") as stream:
        content = yaml.load(stream, _Loader)
    if content is not None and not isinstance(content, dict):
        raise ValueError(f"{path}: expected a mapping, found {type(content).__name__}")
    return TypeAdapter(SynthConfig).validate_python(content or {})


def config_to_dict(config: SynthConfig) -> dict[str, Any]:
    """The configuration as plain values, all keys."""
    return TypeAdapter(SynthConfig).dump_python(config, mode="json")
