"""A command's dataclass as flags: what it does not use is left out, values are named by what they mean.

The settings of a calibration are one class for Python, YAML and the command line (`config.py`), and no command needs
all of them. tyro takes flags from types; so each command gets types of its own, made here from the shared ones.
"""

import dataclasses
import inspect
import typing
from functools import cache
from types import UnionType
from typing import Annotated, Any

import docstring_parser
import tyro
from pydantic import ConfigDict, TypeAdapter
from pydantic.dataclasses import dataclass as validated

METAVARS = {
    "recording": "RECORDING",
    "observations": "OBSERVATIONS",
    "result": "RESULT",
    "results": "RESULT [RESULT ...]",
    "root": "RECORDINGS",
    "source": "SOURCE",
    "poses": "POSES [BOARD]",
    "paths": "RECORDING|RESULT [...]",
    "robot": "ROBOT",
    "config": "PRESET|FILE",
    "preset": "PRESET|FILE",
    "device": "cpu|cuda|cuda:N",
    "masks": "FOLDER|MODEL",
    "mask_labels": "CLASS [CLASS ...]",
    "prior": "RESULT|FILE",
    "instrument_at": "FRAME U V",
    "truth": "FILE",
    "cluster": "ADDRESS|local",
    "host": "ADDRESS",
    "map": "COLUMN TABLE_COLUMN[:UNIT] [...]",
    "image_size": "WIDTH HEIGHT",
    "crop_right": "U V WIDTH HEIGHT",
    "crop_left": "U V WIDTH HEIGHT",
    "methods": "METHOD [METHOD ...]",
    "sources": "SOURCE [SOURCE ...]",
    "extensions": "FILE [FILE ...]",
}
_UNITS = {"mm": "MM", "deg": "DEG", "px": "PX", "s": "SECONDS", "ms": "MS", "min": "MINUTES", "gb": "GB", "hz": "HZ"}
_VECTORS = {"working_point_mm", "instrument_rcm_mm", "target_mm", "rcm_base_mm", "rcm_board_mm"}
_STRICT = ConfigDict(extra="forbid", allow_inf_nan=False)


@cache
def flags_of(kind: type) -> type:
    """The type that tyro reads for a command's dataclass.

    Args:
        kind: a dataclass. Its class attribute `uses`, where it has one, names the fields of `settings` that become
            flags; the others keep the values of the YAML file or their defaults.
    """
    uses = getattr(kind, "uses", None)
    hints = typing.get_type_hints(kind, include_extras=True)
    fields = []
    for spec in dataclasses.fields(kind):
        hint = hints[spec.name]
        group = _settings_class(hint)
        if group is not None:
            narrowed = _group(group, frozenset(uses) if uses is not None and spec.name == "settings" else None)
            hint, factory = _with_class(hint, narrowed), narrowed
            fields.append((spec.name, hint, dataclasses.field(default_factory=factory)))
        else:
            fields.append((spec.name, _named(kind, spec, hint), _copy(spec)))
    made = dataclasses.make_dataclass(kind.__name__, fields, frozen=True, kw_only=True)
    made.__doc__ = inspect.cleandoc(kind.__doc__ or "")
    return made


def flags_with(kind: type, settings: Any) -> Any:
    """An instance of `flags_of(kind)` with these `settings` as defaults, and required arguments still to be given."""
    made = flags_of(kind)
    values = {"settings": _converted(typing.get_type_hints(made, include_extras=True)["settings"], settings)}
    for spec in dataclasses.fields(made):
        if spec.default is dataclasses.MISSING and spec.default_factory is dataclasses.MISSING:
            values[spec.name] = tyro.MISSING
    return made(**values)


def from_flags(kind: type, parsed: Any) -> Any:
    """What tyro parsed, as an instance of the command's own dataclass.

    Raises:
        pydantic.ValidationError: a value that no setting may have.
    """
    hints = typing.get_type_hints(kind, include_extras=True)
    return kind(
        **{
            name: _converted(hints[name], getattr(parsed, name))
            for name in (spec.name for spec in dataclasses.fields(kind))
        }
    )


