"""What the detectors of people and of vehicles share: the background, the working size, the clock, the tracks."""

from __future__ import annotations

import math

import cv2
import numpy as np

from edge.detectors.moving.foreground import BackgroundSubtractor, SubtractorName
from edge.detectors.moving.tracklets import ShortTermTracker
from protocols.geometry.types import Image


class SilhouetteDetector:
    """Silhouettes before a background in images reduced to ``max_pixels``, and tracks of them.

    min_displacement: over its size, by which a track must have moved.
    """

    def __init__(
        self,
        model: SubtractorName,
        fps: float,
        prefix: str,
        min_displacement: float,
        confirmed_only: bool,
        max_pixels: int,
    ) -> None:
        self._fps = fps if fps > 0 and math.isfinite(fps) else 25.0
        self._model: SubtractorName = model
        self._foreground = BackgroundSubtractor(model, self._fps)
        self._tracker = ShortTermTracker(prefix, min_displacement=min_displacement)
        self._confirmed_only, self._max_pixels = confirmed_only, max_pixels
        self._size, self._scale, self._time = (0, 0), 1.0, -1.0
        self._confirmed: set[str] = set()

    @property
    def resets(self) -> int:
        """How often the background model was reset because the camera was moved or the light changed suddenly."""
        return self._foreground.resets

    def is_confirmed(self, label: str) -> bool:
        """Whether the track of this label was confirmed: detected several times, and moving."""
        return label in self._confirmed

    def _resize(self, image: Image) -> bool:
        """Take the size of the images; whether it is another one, which ends all tracks."""
        size = image.shape[1], image.shape[0]
        if size == self._size:
            return False
        self._size, self._scale = size, min(1.0, math.sqrt(self._max_pixels / (size[0] * size[1])))
        self._tracker.clear()
        return True

    def _advance(self, time_s: float | None) -> float:
        """The time of the next image [s]: as given if it increases, else one frame after the last."""
        usual = self._time + 1.0 / self._fps
        self._time = usual if time_s is None or not time_s > self._time else time_s
        return self._time

    def _downscaled(self, image: Image) -> Image:
        if self._scale == 1.0:
            return image
        size = round(image.shape[1] * self._scale), round(image.shape[0] * self._scale)
        return np.asarray(cv2.resize(image, size, interpolation=cv2.INTER_AREA), dtype=np.uint8)
