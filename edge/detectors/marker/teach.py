"""A marker detector that is taught while it runs, by a point in the picture."""

from __future__ import annotations

from collections.abc import Sequence

import cv2
import numpy as np
import numpy.typing as npt

from edge.detectors.base import Detection, Prediction
from edge.detectors.marker.ball import MarkerDetector, MarkerModel, teach
from protocols.core.errors import InputError
from protocols.geometry.camera import Intrinsics

_SPREAD = (26, 18, 18)  # of one colour in CIE L*a*b* (0..255): light and shade of a ball
_MOST = 0.15  # of the picture: what is larger is a wall
_LEAST = 9  # pixels


class TaughtDetector:
    """A detector whose marker may be changed from another thread between two pictures."""

    def __init__(self, intrinsics: Intrinsics | None = None, model: MarkerModel | None = None) -> None:
        self._intrinsics = intrinsics
        self._detector = MarkerDetector(model, intrinsics)

    def teach(self, model: MarkerModel) -> None:
        """Look for this marker from the next picture on."""
        self._detector = MarkerDetector(model, self._intrinsics)

    def detect(
        self, image: npt.NDArray[np.uint8], time_s: float | None = None, predictions: Sequence[Prediction] = ()
    ) -> list[Detection]:
        """Detections in an image (H, W, 3) uint8 BGR."""
        return self._detector.detect(image)


def teach_at(image: npt.NDArray[np.uint8], u: float, v: float) -> tuple[MarkerModel, tuple[int, int, int, int]]:
    """A model of what is at a point (u, v) [px] of a picture (H, W, 3) BGR, and the box (x, y, w, h) it fills.

    The region of about one colour around the point is taken for the marker. Raises InputError where that is no
    region of its own: a wall, or nothing.
    """
    height, width = image.shape[:2]
    column, row = round(u), round(v)
    if not (0 <= column < width and 0 <= row < height):
        raise InputError("that is not in the picture", remedy="click on the marker")
    smooth = cv2.cvtColor(cv2.medianBlur(image, 5), cv2.COLOR_BGR2LAB)
    mask = np.zeros((height + 2, width + 2), dtype=np.uint8)
    flags = 8 | cv2.FLOODFILL_MASK_ONLY | cv2.FLOODFILL_FIXED_RANGE | (1 << 8)
    count, _, _, (x, y, w, h) = cv2.floodFill(smooth, mask, (column, row), (0, 0, 0), _SPREAD, _SPREAD, flags)
    if not _LEAST <= count <= _MOST * width * height:
        what = "too small" if count < _LEAST else "as large as a wall"
        remedy = "click on the middle of the ball, with some background of another colour around it"
        raise InputError(f"what is there is {what} ({count} pixels of one colour)", remedy=remedy)
    left, top = max(x - 1, 0), max(y - 1, 0)
    box = (left, top, min(w + 2, width - left), min(h + 2, height - top))
    return teach(image, box), box
