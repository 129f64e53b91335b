"""Search for the target in a region of the image: candidates by similarity to the template memory."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from edge.uav.correlation.features import cell_features
from edge.uav.correlation.memory import TemplateMemory
from edge.uav.correlation.oriented_box import OrientedBox, crop
from edge.uav.correlation.template import CELL_PX, CELLS
from protocols.geometry.types import Floats, Image

_MAX_CELLS = 3000  # of a region's feature map; a larger one is cut down about its centre
_SEPARATION = 0.6  # between candidates, in box sides
_MIN_INSIDE = 0.7  # share of a candidate in the image


@dataclass(frozen=True, slots=True)
class Found:
    """A candidate and its similarity to the memory."""

    box: OrientedBox
    score: float


def search(image: Image, memory: TemplateMemory, box: OrientedBox, reach: Floats, most: int = 4) -> list[Found]:
    """The best boxes like ``box``, at its angle, with centres within ``reach`` (2,) of its own [px], best first.

    reach: along the box's own axes. Only centres inside the image count.
    """
    rows, columns = image.shape[:2]
    cell = box.sides / CELLS  # image pixels of a cell
    low, high = _clipped(box, reach, (columns, rows))
    if (high <= low).any():
        return []
    cells = np.ceil((high - low) / cell).astype(int) + CELLS
    if cells[0] * cells[1] > _MAX_CELLS:
        cells = np.maximum((cells * np.sqrt(_MAX_CELLS / (cells[0] * cells[1]))).astype(int), CELLS + 3)
        within = np.clip(np.zeros(2), low + 0.5 * (cells - CELLS) * cell, high - 0.5 * (cells - CELLS) * cell)
    else:
        within = 0.5 * (low + high)
    middle = box.at(box.centre + box.axes @ within)
    padded = middle.sized((cells + 2) * cell)
    patch = crop(image, padded, (int(cells[0] + 2) * CELL_PX, int(cells[1] + 2) * CELL_PX))
    scores = memory.scan(cell_features(patch, CELL_PX)[:, 1:-1, 1:-1])
    return _peaks(scores, middle, box, (columns, rows), most)


def _clipped(box: OrientedBox, reach: Floats, size: tuple[int, int]) -> tuple[Floats, Floats]:
    """The smallest and largest offsets (2,) along the box's axes that are within reach and can be in the image."""
    corner = np.array([[0, 0], [size[0], 0], [size[0], size[1]], [0, size[1]]], dtype=np.float64)
    seen = (corner - box.centre) @ box.axes
    return np.maximum(-reach, seen.min(axis=0)), np.minimum(reach, seen.max(axis=0))


def _peaks(scores: Floats, middle: OrientedBox, box: OrientedBox, size: tuple[int, int], most: int) -> list[Found]:
    """The highest well separated scores."""
    rows, columns = scores.shape
    left = scores.copy()
    apart = int(np.ceil(_SEPARATION * CELLS))
    out: list[Found] = []
    for _ in range(3 * most):
        row, column = divmod(int(left.argmax()), columns)
        if not np.isfinite(left[row, column]) or len(out) == most:
            break
        offset = (np.array([column, row]) - 0.5 * (np.array([columns, rows]) - 1.0)) * box.sides / CELLS
        found = box.at(middle.centre + middle.axes @ offset)
        if found.share_inside(size) > _MIN_INSIDE:
            out.append(Found(found, float(scores[row, column])))
        left[max(row - apart, 0) : row + apart + 1, max(column - apart, 0) : column + apart + 1] = -np.inf
    return out


def tile(box: OrientedBox, size: tuple[int, int], index: int) -> tuple[OrientedBox, Floats]:
    """One of the tiles into which an image is cut for a search of all of it: the box in its middle, and its reach (2,).

    index: counts through the tiles, again and again.
    """
    cell = box.extent / CELLS
    side = np.sqrt(_MAX_CELLS) - 2 * CELLS
    counts = np.maximum(np.ceil(np.array(size) / (side * cell)), 1.0).astype(int)
    k = index % int(counts[0] * counts[1])
    step = np.array(size) / counts
    middle = (np.array([k % counts[0], k // counts[0]]) + 0.5) * step
    return box.at(middle), 0.5 * step + 0.2 * box.extent
