"""Observations of many cameras in, clocks, poses and tracks out. The names for a notebook are imported when used."""

from __future__ import annotations

from importlib import import_module

TYPE_CHECKING = False  # as typing's, whose import alone would take most of the package's import time
if TYPE_CHECKING:
    from typing import Any

    from hub.api import CalibrationOptions, CalibrationResult, TriangulationResult, calibrate, triangulate
    from hub.report import build_report

__all__ = [
    "CalibrationOptions",
    "CalibrationResult",
    "TriangulationResult",
    "build_report",
    "calibrate",
    "triangulate",
]


def __getattr__(name: str) -> Any:
    if name not in __all__:
        raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
    value = globals()[name] = getattr(import_module("hub.report" if name == "build_report" else "hub.api"), name)
    return value


def __dir__() -> list[str]:
    return sorted({*globals(), *__all__})
