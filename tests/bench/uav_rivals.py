"""OpenCV's CSRT, KCF and MOSSE behind the tracker interface. They need opencv-contrib, which only the benches use.

opencv-contrib-python-headless and opencv-python-headless are both ``cv2`` and can't share an environment. Put the
former, of the same version as the latter, into a folder of its own and that folder first on the path:

    python -m pip install --no-deps --target contrib opencv-contrib-python-headless==5.0.0.93
    PYTHONPATH=contrib python -m tests.bench.uav_tracker
"""

from __future__ import annotations

import math
from typing import Any

import cv2

from edge.uav.base import Box, Estimate, Image, Telemetry, TrackState

NAMES = ("csrt", "kcf", "mosse")


def available(name: str) -> bool:
    """Whether this OpenCV has the tracker."""
    return _maker(name) is not None


def _maker(name: str) -> Any:
    title = f"Tracker{name.upper()}_create"
    return getattr(cv2, title, None) or getattr(getattr(cv2, "legacy", None), title, None)


class OpenCvTracker:
    """One of OpenCV's trackers. It reports ``visible`` as long as OpenCV reports success, else ``lost``."""

    def __init__(self, name: str) -> None:
        self._tracker = _maker(name)()

    def begin(self, image: Image, time: float, target: Box) -> Estimate:
        box = (round(target.x), round(target.y), round(target.width), round(target.height))
        self._tracker.init(image, box)
        return _estimate(time, True, box)

    def handle_telemetry(self, sample: Telemetry) -> None:
        """Unused."""

    def handle_frame(self, image: Image | None, time: float) -> Estimate:
        if image is None:
            return _estimate(time, False, (0.0, 0.0, 0.0, 0.0))
        try:
            found, box = self._tracker.update(image)
        except cv2.error:  # a box that is entirely outside the image
            found, box = False, (0.0, 0.0, 0.0, 0.0)
        return _estimate(time, bool(found), box)


def _estimate(time: float, found: bool, box: Any) -> Estimate:
    x, y, w, h = (float(value) for value in box)
    if not found:
        x = y = w = h = math.nan
    state = TrackState.VISIBLE if found else TrackState.LOST
    return Estimate(time, state, x + (w - 1) / 2, y + (h - 1) / 2, w, h, math.nan, math.nan)
