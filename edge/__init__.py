"""Cameras, detectors and agents at the cameras. The names for use in a notebook are imported on first access."""

from __future__ import annotations

from importlib import import_module

TYPE_CHECKING = False  # as typing's, whose import alone would take most of the package's import time
if TYPE_CHECKING:
    from typing import Any

    from edge.detectors.base import Detection
    from edge.devices.base import Frame
    from edge.devices.camera import open_camera
    from edge.offline.video import detect_video

__all__ = ["Detection", "Frame", "detect_video", "open_camera"]

# Importing the package must cost neither numpy nor OpenCV: agents and commands start without them.
_MODULES = {
    "Detection": "edge.detectors.base",
    "Frame": "edge.devices.base",
    "detect_video": "edge.offline.video",
    "open_camera": "edge.devices.camera",
}


def __getattr__(name: str) -> Any:
    if name not in _MODULES:
        raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
    value = globals()[name] = getattr(import_module(_MODULES[name]), name)
    return value


def __dir__() -> list[str]:
    return sorted({*globals(), *__all__})
