"""Lazy names of a package (PEP 562): importing the package costs little, a name is imported when it is used."""

from __future__ import annotations

from importlib import import_module

TYPE_CHECKING = False  # as typing's, whose import alone would take most of a package's import time
if TYPE_CHECKING:
    from collections.abc import Callable, Mapping
    from typing import Any


def lazy_names(package: str, modules: Mapping[str, str]) -> tuple[Callable[[str], Any], Callable[[], list[str]]]:
    """``__getattr__`` and ``__dir__`` of a package. modules: by name, the dotted module that defines it."""

    def get(name: str) -> Any:
        if name not in modules:
            raise AttributeError(f"module {package!r} has no attribute {name!r}")
        return getattr(import_module(modules[name]), name)

    return get, lambda: sorted(modules)
