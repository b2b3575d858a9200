"""pydantic's findings as our one-line errors: file, key path, expected, found, and the nearest known key."""

from typing import Annotated, Any, TypeVar, get_args, get_origin

from pydantic import BaseModel, ValidationError

from rmis_calib.errors import InputError
from rmis_calib.io.configs import did_you_mean

Model = TypeVar("Model", bound=BaseModel)


def validate(model: type[Model], raw: dict[str, Any], where: str, error: type[InputError]) -> Model:
    """`raw` as a `model`.

    Raises:
        error: the first entry that is missing, unknown or impossible; says how many more there are.
    """
    try:
        return model.model_validate(raw)
    except ValidationError as problem:
        # An unknown key first: a misspelt one is also reported as missing, which helps less.
        findings = sorted(problem.errors(), key=lambda finding: finding["type"] != "extra_forbidden")
        raise _finding_error(model, findings[0], len(findings) - 1, where, error) from None


def _finding_error(model: type[BaseModel], finding: Any, more: int, where: str, error: type[InputError]) -> InputError:
    loc = finding["loc"]
    # pydantic marks a bad key of a mapping with a last part "[key]".
    key = ".".join(str(part) for part in loc if part != "[key]")
    place = f"{where}: {key}" if key else where
    tail = f" (and {more} more)" if more else ""
    if finding["type"] == "extra_forbidden":
        known = sorted(_known_keys(model, loc[:-1]))
        hint = did_you_mean(str(loc[-1]), known) or f" (known: {', '.join(known)})"
        return error(where=place, expected="a known key", found=f"an unknown one{hint}{tail}")
    if finding["type"] == "missing":
        return error(where=place, expected="this key", found=f"nothing{tail}")
    if finding["type"] == "value_error":
        return error(f"{finding['ctx']['error']}{tail}", where=place)
    expected = finding["msg"].removeprefix("Input should be ").removeprefix("Input should ")
    return error(where=place, expected=expected, found=f"{_short(finding['input'])}{tail}")


def _short(value: Any) -> str:
    text = "null" if value is None else repr(value)
    return text if len(text) <= 60 else f"{text[:57]}..."


def _known_keys(model: type[BaseModel], loc: tuple[int | str, ...]) -> set[str]:
    """Keys that the model reached by `loc` accepts."""
    node: Any = model
    for part in loc:
        node = node.model_fields[str(part)].annotation if _is_model(node) else _item_type(node)
        node = _unwrap(node)
    return set(node.model_fields) if _is_model(node) else set()


def _is_model(node: Any) -> bool:
    return isinstance(node, type) and issubclass(node, BaseModel)


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
