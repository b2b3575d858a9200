"""Dataclasses of tensors: the axes that their annotations tell, and one function for all tensors in them."""

from collections.abc import Callable, Iterator
from dataclasses import fields, is_dataclass, replace
from functools import cache
from typing import Any, get_args

from torch import Tensor


def spans(count: int, at_once: int) -> Iterator[slice]:
    """Slices of at most `at_once` (1 or more) that make up `count`, in order: what keeps memory bounded."""
    at_once = max(1, at_once)
    for start in range(0, count, at_once):
        yield slice(start, min(start + at_once, count))


def chunks(trials: int, motions: int, chunk: int) -> Iterator[tuple[slice, list[slice]]]:
    """Slices of trials, each with the slices of motions, that hold `chunk` motions (times trials) or fewer."""
    along = list(spans(motions, chunk))
    for part in spans(trials, chunk // max(1, min(motions, chunk))):
        yield part, along


@cache
def axes_of(kind: type) -> dict[str, tuple[str, ...]]:
    """Names of the axes of every tensor of a dataclass, without those of the trials (`*batch`), as its annotation has
    them; fields of other types are left out."""
    axes = {}
    for field in fields(kind):
        for annotation in (field.type, *get_args(field.type)):
            names = getattr(annotation, "dim_str", None)
            if names is not None:
                axes[field.name] = tuple(name for name in names.split() if name != "*batch")
    return axes


def map_tensors(value: Any, function: Callable[[Tensor], Tensor]) -> Any:
    """The value with the function applied to every tensor in it, however deep."""
    if isinstance(value, Tensor):
        return function(value)
    if isinstance(value, dict):
        return {key: map_tensors(item, function) for key, item in value.items()}
    if isinstance(value, tuple):
        items = (map_tensors(item, function) for item in value)
        return type(value)(*items) if hasattr(value, "_fields") else tuple(items)  # a named tuple stays one
    if is_dataclass(value) and not isinstance(value, type):
        return replace(
            value, **{field.name: map_tensors(getattr(value, field.name), function) for field in fields(value)}
        )
    return value
