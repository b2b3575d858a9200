"""What pydantic finds wrong, in our words: file, key path, expected, found, and the nearest known key."""

import difflib
from typing import Any, TypeVar

from pydantic import BaseModel, TypeAdapter, ValidationError

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
    "literal_error": ("expected", "{}"),
    "enum": ("expected", "{}"),
}
_LENGTHS = {"too_short": ("min_length", "{} or more"), "too_long": ("max_length", "{} or fewer")}
_UNKNOWN_KEY = ("extra_forbidden", "unexpected_keyword_argument")


def validate(model: type[Model], raw: dict[str, Any], where: str, error: type[InputError]) -> Model:
    """`raw` as a `model`.

    Raises:
        error: the first entry that is missing, unknown or impossible; says how many more there are.
    """
    try:
        return model.model_validate(raw)
    except ValidationError as problem:
        raise first_finding(problem, model, where, error) from None


def first_finding(problem: ValidationError, schema: Any, where: str, error: type[InputError]) -> InputError:
    """The first of pydantic's findings as one of our errors: file, key, expected, found.

    Args:
        problem: what pydantic raised.
        schema: the model or dataclass that it validated, for the keys and lengths that it knows.
        where: the file, or whatever was validated.
        error: class of the error.
    """
    key, expected, found = _first(problem, schema)
    return _as_error(error, f"{where}: {key}" if key else where, expected, found)


def finding_of_option(problem: ValidationError, group: str, error: type[InputError]) -> InputError:
    """The same for command-line options.

    Args:
        problem: of one group of settings.
        group: dotted name of the group, empty for the options that are in none.
        error: class of the error.
    """
    key, expected, found = _first(problem, None)
    option = ".".join(part for part in (group, key) if part).replace("_", "-")
    return _as_error(error, f"--{option}", expected, found)


def _as_error(error: type[InputError], where: str, expected: str | None, found: str) -> InputError:
    return error(found, where=where) if expected is None else error(where=where, expected=expected, found=found)


def _first(problem: ValidationError, schema: Any) -> tuple[str, str | None, str]:
    """The first finding: its dotted key, what was expected, and what was found and how many more there are."""
    # An unknown key first: a misspelt one is also reported as missing, which helps less.
    findings = sorted(problem.errors(), key=lambda finding: finding["type"] not in _UNKNOWN_KEY)
    finding, more = findings[0], len(findings) - 1
    # pydantic marks a bad key of a mapping with a last part "[key]", and members of a union by their type.
    loc = tuple(
        part for part in finding["loc"] if part != "[key]" and not str(part).startswith(("tuple[", "function-"))
    )
    if finding["type"] == "missing" and loc and isinstance(loc[-1], int):  # an entry of a list of a fixed length
        loc, finding = loc[:-1], finding | {"type": "too_short"}
    expected, found = _expected_and_found(finding, loc, _Keys(schema))
    return ".".join(str(part) for part in loc), expected, f"{found} (and {more} more)" if more else found


def _expected_and_found(finding: Any, loc: tuple[int | str, ...], keys: "_Keys") -> tuple[str | None, str]:
    """What was expected and what was found; None and a whole sentence where a check of ours says both."""
    kind, context, found = finding["type"], finding.get("ctx") or {}, _short(finding["input"])
    if kind in _UNKNOWN_KEY:
        known = sorted(keys.at(loc[:-1]))
        near = difflib.get_close_matches(str(loc[-1]), known, n=1)
        hint = f" (did you mean {near[0]}?)" if near else f" (known: {', '.join(known)})" if known else ""
        return "a known key", f"an unknown one{hint}"
    if kind == "missing":
        return "this key", "nothing"
    if kind == "value_error":
        text = str(context.get("error", ""))
        return (None, text) if "expected " in text or text.startswith("looks ") else (text, found)
    if kind in _LENGTHS:
        name, words = _LENGTHS[kind]
        exact = keys.length(loc)
        return (words.format(_entries(context.get(name, "?"))) if exact is None else _entries(exact)), found
    if kind in _BOUNDS:
        name, words = _BOUNDS[kind]
        bound = context[name]
        return words.format(f"{bound:g}" if isinstance(bound, float) else bound), found
    return _EXPECTED.get(kind, "another value"), found


def _entries(count: Any) -> str:
    return "1 entry" if count == 1 else f"{count} entries"


def _short(value: Any) -> str:
    text = "null" if value is None else repr(value)
    return text if len(text) <= 60 else f"{text[:57]}..."


class _Keys:
    """Keys and lengths that a model or dataclass accepts, from its JSON schema; nothing is known without one."""

    def __init__(self, schema: Any) -> None:
        self._root: dict[str, Any] = {} if schema is None else TypeAdapter(schema).json_schema()

    def at(self, loc: tuple[int | str, ...]) -> set[str]:
        """Keys that are known at a place."""
        return {key for node in self._nodes(loc) for key in node.get("properties", {})}

    def length(self, loc: tuple[int | str, ...]) -> int | None:
        """Length of the list at a place, where it can have only one."""
        lists = [node for node in self._nodes(loc) if node.get("type") == "array"]
        lengths = {node.get(key) for node in lists for key in ("minItems", "maxItems")}
        return lengths.pop() if len(lengths) == 1 else None

    def _nodes(self, loc: tuple[int | str, ...]) -> list[dict[str, Any]]:
        """What may stand at a place: more than one schema for a union."""
        nodes = self._options(self._root)
        for part in loc:
            nodes = [option for node in nodes for option in self._options(_child(node, part))]
        return nodes

    def _options(self, node: dict[str, Any]) -> list[dict[str, Any]]:
        if "$ref" in node:
            return self._options(self._root["$defs"][node["$ref"].rpartition("/")[2]])
        return [option for each in node["anyOf"] for option in self._options(each)] if "anyOf" in node else [node]


def _child(node: dict[str, Any], part: int | str) -> dict[str, Any]:
    """Schema of an entry of a list, or of a key; empty where nothing is said of it."""
    if isinstance(part, int):
        fixed = node.get("prefixItems", ())
        child = fixed[part] if part < len(fixed) else node.get("items", {})
    else:
        any_key = [*node.get("patternProperties", {}).values(), node.get("additionalProperties", {})]
        child = node.get("properties", {}).get(part, any_key[0])
    return child if isinstance(child, dict) else {}