def _converted(hint: Any, value: Any) -> Any:
    """A group of settings as one of the class that the annotation names; other values as they are."""
    group = _settings_class(hint)
    return value if group is None else TypeAdapter(group).validate_python(dataclasses.asdict(value))


@cache
def _group(kind: type, used: frozenset[str] | None = None) -> type:
    """A group of settings with its values named; unused ones are no flags."""
    hints = typing.get_type_hints(kind, include_extras=True)
    annotations, namespace = {}, {"__doc__": kind.__doc__, "__module__": kind.__module__}
    for spec in dataclasses.fields(kind):
        hint, default = hints[spec.name], _copy(spec)
        if used is not None and spec.name not in used:
            hint = Annotated[hint, tyro.conf.Fixed, tyro.conf.Suppress]
        elif (inner := _settings_class(hint)) is not None:
            hint = _with_class(hint, _group(inner))
            default = dataclasses.field(default_factory=_group(inner))
        else:
            hint = _named(kind, spec, hint)
        annotations[spec.name] = hint
        namespace[spec.name] = default
    made = type(kind.__name__, (kind,), namespace | {"__annotations__": annotations})
    return validated(frozen=True, config=_STRICT)(made)


def _settings_class(hint: Any) -> type | None:
    """The class of a group of settings, out of its annotations; None for a single value."""
    inner = typing.get_args(hint)[0] if typing.get_origin(hint) is Annotated else hint
    return inner if isinstance(inner, type) and dataclasses.is_dataclass(inner) else None


def _with_class(hint: Any, made: type) -> Any:
    if typing.get_origin(hint) is not Annotated:
        return made
    return Annotated[(made, *hint.__metadata__)]


def _copy(spec: dataclasses.Field[Any]) -> Any:
    if spec.default_factory is not dataclasses.MISSING:
        return dataclasses.field(default_factory=spec.default_factory)
    return spec.default if spec.default is not dataclasses.MISSING else dataclasses.field()


def _named(kind: type, spec: dataclasses.Field[Any], hint: Any) -> Any:
    """The annotation with the value's name and its sentence, which tyro would break where the source does."""
    said = " ".join((_sentences(kind).get(spec.name) or "").split()) or None
    shown = "" if spec.default in (None, False, dataclasses.MISSING) else None  # these say nothing to a reader
    return Annotated[hint, tyro.conf.arg(metavar=metavar(spec.name, hint), help=said, help_behavior_hint=shown)]


def metavar(name: str, hint: Any) -> str | None:
    """What stands for a value in the help; None leaves choices and switches to tyro."""
    if name in METAVARS:
        return METAVARS[name]
    if name in _VECTORS:
        return "X Y Z"
    kinds = _kinds(hint)
    if bool in kinds or not kinds or any(typing.get_origin(kind) is not None for kind in kinds):
        return None
    unit = _UNITS.get(name.rpartition("_")[2])
    if unit is not None and kinds & {int, float}:
        return unit
    if int in kinds:
        return "N"
    if float in kinds:
        return "NUMBER"
    return "NAME" if kinds == {str} else "PATH"


def _kinds(hint: Any) -> set[Any]:
    """The plain types of an annotation, None left out."""
    if typing.get_origin(hint) is Annotated:
        return _kinds(typing.get_args(hint)[0])
    if typing.get_origin(hint) in (typing.Union, UnionType):
        return {kind for part in typing.get_args(hint) for kind in _kinds(part)} - {type(None)}
    return {hint}


@cache
def _sentences(kind: type) -> dict[str, str]:
    """What stands below each field of a class and of its bases."""
    said: dict[str, str] = {}
    for base in reversed(kind.__mro__[:-1]):
        said |= {entry.arg_name: entry.description or "" for entry in docstring_parser.parse_from_object(base).params}
    return said
