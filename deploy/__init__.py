"""The `syncline` command and its processes. The names for a notebook are imported on first access."""

from __future__ import annotations

from importlib import import_module

TYPE_CHECKING = False  # as typing's, whose import alone would take most of the package's import time
if TYPE_CHECKING:
    from typing import Any

    from deploy.cli import run
    from deploy.offline.video_folder import session_from_videos
    from deploy.simulation.session import write_simulated_session

__all__ = ["run", "session_from_videos", "write_simulated_session"]

_MODULES = {
    "run": "deploy.cli",
    "session_from_videos": "deploy.offline.video_folder",
    "write_simulated_session": "deploy.simulation.session",
}


def __getattr__(name: str) -> Any:
    if name not in _MODULES:
        raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
    value = globals()[name] = getattr(import_module(_MODULES[name]), name)
    return value


def __dir__() -> list[str]:
    return sorted({*globals(), *__all__})
