"""report.html: one offline page with the quality assessment of a calibration and the data behind it."""

from hub.report.page import build_report

__all__ = ["build_report"]
