"""Cameras, detectors and agents at the cameras. The names for use in a notebook are imported on first access."""

from protocols.core.lazy import lazy_names

TYPE_CHECKING = False  # as typing's, whose import alone would take most of the package's import time
if TYPE_CHECKING:
    from edge.detectors.base import Detection, Detector, DetectorOptions
    from edge.detectors.plugins import load_detector
    from edge.devices.base import Frame
    from edge.devices.camera import open_camera
    from edge.offline.video import detect_video

__all__ = ["Detection", "Detector", "DetectorOptions", "Frame", "detect_video", "load_detector", "open_camera"]

__getattr__, __dir__ = lazy_names(
    __name__,
    {
        "edge.detectors.base": ["Detection", "Detector", "DetectorOptions"],
        "edge.detectors.plugins": ["load_detector"],
        "edge.devices.base": ["Frame"],
        "edge.devices.camera": ["open_camera"],
        "edge.offline.video": ["detect_video"],
    },
)
