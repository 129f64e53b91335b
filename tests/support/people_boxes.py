"""True boxes of people in a rendered room, and the score of detected boxes against them."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
import numpy.typing as npt
from scipy.optimize import linear_sum_assignment

from edge.scenes.people.scene import PeopleScene
from protocols.geometry.types import Bools, Floats

_IN_VIEW = 0.5  # fraction of the silhouette that must be visible to count
_BODY = 0.45  # fraction of a box that is silhouette, without occlusion


def truth(scene: PeopleScene, camera: str, moment: float, owners: npt.NDArray[np.uint8]) -> tuple[Floats, Bools]:
    """Boxes (n, 4) x, y, w, h [px] of whole bodies, and which count (n,): half in view and not cut by the border.

    owners: (H, W) person number by pixel, from the renderer.
    """
    boxes = scene.boxes(camera, moment)
    there = np.isfinite(boxes).all(axis=1)
    height, width = owners.shape
    counts = []
    for index in np.flatnonzero(there):
        x, y, w, h = boxes[index]
        cut = x <= 0 or y <= 0 or x + w >= width - 1 or y + h >= height - 1
        counts.append(not cut and (owners == index + 1).sum() > _IN_VIEW * _BODY * w * h)
    return boxes[there], np.array(counts, dtype=np.bool_)


def score_boxes(boxes: Floats, counts: Bools, found: Sequence[Floats]) -> tuple[int, int, int, float]:
    """True positives, false positives, misses, and summed overlap of true positives; uncounted boxes are ignored."""
    if not len(found) or not len(boxes):
        return 0, len(found), int(counts.sum()), 0.0
    table = np.array([[overlap(true, one) for one in found] for true in boxes])
    fits = table >= 0.5
    # Boxes that count are assigned first.
    rows, columns = linear_sum_assignment(-np.where(fits, table + 10.0 * counts[:, None], 0.0))
    pairs = [(row, column) for row, column in zip(rows, columns, strict=True) if fits[row, column]]
    right = [table[row, column] for row, column in pairs if counts[row]]
    taken = {column for _, column in pairs}
    wrong = sum(column not in taken and not fits[~counts, column].any() for column in range(len(found)))
    return len(right), int(wrong), int(counts.sum()) - len(right), float(sum(right))


def overlap(a: npt.ArrayLike, b: npt.ArrayLike) -> float:
    """Intersection over union of two boxes x, y, w, h."""
    (x, y, w, h), (x2, y2, w2, h2) = np.asarray(a, dtype=np.float64), np.asarray(b, dtype=np.float64)
    across, down = min(x + w, x2 + w2) - max(x, x2), min(y + h, y2 + h2) - max(y, y2)
    return float(across * down / (w * h + w2 * h2 - across * down)) if across > 0 and down > 0 else 0.0
