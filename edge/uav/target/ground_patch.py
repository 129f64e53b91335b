"""Pieces of the ground rectified from an image, in which a target keeps its size and shape."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass

import cv2
import numpy as np

from edge.uav.ground.image_plane import ImagePlane
from protocols.geometry.types import Floats, Image, Singles

_MAX_PATCH_CELLS = 200  # per side


@dataclass(frozen=True, slots=True, eq=False)
class GroundPatch:
    """A rectified piece of ground. cells: (h, w, 3) image; valid: (h, w) 0..1, whether the camera sees the cell.

    centre: (2,) ground; angle: of the patch's x axis on the ground [rad]; cell_size: ground units per cell;
    complete: whether all of it is inside the image.
    """

    cells: Image
    valid: Singles
    centre: Floats
    angle: float
    cell_size: float
    complete: bool

    def to_ground(self, cells: Floats) -> Floats:
        """Ground points (n, 2) of cell coordinates (n, 2): x right, y down, 0 = centre of the first cell."""
        return _to_ground(cells, self.valid.shape[::-1], self.centre, self.angle, self.cell_size)

    def to_cells(self, ground: Floats) -> Floats:
        """Cell coordinates (n, 2) of ground points (n, 2)."""
        height, width = self.valid.shape
        c, s = np.cos(self.angle), np.sin(self.angle)
        local = (ground - self.centre) @ np.array([[c, -s], [s, c]])
        return np.asarray(local / self.cell_size + [(width - 1) / 2.0, (height - 1) / 2.0])


def _to_ground(cells: Floats, size: tuple[int, ...], centre: Floats, angle: float, cell_size: float) -> Floats:
    c, s = math.cos(angle), math.sin(angle)
    local = (cells - [(size[0] - 1) / 2.0, (size[1] - 1) / 2.0]) * cell_size
    return np.asarray(local @ np.array([[c, s], [-s, c]]) + centre)


def rectify_patch(
    image: Image,
    plane: ImagePlane,
    matrix: Floats,
    centre: Floats,
    angle: float,
    half: tuple[float, float],
    cell_size: float,
    corrected: Callable[[Image], Image] = lambda cells: cells,
) -> GroundPatch | None:
    """Ground patch about ``centre`` (2,), of half sizes ``half`` along and across ``angle``; None if not in view.

    matrix: (3, 3) normalised image from ground. cell_size: ground units per cell; increased for a very large patch.
    corrected: what is done to the cells' colours.
    """
    cell_size = max(cell_size, 2.0 * max(half) / _MAX_PATCH_CELLS)
    width, height = (2 * math.ceil(h / cell_size) + 1 for h in half)
    corners = np.array([[0, 0], [width - 1, 0], [width - 1, height - 1], [0, height - 1]], dtype=np.float64)
    pixels = plane.project(matrix, _to_ground(corners, (width, height), centre, angle, cell_size))
    if not np.isfinite(pixels).all() or float(np.abs(pixels).max()) > 1e5:
        return None
    low, high = pixels.min(axis=0), pixels.max(axis=0)
    if high[0] < 0 or high[1] < 0 or low[0] > plane.width - 1 or low[1] > plane.height - 1:
        return None
    image_from_cell = cv2.getPerspectiveTransform(corners.astype(np.float32), pixels.astype(np.float32))
    # With several pixels per cell the image is averaged first, against aliasing.
    area = abs(float(cv2.contourArea(pixels.astype(np.float32)))) / max((width - 1) * (height - 1), 1)
    coarse = min(max(round(math.sqrt(area)), 1), 16)
    if coarse > 1:
        x0, y0 = (max(int(v) - 2 * coarse, 0) for v in low)
        x1, y1 = min(int(high[0]) + 2 * coarse, plane.width), min(int(high[1]) + 2 * coarse, plane.height)
        size = ((x1 - x0) // coarse, (y1 - y0) // coarse)
        if min(size) < 2:
            return None
        image = np.asarray(
            cv2.resize(
                image[y0 : y0 + size[1] * coarse, x0 : x0 + size[0] * coarse], size, interpolation=cv2.INTER_AREA
            )
        )
        shrink = np.array(
            [[1 / coarse, 0, (0.5 - x0) / coarse - 0.5], [0, 1 / coarse, (0.5 - y0) / coarse - 0.5], [0, 0, 1.0]]
        )
        image_from_cell = shrink @ image_from_cell
    flags = cv2.INTER_LINEAR | cv2.WARP_INVERSE_MAP
    cells = cv2.warpPerspective(image, image_from_cell, (width, height), flags=flags, borderMode=cv2.BORDER_REPLICATE)
    complete = bool(low.min() >= 1.0 and high[0] <= plane.width - 2 and high[1] <= plane.height - 2)
    if complete:
        valid = np.ones((height, width), np.float32)
    else:
        full = np.ones(image.shape[:2], np.float32)
        visible = cv2.warpPerspective(full, image_from_cell, (width, height), flags=flags)
        valid = (visible > 0.75).astype(np.float32)
    cells = corrected(np.asarray(cells, dtype=np.uint8))
    return GroundPatch(cells, np.asarray(valid, np.float32), centre, angle, cell_size, complete)
