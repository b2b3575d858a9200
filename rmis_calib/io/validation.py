"""What pydantic finds wrong, in our words: file, key path, expected, found, and the nearest known key."""

import difflib
from collections.abc import Mapping
from dataclasses import fields, is_dataclass
from typing import Annotated, Any, TypeVar, get_args, get_origin

from pydantic import BaseModel, ValidationError

from rmis_calib.errors import InputError

Model = TypeVar("Model", bound=BaseModel)

_EXPECTED = {
    "missing": "this key",
    "finite_number": "a finite number",
    "int_type": "a whole number",
    "int_parsing": "a whole number",
    "int_from_float": "a whole number",
    "float_type": "a number",
    "float_parsing": "a number",
    "string_type": "a text",
    "string_too_short": "a text that is not empty",
    "string_pattern_mismatch": "letters, digits, _ and -, the first not a digit",
    "bool_type": "true or false",
    "bool_parsing": "true or false",
    "list_type": "a list",
    "tuple_type": "a list",
    "dict_type": "keys with values",
    "model_type": "keys with values",
    "model_attributes_type": "keys with values",
    "dataclass_type": "keys with values",
    "dataclass_exact_type": "keys with values",
    "none_required": "null",
}
_BOUNDS = {
    "greater_than": ("gt", "more than {}"),
    "greater_than_equal": ("ge", "{} or more"),
    "less_than": ("lt", "less than {}"),
    "less_than_equal": ("le", "{} or less"),
    "too_short": ("min_length", "{} entries or more"),
    "too_long": ("max_length", "{} entries or fewer"),
    "literal_error": ("expected", "{}"),
}
_UNKNOWN_KEY = ("extra_forbidden", "unexpected_keyword_argument")


def expectation(kind: str, context: Mapping[str, Any]) -> str:
    """What was expected, in words, where pydantic reports an error of this kind.

    Args:
        kind: pydantic's `type` of the error.
        context: its `ctx`; or `{"bound": number}` where only the number is known.
    """
    if kind in _BOUNDS:
        name, words = _BOUNDS[kind]
        bound = context.get(name, context.get("bound", "?"))
        return words.format(f"{bound:g}" if isinstance(bound, float) else bound)
    return _EXPECTED.get(kind, "another value")


def validate(model: type[Model], raw: dict[str, Any], where: str, error: type[InputError]) -> Model:
    """`raw` as a `model`.

    Raises:
        error: the first entry that is missing, unknown or impossible; says how many more there are.
    """
    try:
        return model.model_validate(raw)
    except ValidationError as problem:
        raise first_finding(problem, model, where, error) from None


def first_finding(problem: ValidationError, schema: type, where: str, error: type[InputError]) -> InputError:
    """The first of pydantic's findings as one of our errors.

    Args:
        problem: what pydantic raised.
        schema: the model or dataclass that it validated, for the keys that it knows.
        where: the file, or whatever was validated.
        error: class of the error.
    """
    # An unknown key first: a misspelt one is also reported as missing, which helps less.
    findings = sorted(problem.errors(), key=lambda finding: finding["type"] not in _UNKNOWN_KEY)
    finding, more = findings[0], len(findings) - 1
    # pydantic marks a bad key of a mapping with a last part "[key]", and members of a union by their type.
    loc = tuple(
        part for part in finding["loc"] if part != "[key]" and not str(part).startswith(("tuple[", "function-"))
    )
    key = ".".join(str(part) for part in loc)
    place = f"{where}: {key}" if key else where
    tail = f" (and {more} more)" if more else ""
    kind = finding["type"]
    if kind in _UNKNOWN_KEY:
        known = sorted(_known_keys(schema, loc[:-1]))
        near = difflib.get_close_matches(str(loc[-1]), known, n=1)
        hint = f" (did you mean {near[0]}?)" if near else f" (known: {', '.join(known)})" if known else ""
        return error(where=place, expected="a known key", found=f"an unknown one{hint}{tail}")
    if kind == "missing":
        return error(where=place, expected="this key", found=f"nothing{tail}")
    if kind == "value_error":
        text = str(finding.get("ctx", {}).get("error", ""))
        if text.startswith(("expected ", "looks ")):
            return error(f"{text}{tail}", where=place)
        return error(where=place, expected=text, found=f"{_short(finding['input'])}{tail}")
    expected = expectation(kind, finding.get("ctx") or {})
    return error(where=place, expected=expected, found=f"{_short(finding['input'])}{tail}")


def _short(value: Any) -> str:
    text = "null" if value is None else repr(value)
    return text if len(text) <= 60 else f"{text[:57]}..."


def _known_keys(schema: Any, loc: tuple[int | str, ...]) -> set[str]:
    """Keys that the model or dataclass reached by `loc` accepts."""
    node: Any = schema
    for part in loc:
        annotations = _fields_of(node)
        node = _unwrap(annotations[str(part)] if str(part) in annotations else _item_type(node))
    return set(_fields_of(node))


def _fields_of(node: Any) -> dict[str, Any]:
    if isinstance(node, type) and issubclass(node, BaseModel):
        return {name: field.annotation for name, field in node.model_fields.items()}
    return {field.name: field.type for field in fields(node)} if is_dataclass(node) else {}


def _unwrap(node: Any) -> Any:
    """`X` of `Annotated[X, ...]` and of `X | None`."""
    if get_origin(node) is Annotated:
        return _unwrap(get_args(node)[0])
    options = [option for option in get_args(node) if option is not type(None)]
    is_optional = type(None) in get_args(node)
    return _unwrap(options[0]) if is_optional and options else node


def _item_type(node: Any) -> Any:
    """Value type of a dict or a list."""
    return get_args(node)[-1] if get_args(node) else Any
