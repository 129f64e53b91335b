"""What every process agrees on. The names for use in a notebook are imported on first access."""

from __future__ import annotations

from importlib import import_module

TYPE_CHECKING = False  # as typing's, whose import alone would take most of the package's import time
if TYPE_CHECKING:
    from typing import Any

    from protocols.core.errors import InputError, Refused, SynclineError
    from protocols.log.read.session import load_session
    from protocols.session.calibration import read_calibration
    from protocols.session.rig import read_rig
    from protocols.session.session import Session

__all__ = ["InputError", "Refused", "Session", "SynclineError", "load_session", "read_calibration", "read_rig"]

# Importing the package must not cost numpy: agents and commands start without what they do not use.
_MODULES = {
    "InputError": "protocols.core.errors",
    "Refused": "protocols.core.errors",
    "Session": "protocols.session.session",
    "SynclineError": "protocols.core.errors",
    "load_session": "protocols.log.read.session",
    "read_calibration": "protocols.session.calibration",
    "read_rig": "protocols.session.rig",
}


def __getattr__(name: str) -> Any:
    if name not in _MODULES:
        raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
    value = globals()[name] = getattr(import_module(_MODULES[name]), name)
    return value


def __dir__() -> list[str]:
    return sorted({*globals(), *__all__})
