"""Observations of many cameras in, clocks, poses and tracks out. The names for a notebook are imported when used."""

from protocols.core.lazy import lazy_names

TYPE_CHECKING = False  # as typing's, whose import alone would take most of the package's import time
if TYPE_CHECKING:
    from hub.api import CalibrationOptions, CalibrationResult, TriangulationResult, calibrate, triangulate
    from hub.report import build_report

__all__ = ["CalibrationOptions", "CalibrationResult", "TriangulationResult", "build_report", "calibrate", "triangulate"]

__getattr__, __dir__ = lazy_names(
    __name__,
    {
        "hub.api": ["CalibrationOptions", "CalibrationResult", "TriangulationResult", "calibrate", "triangulate"],
        "hub.report": ["build_report"],
    },
)
