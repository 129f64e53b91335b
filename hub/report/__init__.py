"""report.html: one offline page that says what a calibration is worth, and shows why."""

from hub.report.page import build_report

__all__ = ["build_report"]
