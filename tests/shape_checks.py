"""Every call into the package is checked against its signature (jaxtyping, beartype), once a combination of shapes.

Whether a call passes depends on nothing but the types, dtypes and shapes that it is given and gives back (and on texts,
for `Literal`). What has passed once passes again, so that only new combinations are looked at: the same checks, at a
fraction of the time.
"""

import importlib
import threading
from collections.abc import Callable
from dataclasses import is_dataclass
from enum import Enum
from functools import cached_property, partial, update_wrapper, wraps
from types import CodeType, FunctionType
from typing import Any

import jaxtyping
import numpy as np
import torch

LONGEST = 16
"""Calls with longer collections are checked each time: beartype looks at one entry, drawn at random."""
LIBRARIES = ("kornia", "matplotlib.pyplot", "pydantic.dataclasses", "rich.progress", "scipy.stats")
"""Imported beforehand: while jaxtyping's hook imports a module, Python finds no compiled file of what that imports."""
TENSORS, ONE_BY_ONE = (torch.Tensor, np.ndarray), (str, bool, Enum, type)
COLLECTIONS = (tuple, list, set, frozenset, dict)

_jaxtyped = jaxtyping.jaxtyped
_thread = threading.local()


def check_calls_into(package: str) -> None:
    """Check the functions of a package that is not imported yet."""
    for name in LIBRARIES:
        importlib.import_module(name)
    jaxtyping.install_import_hook(package, "beartype.beartype")
    jaxtyping.jaxtyped = once_a_shape  # the name that the hook decorates functions with


class _Signature:
    """The checks of one `def`, shared by all functions that it makes, as closures are."""

    def __init__(self, function: FunctionType, typechecker: Callable) -> None:
        self._function = function
        self._typechecker = typechecker
        self.passed: dict[tuple, set] = {}

    @cached_property
    def _checked(self) -> Callable:
        """A function of the same signature that does what `_thread.body` says."""

        def relay(*args: Any, **kwargs: Any) -> Any:
            return _thread.body(*args, **kwargs)

        same_names = FunctionType(relay.__code__, self._function.__globals__ | {"_thread": _thread})
        return _jaxtyped(update_wrapper(same_names, self._function), typechecker=self._typechecker)

    def check(self, body: Callable, args: tuple, kwargs: dict) -> Any:
        _thread.body = body
        return self._checked(*args, **kwargs)


_signatures: dict[CodeType, _Signature] = {}


def once_a_shape(function: Any = None, *, typechecker: Callable) -> Any:
    """Like `jaxtyping.jaxtyped`."""
    if function is None:
        return partial(once_a_shape, typechecker=typechecker)
    if (
        isinstance(function, type)
        and is_dataclass(function)
        and isinstance(vars(function).get("__init__"), FunctionType)
    ):
        # Equal fields make equal code, whatever their types: no two classes share a signature.
        function.__init__ = _checked_once(function.__init__, _Signature(function.__init__, typechecker))
        return function
    if not isinstance(function, FunctionType):
        return _jaxtyped(function, typechecker=typechecker)
    if function.__code__ not in _signatures:
        _signatures[function.__code__] = _Signature(function, typechecker)
    return _checked_once(function, _signatures[function.__code__])


def _checked_once(function: FunctionType, signature: _Signature) -> Callable:
    passed = signature.passed

    @wraps(function)
    def checked(*args: Any, **kwargs: Any) -> Any:
        __tracebackhide__ = True
        given = _key(args, kwargs)
        if given not in passed:
            answer = signature.check(function, args, kwargs)
            if given is not None:
                passed[given] = {_key((answer,), {})} - {None}
            return answer
        answer = function(*args, **kwargs)
        got = _key((answer,), {})
        if got not in passed[given]:
            signature.check(lambda *_, **__: answer, args, kwargs)
            if got is not None:
                passed[given].add(got)
        return answer

    return checked


def _key(args: tuple, kwargs: dict) -> tuple | None:
    """All that the check of these values depends on; None if that cannot be told."""
    try:
        key = tuple([_kind(value) for value in args])
        return key + tuple([(name, _kind(value)) for name, value in kwargs.items()]) if kwargs else key
    except (_Unknown, RecursionError):  # a list of a damaged YAML file may hold itself
        return None


class _Unknown(Exception):
    """A value that no key describes."""


_told_by_type: set[type] = {int, float, complex, type(None)}
"""Types whose values a check does not look into; those of the package join them as they are met."""


def _kind(value: Any) -> Any:
    kind = type(value)
    if kind is torch.Tensor:  # by far the most
        return value.dtype, value.shape
    if kind in _told_by_type:
        return kind
    if isinstance(value, TENSORS):
        return kind, value.dtype, tuple(value.shape)
    if isinstance(value, ONE_BY_ONE):
        return kind, value
    if isinstance(value, COLLECTIONS):
        if len(value) > LONGEST:
            raise _Unknown
        items = value.items() if isinstance(value, dict) else value
        return kind, tuple([_kind(item) for item in items])
    _told_by_type.add(kind)
    return kind
