"""Outline of the target within its first box, so that the upright box of a turned target can be given.

A box about a target that lies diagonally is half empty. Its outline comes from the colours inside against those around:
the convex hull of what is more likely inside than outside.
"""

from __future__ import annotations

import cv2
import numpy as np

from edge.uav.base import Image
from edge.uav.correlation.oriented_box import OrientedBox, crop
from protocols.geometry.types import Floats

_SIDE = 32  # of the resampled box [px]
_BINS = 12  # of the histogram, a channel
_MIN_SHARE, _MAX_SHARE = 0.25, 0.9  # of the box that the outline may cover, else the colours do not tell
_CORNER = 0.3  # of the octagon that stands for a target whose outline the colours do not tell, over a side


class Outline:
    """Convex outline of a target in its box: (n, 2), both coordinates reach from -0.5 to 0.5."""

    def __init__(self, image: Image, box: OrientedBox) -> None:
        c = 0.5 - _CORNER
        octagon = np.array(
            [[-0.5, -c], [-0.5, c], [-c, 0.5], [c, 0.5], [0.5, c], [0.5, -c], [c, -0.5], [-c, -0.5]], dtype=np.float64
        )
        found = _hull(image, box)
        self.points: Floats = octagon if found is None else found

    def bounds(self, box: OrientedBox) -> tuple[Floats, Floats]:
        """Centre and sides (2,) of the upright rectangle about the target in an oriented box [px]."""
        seen = (self.points * box.sides) @ box.axes.T
        low, high = seen.min(axis=0), seen.max(axis=0)
        return np.asarray(box.centre + 0.5 * (low + high)), np.asarray(high - low)


def _hull(image: Image, box: OrientedBox) -> Floats | None:
    """The outline by colour; None where inside and outside look alike."""
    patch = crop(image, box.sized(2.0 * box.sides), (2 * _SIDE, 2 * _SIDE))
    lab = cv2.cvtColor(patch, cv2.COLOR_BGR2LAB)
    inner = np.zeros(lab.shape[:2], np.uint8)
    half = _SIDE // 2
    inner[half : half + _SIDE, half : half + _SIDE] = 255
    table = []
    for mask in (inner, cv2.bitwise_not(inner)):
        histogram = cv2.calcHist([lab], [0, 1, 2], mask, [_BINS] * 3, [0, 256] * 3).reshape([_BINS] * 3)
        histogram = cv2.GaussianBlur(histogram.reshape(_BINS, -1), (3, 3), 0.7).reshape([_BINS] * 3)
        table.append((histogram + 0.05) / (histogram.sum() + 0.05 * _BINS**3))
    index = tuple((lab[half : half + _SIDE, half : half + _SIDE] // (256 // _BINS + 1)).reshape(-1, 3).T)
    inside = (table[0][index] > table[1][index]).reshape(_SIDE, _SIDE).astype(np.uint8)
    inside = cv2.morphologyEx(cv2.medianBlur(inside, 5), cv2.MORPH_OPEN, np.ones((3, 3), np.uint8))
    count, labels, stats, _ = cv2.connectedComponentsWithStats(inside)
    if count < 2:
        return None
    largest = 1 + int(stats[1:, cv2.CC_STAT_AREA].argmax())
    share = float(stats[largest, cv2.CC_STAT_AREA]) / _SIDE**2
    reach = stats[largest, [cv2.CC_STAT_WIDTH, cv2.CC_STAT_HEIGHT]] / _SIDE
    if not _MIN_SHARE < share < _MAX_SHARE or reach.min() < 0.7:
        return None
    rows, columns = np.nonzero(labels == largest)
    hull = cv2.convexHull(np.column_stack([columns, rows]).astype(np.float32)).reshape(-1, 2).astype(np.float64)
    low, high = hull.min(axis=0), hull.max(axis=0)
    return np.asarray((hull - low) / (high - low) - 0.5)
