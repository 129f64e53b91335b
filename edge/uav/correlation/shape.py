"""Outline and extent of the target by colour: what is likelier inside its first box than around it.

A box about a target that lies diagonally is half empty; the convex hull of the target's colours gives its upright box
at another angle. Where the colours give the first box back, they also measure its extent later on, without drift.
"""

from __future__ import annotations

import cv2
import numpy as np
import numpy.typing as npt

from edge.uav.correlation.oriented_box import OrientedBox, crop
from protocols.geometry.types import Floats, Image

_SIDE = 32  # of the resampled box [px]
_MARGIN = 2.0  # of the resampled region, over the box
_BINS = 12  # of the histogram, a channel
_MIN_SHARE, _MAX_SHARE = 0.25, 0.9  # of the box that the outline may cover, else the colours do not tell
_MIN_REACH = 0.7  # of the outline along the box's sides
_MEASURE_OVERLAP = 0.75  # intersection over union with the first box at which the colours measure the extent
_PLAUSIBLE = 0.65  # ratio of measured and present sides
_CORNER = 0.3  # of the octagon that stands for a target whose outline the colours do not tell, over a side

Mask = npt.NDArray[np.uint8]


class Outline:
    """Colours and convex outline of a target. points: (n, 2), both coordinates reach from -0.5 to 0.5 of its box."""

    def __init__(self, image: Image, box: OrientedBox) -> None:
        c = 0.5 - _CORNER
        octagon = [[-0.5, -c], [-0.5, c], [-c, 0.5], [c, 0.5], [0.5, c], [0.5, -c], [c, -0.5], [-c, -0.5]]
        self.points: Floats = np.array(octagon, dtype=np.float64)
        lab = _region(image, box)
        self._inside_likelier = _likelier(lab)
        mask, share = self._component(lab)
        hull = _hull(mask)
        self.measures = False
        if hull is None:
            return
        low, high = hull.min(axis=0), hull.max(axis=0)
        both = np.prod(np.clip(np.minimum(high, 0.5) - np.maximum(low, -0.5), 0.0, None))
        overlap = float(both / (np.prod(high - low) + 1.0 - both))
        self.measures = overlap > _MEASURE_OVERLAP
        square = np.array([[-0.5, -0.5], [0.5, -0.5], [0.5, 0.5], [-0.5, 0.5]], np.float32)
        _, inside = cv2.intersectConvexConvex(hull.astype(np.float32), square)
        if _MIN_SHARE < share < _MAX_SHARE and inside is not None:
            inner = inside.reshape(-1, 2).astype(np.float64)
            low, high = inner.min(axis=0), inner.max(axis=0)
            if (high - low).min() > _MIN_REACH:
                self.points = np.asarray((inner - low) / (high - low) - 0.5)

    def bounds(self, box: OrientedBox) -> tuple[Floats, Floats]:
        """Centre and sides (2,) of the upright rectangle about the target in an oriented box [px]."""
        seen = (self.points * box.sides) @ box.axes.T
        low, high = seen.min(axis=0), seen.max(axis=0)
        return np.asarray(box.centre + 0.5 * (low + high)), np.asarray(high - low)

    def measured(self, image: Image, box: OrientedBox) -> Floats | None:
        """Sides (2,) of the target's colours along the box's axes [px]; None where they do not tell."""
        if not self.measures:
            return None
        hull = _hull(self._component(_region(image, box))[0])
        if hull is None:
            return None
        ratio = hull.max(axis=0) - hull.min(axis=0)
        off = np.abs(hull.max(axis=0) + hull.min(axis=0)).max()
        return box.sides * ratio if (np.abs(np.log(ratio)) < -np.log(_PLAUSIBLE)).all() and off < 0.5 else None

    def _component(self, lab: Image) -> tuple[Mask, float]:
        """The part (64, 64) of the target's colours that lies in the middle, and its share of the box."""
        index = tuple((lab // (256 // _BINS + 1)).reshape(-1, 3).T)
        mask = self._inside_likelier[index].reshape(lab.shape[:2]).astype(np.uint8)
        mask = np.asarray(
            cv2.morphologyEx(cv2.medianBlur(mask, 5), cv2.MORPH_OPEN, np.ones((3, 3), np.uint8)), np.uint8
        )
        _, labels = cv2.connectedComponents(mask)
        quarter = lab.shape[0] // 4
        middle = labels[quarter : 3 * quarter, quarter : 3 * quarter]
        counts = np.bincount(middle.ravel(), minlength=2)
        counts[0] = 0
        chosen = int(counts.argmax())
        return np.asarray(labels == chosen, np.uint8) if counts[chosen] else np.zeros_like(mask), float(
            counts[chosen] / middle.size
        )


def _region(image: Image, box: OrientedBox) -> Image:
    side = round(_MARGIN * _SIDE)
    return np.asarray(
        cv2.cvtColor(crop(image, box.sized(_MARGIN * box.sides), (side, side)), cv2.COLOR_BGR2LAB), np.uint8
    )


def _likelier(lab: Image) -> npt.NDArray[np.bool_]:
    """Which colours (bins, bins, bins) are likelier in the middle half of a region than around it."""
    inner = np.zeros(lab.shape[:2], np.uint8)
    quarter = lab.shape[0] // 4
    inner[quarter : 3 * quarter, quarter : 3 * quarter] = 255
    table = []
    for mask in (inner, cv2.bitwise_not(inner)):
        histogram = cv2.calcHist([lab], [0, 1, 2], mask, [_BINS] * 3, [0, 256] * 3).reshape([_BINS] * 3)
        histogram = cv2.GaussianBlur(histogram.reshape(_BINS, -1), (3, 3), 0.7).reshape([_BINS] * 3)
        table.append((histogram + 0.05) / (histogram.sum() + 0.05 * _BINS**3))
    return np.asarray(table[0] > table[1])


def _hull(mask: Mask) -> Floats | None:
    """Convex hull (n, 2) of a mask in units of the box about whose middle the region lies."""
    rows, columns = np.nonzero(mask)
    if len(rows) < 12:
        return None
    points = np.column_stack([columns, rows]).astype(np.float32)
    corners = np.concatenate([points - 0.5, points + 0.5, points + [-0.5, 0.5], points + [0.5, -0.5]]).astype(
        np.float32
    )
    hull = cv2.convexHull(corners).reshape(-1, 2).astype(np.float64)
    return np.asarray((hull + 0.5 - 0.5 * len(mask)) / _SIDE)
