"""Image motion of a moving camera, from corners."""

from __future__ import annotations

import math
from collections import deque

import cv2
import numpy as np
import numpy.typing as npt

from protocols.geometry.types import Floats

Image = npt.NDArray[np.uint8]
_SPREAD_CELLS = 4  # cells per side of the image over which inlier corners must be spread to be the camera's motion
_CORNERS = 400
_TRAVEL_WIDTH = 320  # px: larger images are downscaled to this width
_STATIC_PX, _STATIC_SHARE = 0.3, 0.4  # px; share of corners without motion at which the camera does not move
_TRAVEL_PERIOD_S, _TRAVEL_WINDOW_S = 0.4, 2.0  # time between images that are compared, and over which motion adds up
_MAX_TRAVEL = 0.02
"""Over the image width: larger motion within the window is a moving camera; hands shake by 1 %."""


class ImageMotion:
    """Motion between consecutive images.

    motion: (3, 3) homography from the last image to this one; None = not known. shift: median motion of the corners
    [px]. travel: the same as a vector (2,).
    """

    def __init__(self) -> None:
        self._last: Image | None = None
        self.motion: Floats | None = np.eye(3)
        self.shift = 0.0
        self.travel: Floats = np.zeros(2)

    def estimate(self, image: Image) -> None:
        """Estimate the motion since the last image (H, W, 3) BGR."""
        grey = np.asarray(cv2.cvtColor(image, cv2.COLOR_BGR2GRAY), dtype=np.uint8)
        if self._last is not None and self._last.shape == grey.shape:
            self.motion = self._homography(self._last, grey)
        self._last = grey

    def _homography(self, last: Image, grey: Image) -> Floats | None:
        self.shift, self.travel = 0.0, np.zeros(2)
        corners = cv2.goodFeaturesToTrack(last, _CORNERS, 0.01, max(grey.shape[1] // 50, 6))
        if corners is None or len(corners) < 12:
            return np.eye(3)  # without corners, a bare wall, no motion is observable
        corners = np.asarray(corners, dtype=np.float32).reshape(-1, 1, 2)
        guess = corners.copy()
        moved, good, _ = cv2.calcOpticalFlowPyrLK(last, grey, corners, guess, winSize=(17, 17), maxLevel=3)
        kept = good.ravel() == 1
        before, after = corners[kept].reshape(-1, 2), np.asarray(moved)[kept].reshape(-1, 2)
        if len(before) < 12:
            self.shift = math.nan
            return None
        if np.mean(np.linalg.norm(after - before, axis=1) < _STATIC_PX) > _STATIC_SHARE:
            return np.eye(3)  # others are moving objects, or noise
        motion, inliers = cv2.findHomography(before, after, cv2.RANSAC, 1.0)
        if motion is None or inliers is None or inliers.sum() < max(10, 0.3 * len(before)):
            self.shift = math.nan
            return None
        own = inliers.ravel() == 1
        cells = np.unique(
            (before[own] * _SPREAD_CELLS / np.array(grey.shape[::-1])).astype(int) @ np.array([1, _SPREAD_CELLS])
        )
        if len(cells) < 0.4 * _SPREAD_CELLS**2:
            return np.eye(3)  # the corners of one object are not the camera's motion
        self.shift = float(np.median(np.linalg.norm(after[own] - before[own], axis=1)))
        self.travel = np.asarray(np.median(after[own] - before[own], axis=0), dtype=np.float64)
        return np.asarray(motion, dtype=np.float64)


class CameraTravel:
    """Decides from a camera's images whether it moves: pans, drives or flies, in contrast to shaking in place.

    share: of the time in which it moved, 0..1.
    """

    def __init__(self) -> None:
        self._motion = ImageMotion()
        self._places: deque[tuple[float, Floats]] = deque()
        self._samples = self._moved = 0

    @property
    def share(self) -> float:
        return self._moved / max(self._samples, 1)

    def moves(self, image: Image, now: float) -> bool:
        """Whether the camera moves in an image (H, W, 3) BGR at a time [s]."""
        if self._places and 0.0 <= now - self._places[-1][0] < _TRAVEL_PERIOD_S:
            return self._is_away()
        if self._places and not 0.0 <= now - self._places[-1][0] < _TRAVEL_WINDOW_S:
            self.__init__()  # type: ignore[misc]
        size = _TRAVEL_WIDTH, max(round(_TRAVEL_WIDTH * image.shape[0] / image.shape[1]), 1)
        self._motion.estimate(np.asarray(cv2.resize(image, size, interpolation=cv2.INTER_AREA), dtype=np.uint8))
        place = self._places[-1][1] if self._places else np.zeros(2)
        self._places.append((now, place + self._motion.travel))
        while now - self._places[0][0] > _TRAVEL_WINDOW_S:
            self._places.popleft()
        away = self._is_away()
        self._samples += 1
        self._moved += away
        return away

    def _is_away(self) -> bool:
        places = np.array([place for _, place in self._places])
        return bool(np.linalg.norm(places - places[-1], axis=1).max() > _MAX_TRAVEL * _TRAVEL_WIDTH)
