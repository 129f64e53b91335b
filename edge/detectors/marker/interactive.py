"""Ball detector whose marker model is replaced while it runs, learnt from a point in the image."""

from __future__ import annotations

from collections.abc import Sequence

import cv2
import numpy as np
import numpy.typing as npt

from edge.detectors.base import Detection, Prediction
from edge.detectors.marker.ball import MarkerDetector, MarkerModel, learn_marker_model
from protocols.core.errors import InputError
from protocols.geometry.camera import Intrinsics

_FLOOD_TOLERANCE = (26, 18, 18)  # tolerance of the flood fill in CIE L*a*b* (0..255): light and shade of a ball
_MAX_SHARE = 0.15  # share of the image: larger regions are walls
_MIN_PIXELS = 9  # pixels


class InteractiveMarkerDetector:
    """A ball detector whose marker model may be replaced from another thread between two images."""

    def __init__(self, intrinsics: Intrinsics | None = None, model: MarkerModel | None = None) -> None:
        self._intrinsics = intrinsics
        self._detector = MarkerDetector(model, intrinsics)

    def set_model(self, model: MarkerModel) -> None:
        """Detect this marker from the next image on."""
        self._detector = MarkerDetector(model, self._intrinsics)

    def detect(
        self, image: npt.NDArray[np.uint8], time_s: float | None = None, predictions: Sequence[Prediction] = ()
    ) -> list[Detection]:
        """Detections in an image (H, W, 3) uint8 BGR."""
        return self._detector.detect(image)


def learn_marker_at(image: npt.NDArray[np.uint8], u: float, v: float) -> tuple[MarkerModel, tuple[int, int, int, int]]:
    """Learn a model of the object at a point (u, v) [px] of an image (H, W, 3) BGR, and its box (x, y, w, h).

    The region of about one colour around the point is taken for the marker. Raises InputError where that is no separate
    region: a wall, or single pixels.
    """
    height, width = image.shape[:2]
    column, row = round(u), round(v)
    if not (0 <= column < width and 0 <= row < height):
        raise InputError("that is not in the picture", remedy="click on the ball")
    smooth = cv2.cvtColor(cv2.medianBlur(image, 5), cv2.COLOR_BGR2LAB)
    mask = np.zeros((height + 2, width + 2), dtype=np.uint8)
    flags = 8 | cv2.FLOODFILL_MASK_ONLY | cv2.FLOODFILL_FIXED_RANGE | (1 << 8)
    count, _, _, (x, y, w, h) = cv2.floodFill(
        smooth, mask, (column, row), (0, 0, 0), _FLOOD_TOLERANCE, _FLOOD_TOLERANCE, flags
    )
    if not _MIN_PIXELS <= count <= _MAX_SHARE * width * height:
        what = "too small" if count < _MIN_PIXELS else "as large as a wall"
        remedy = "click on the middle of the ball, with some background of another colour around it"
        raise InputError(f"what is there is {what} ({count} pixels of one colour)", remedy=remedy)
    left, top = max(x - 1, 0), max(y - 1, 0)
    box = (left, top, min(w + 2, width - left), min(h + 2, height - top))
    return learn_marker_model(image, box), box
