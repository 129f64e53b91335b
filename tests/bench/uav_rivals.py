"""OpenCV's CSRT, KCF and MOSSE behind the tracker interface. They need opencv-contrib, which only the benches use.

opencv-contrib-python-headless and opencv-python-headless are both ``cv2`` and can't share an environment: ``python -m
tests.bench.peers`` puts the former into a folder of its own, which has to be first on the path.
"""

from __future__ import annotations

import math
import os
import sys
from collections.abc import Iterable
from typing import Any

import cv2

from edge.uav.base import Box, Estimate, Telemetry, TrackState
from protocols.geometry.types import Image
from tests.bench.peers import CONTRIB

NAMES = ("csrt", "kcf", "mosse")


def available(name: str) -> bool:
    """Whether this OpenCV has the tracker."""
    return _maker(name) is not None


def _maker(name: str) -> Any:
    title = f"Tracker{name.upper()}_create"
    return getattr(cv2, title, None) or getattr(getattr(cv2, "legacy", None), title, None)


def restart_with_contrib(module: str, names: Iterable[str]) -> None:
    """Start ``module`` again with opencv-contrib first on the path, if it is there, wanted and not used yet."""
    wanted = any(name in NAMES and not available(name) for name in names)
    if wanted and CONTRIB.is_dir() and str(CONTRIB) not in sys.path:
        path = os.pathsep.join([str(CONTRIB), *os.environ.get("PYTHONPATH", "").split(os.pathsep)]).rstrip(os.pathsep)
        os.execve(sys.executable, [sys.executable, "-m", module, *sys.argv[1:]], {**os.environ, "PYTHONPATH": path})


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
