"""Image motion of a moving camera, from corners."""

from __future__ import annotations

import math
from collections import deque

import cv2
import numpy as np
import numpy.typing as npt

from protocols.geometry.types import Floats, Image

_SPREAD_CELLS, _MIN_SPREAD = 4, 0.4
"""Cells per side of the image, and share of the cells in which corners must agree to show the camera's motion."""
_CORNERS, _MIN_CORNERS = 400, 12  # tracked at most, at least
_TRAVEL_WIDTH = 240  # px: larger images are downscaled to this width
_STATIC_PX, _ALIKE_PX, _STATIC_SHARE = 0.5, 1.5, 0.3
"""Motion of a cell that is none, and difference of two that agree [px]; share of cells without motion at which the
camera has none.
"""
_TRAVEL_PERIOD_S, _TRAVEL_WINDOW_S = 0.5, 2.0  # time between images that are compared, and over which motion adds up
_MAX_TRAVEL = 0.02
"""Over the image width: larger motion within the window is a moving camera; hands shake by 1 %."""


class ImageMotion:
    """Motion between consecutive images.

    motion: (3, 3) homography from the last image to this one; None = not known. shift: median motion of the corners
    [px].
    """

    def __init__(self) -> None:
        self._last: Image | None = None
        self.motion: Floats | None = np.eye(3)
        self.shift = 0.0

    def estimate(self, image: Image) -> None:
        """Estimate the motion since the last image (H, W, 3) BGR."""
        grey = np.asarray(cv2.cvtColor(image, cv2.COLOR_BGR2GRAY), dtype=np.uint8)
        if self._last is not None and self._last.shape == grey.shape:
            self.motion = self._homography(self._last, grey)
        self._last = grey

    def _homography(self, last: Image, grey: Image) -> Floats | None:
        self.shift = 0.0
        tracked = _tracked_corners(last, grey)
        if tracked is None:
            return np.eye(3)  # without corners, a bare wall, no motion is observable
        before, after = tracked
        if len(before) < _MIN_CORNERS:
            self.shift = math.nan
            return None
        motion, inliers = cv2.findHomography(before, after, cv2.RANSAC, 1.0)
        if motion is None or inliers is None or inliers.sum() < max(10, 0.3 * len(before)):
            self.shift = math.nan
            return None
        own = inliers.ravel() == 1
        if len(np.unique(_cells(before[own], grey.shape))) < _MIN_SPREAD * _SPREAD_CELLS**2:
            return np.eye(3)  # the corners of one object are not the camera's motion
        self.shift = float(np.median(np.linalg.norm(after[own] - before[own], axis=1)))
        return np.asarray(motion, dtype=np.float64)


def _tracked_corners(last: Image, grey: Image) -> tuple[Floats, Floats] | None:
    """Corners (n, 2) [px] of the last image (H, W), and their places (n, 2) in this one; None without corners."""
    corners = cv2.goodFeaturesToTrack(last, _CORNERS, 0.01, max(grey.shape[1] // 50, 6))
    if corners is None or len(corners) < _MIN_CORNERS:
        return None
    corners = np.asarray(corners, dtype=np.float32).reshape(-1, 1, 2)
    guess = corners.copy()
    moved, good, _ = cv2.calcOpticalFlowPyrLK(last, grey, corners, guess, winSize=(17, 17), maxLevel=3)
    kept = good.ravel() == 1
    return corners[kept].reshape(-1, 2), np.asarray(moved)[kept].reshape(-1, 2)


def _cells(corners: Floats, shape: tuple[int, ...]) -> npt.NDArray[np.intp]:
    """The cell (n,) of an image (H, W) in which each corner (n, 2) [px] is."""
    at = (corners * _SPREAD_CELLS / np.array(shape[1::-1])).astype(np.intp)
    return np.asarray(at @ np.array([1, _SPREAD_CELLS]), dtype=np.intp)


class CameraTravel:
    """Decides from a camera's images whether it moves: pans, drives or flies, in contrast to shaking in place."""

    def __init__(self) -> None:
        self._last: Image | None = None
        self._places: deque[tuple[float, Floats]] = deque()
        self._samples = self._moved = 0

    @property
    def share(self) -> float:
        """Share (0..1) of the time in which it moved."""
        return self._moved / max(self._samples, 1)

    def moves(self, image: Image, now: float) -> bool:
        """Whether the camera moves in an image (H, W, 3) BGR at a time [s]."""
        since = now - self._places[-1][0] if self._places else math.inf
        if 0.0 <= since < _TRAVEL_PERIOD_S:
            return self._is_away()
        if not 0.0 <= since < _TRAVEL_WINDOW_S:
            self._places.clear()
        size = _TRAVEL_WIDTH, max(round(_TRAVEL_WIDTH * image.shape[0] / image.shape[1]), 1)
        small = cv2.resize(cv2.cvtColor(image, cv2.COLOR_BGR2GRAY), size, interpolation=cv2.INTER_AREA)
        grey = np.asarray(small, dtype=np.uint8)
        step = self._step(grey) if self._places else np.zeros(2)
        self._last = grey
        self._places.append((now, self._places[-1][1] + step if self._places else step))
        while now - self._places[0][0] > _TRAVEL_WINDOW_S:
            self._places.popleft()
        away = self._is_away()
        self._samples += 1
        self._moved += away
        return away

    def _step(self, grey: Image) -> Floats:
        """Motion (2,) [px] since the last image (H, W) that corners all over the image have in common.

        No homography: noise makes its search slow.
        """
        assert self._last is not None
        tracked = _tracked_corners(self._last, grey) if self._last.shape == grey.shape else None
        if tracked is None or len(tracked[0]) < _MIN_CORNERS:
            return np.zeros(2)
        cells = _cells(tracked[0], grey.shape)
        moved = np.array([np.median((tracked[1] - tracked[0])[cells == one], axis=0) for one in np.unique(cells)])
        step = np.median(moved, axis=0)
        alike = int(np.sum(np.linalg.norm(moved - step, axis=1) < _ALIKE_PX))
        if (
            alike < _MIN_SPREAD * _SPREAD_CELLS**2
            or np.mean(np.linalg.norm(moved, axis=1) < _STATIC_PX) > _STATIC_SHARE
        ):
            return np.zeros(2)  # moving objects, or noise
        return np.asarray(step, dtype=np.float64)

    def _is_away(self) -> bool:
        places = np.array([place for _, place in self._places])
        return bool(np.linalg.norm(places - places[-1], axis=1).max() > _MAX_TRAVEL * _TRAVEL_WIDTH)
