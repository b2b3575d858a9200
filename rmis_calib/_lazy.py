"""Lazy re-exports, so that importing the package (and `--help`) does not import torch."""

from collections.abc import Callable
from importlib import import_module
from typing import Any


def lazy_exports(
    package: str, names: dict[str, str]
) -> tuple[Callable[[str], Any], Callable[[], list[str]], list[str]]:
    """`__getattr__`, `__dir__` and `__all__` for a package whose public names load on first use (PEP 562).

    Args:
        package: `__name__` of the package.
        names: public name -> relative module that defines it, e.g. `{"Camera": ".cameras"}`.
    """

    def __getattr__(name: str) -> Any:
        if name not in names:
            raise AttributeError(f"module {package!r} has no attribute {name!r}")
        return getattr(import_module(names[name], package), name)

    return __getattr__, lambda: sorted(names), sorted(names)
