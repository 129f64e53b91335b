"""Lazy names of a package (PEP 562) and lazy modules: importing costs little, what is used is loaded then."""

from __future__ import annotations

import sys
from importlib import import_module
from importlib.util import LazyLoader, find_spec, module_from_spec

TYPE_CHECKING = False  # as typing's, whose import alone would take most of a package's import time
if TYPE_CHECKING:
    from collections.abc import Callable, Mapping, Sequence
    from typing import Any


def lazy_names(
    package: str, names_of: Mapping[str, Sequence[str]]
) -> tuple[Callable[[str], Any], Callable[[], list[str]]]:
    """``__getattr__`` and ``__dir__`` of a package. names_of: by dotted module, the names that it defines."""
    modules = {name: module for module, names in names_of.items() for name in names}

    def get(name: str) -> Any:
        if name not in modules:
            raise AttributeError(f"module {package!r} has no attribute {name!r}")
        return getattr(import_module(modules[name]), name)

    return get, lambda: sorted(modules)


def defer_modules(package: str, names: Sequence[str]) -> None:
    """Submodules of a package are loaded when something of theirs is used, not when somebody imports them.

    names: those that are loaded already are left alone. scipy imports everything that numpy has, f2py, its tests and
    masked arrays too, which takes a third of scipy's own import time.
    """
    parent = import_module(package)
    for name in names:
        full = f"{package}.{name}"
        spec = None if full in sys.modules else find_spec(full)
        if spec is None or spec.loader is None:
            continue
        spec.loader = LazyLoader(spec.loader)
        module = module_from_spec(spec)
        sys.modules[full] = module
        spec.loader.exec_module(module)
        setattr(parent, name, module)
