"""Road map: log-odds of road surface on a ground grid, accumulated over the frames, and its colour model."""

from __future__ import annotations

from typing import Any

import cv2
import numpy as np

from edge.uav.ground import colour_table
from edge.uav.ground.image_plane import ImagePlane, apply_homography, inverse
from protocols.geometry import kernels
from protocols.geometry.types import Floats, Image, Singles

CELL = 0.5
"""Size of a cell [ground units]."""
_MAP_CELLS = 1024  # per side
_UPDATE_REACH = 70.0  # half side of the area that one frame updates [ground units]
_MESH_SPACING = 12  # cells between the points that are projected exactly
_MAX_DISTANCE = 1e7  # of the view centre from the origin [ground units]
_BITS = 4  # of a channel: 4,096 colours; finer ones stay empty for long, coarser ones mix road and roofs
_BINS = 1 << _BITS
_SMOOTHING = 0.2  # share of a colour's bin that either neighbour gets
_MAX_LOG_ODDS = 4.0  # eight frames of _MAX_UPDATE: as many unlearn what was wrong
_MAX_UPDATE = 0.5  # of the log-odds, per frame
_PRIOR_ROAD_SHARE = 0.3  # share of the image that is road, as a prior


class RoadMap:
    """A square grid of the ground that follows the car. Cells never observed are 0."""

    def __init__(self, centre: Floats) -> None:
        self._log_odds: Singles = np.zeros((_MAP_CELLS, _MAP_CELLS), np.float32)
        self._origin = np.round(centre / CELL) * CELL - 0.5 * _MAP_CELLS * CELL
        self._road_histogram = np.zeros(_BINS**3)
        self._image_histogram = np.zeros(_BINS**3)
        self._log_ratio_table: Singles | None = None
        self._smooth: Singles | None = None
        self._smooth_origin = np.zeros(2)

    def learn_colours(self, road: Image, image: Image, rate: float) -> None:
        """Update the colour model from colours (n, 3) of road and of a whole image; ``rate``: weight of the new."""
        if len(road) < 8:
            return
        # Reject outliers: samples on a verge or a marking.
        deviation = np.abs(road - np.median(road, axis=0)).max(axis=1)
        road = road[deviation <= max(2.0 * float(np.median(deviation)), 12.0)]
        new_road, new_all = (colour_table.histogram(part, None, _BITS, _SMOOTHING) for part in (road, image))
        new_road, new_all = new_road / max(new_road.sum(), 1e-9), new_all / max(new_all.sum(), 1e-9)
        if self._log_ratio_table is None or rate >= 1.0:
            self._road_histogram, self._image_histogram = new_road, new_all
        else:
            self._road_histogram = (1 - rate) * self._road_histogram + rate * new_road
            self._image_histogram = (1 - rate) * self._image_histogram + rate * new_all
        other = np.maximum(
            self._image_histogram - _PRIOR_ROAD_SHARE * self._road_histogram, 0.05 * self._image_histogram
        )
        ratio = np.log((self._road_histogram + 1e-4) / (other / max(other.sum(), 1e-9) + 1e-4))
        self._log_ratio_table = np.clip(ratio, -2.0, 2.0).astype(np.float32)

    def reset(self) -> None:
        """Make all cells unknown; the colour model stays."""
        self._log_odds[:] = 0.0
        self._smooth = None

    def transfer_from(self, other: RoadMap, new_from_old: Floats) -> None:
        """Take over another map in another ground frame. new_from_old: (3, 3) homography of the ground."""
        self._road_histogram, self._image_histogram = other._road_histogram, other._image_histogram
        self._log_ratio_table = other._log_ratio_table
        new = np.array(
            [[CELL, 0.0, self._origin[0] + 0.5 * CELL], [0.0, CELL, self._origin[1] + 0.5 * CELL], [0, 0, 1]]
        )
        old = np.array(
            [[CELL, 0.0, other._origin[0] + 0.5 * CELL], [0.0, CELL, other._origin[1] + 0.5 * CELL], [0, 0, 1]]
        )
        cells = inverse(new) @ new_from_old @ old
        moved = cv2.warpPerspective(other._log_odds, cells, (_MAP_CELLS, _MAP_CELLS), flags=cv2.INTER_NEAREST)
        self._log_odds = np.asarray(moved, np.float32)
        self._smooth = None

    @property
    def has_colour_model(self) -> bool:
        """Whether a colour model has been learnt."""
        return self._log_ratio_table is not None

    @property
    def colour_table(self) -> tuple[int, Singles]:
        """Bits of a channel, and the log-likelihood ratio (8**bits,) of road of each colour."""
        assert self._log_ratio_table is not None
        return _BITS, self._log_ratio_table

    def update(
        self, working: Image, downscale: int, plane: ImagePlane, matrix: Floats, excluded: Floats | None
    ) -> None:
        """Add one working image (reduced by ``downscale``). excluded: (m, 2) ground corners of an area left out."""
        if self._log_ratio_table is None:
            return
        try:
            back = inverse(matrix)
        except np.linalg.LinAlgError:
            return
        on_ground = apply_homography(back, plane.normalise(np.vstack([plane.corners, plane.corners.mean(axis=0)])))
        centre, finite = on_ground[4], np.isfinite(on_ground)
        if not finite[4].all() or np.abs(centre).max() > _MAX_DISTANCE:
            return
        reach = 2 * _UPDATE_REACH
        low = np.maximum(np.where(finite, on_ground, centre - reach).min(axis=0), centre - _UPDATE_REACH)
        high = np.minimum(np.where(finite, on_ground, centre + reach).max(axis=0), centre + _UPDATE_REACH)
        self._recentre(centre)
        first = np.maximum(np.floor((low - self._origin) / CELL).astype(int), 0)
        last = np.minimum(np.ceil((high - self._origin) / CELL).astype(int), _MAP_CELLS)
        size = last - first
        if (size < 4).any():
            return
        # Exact on a mesh, linear between its points: cheap also with lens distortion.
        nx, ny = (max(2, int(s) // _MESH_SPACING + 1) for s in size)
        gx = np.linspace(0.0, size[0] - 1.0, nx)
        gy = np.linspace(0.0, size[1] - 1.0, ny)
        mesh = np.column_stack([np.tile(gx, ny), np.repeat(gy, nx)])
        pixels = plane.project(matrix, (mesh + first + 0.5) * CELL + self._origin)
        pixels = np.fmin(np.fmax((pixels + 0.5) / downscale - 0.5, -1e4), 1e4).reshape(ny, nx, 2)
        increment = self._evidence(working, pixels, (int(size[0]), int(size[1])))
        if excluded is not None and np.isfinite(excluded).all():
            outline = ((excluded - self._origin) / CELL - first - 0.5).clip(-1e4, 1e4).astype(np.int32)
            cv2.fillConvexPoly(increment, cv2.convexHull(outline[:, None]), 0.0)
        part = self._log_odds[first[1] : last[1], first[0] : last[0]]
        np.clip(part + increment, -_MAX_LOG_ODDS, _MAX_LOG_ODDS, out=part)
        self._smooth = None

    def _evidence(self, working: Image, mesh: Floats, size: tuple[int, int]) -> Singles:
        """What an image says of a map of this size. mesh: pixels (ny, nx, 2) of cells, linear between them."""
        assert self._log_ratio_table is not None
        table = np.clip(self._log_ratio_table, -1.0, 1.0) * np.float32(_MAX_UPDATE)
        height, width = working.shape[:2]
        if kernels.AVAILABLE:
            out, line = np.empty(size[::-1], np.float32), np.empty(2 * mesh.shape[1] + size[0])
            image = height, width, np.ascontiguousarray(working)
            kernels.call("road_evidence", *mesh.shape[:2], mesh, *size[::-1], *image, _BITS, table, line, out)
            return out
        across, down = cv2.split(_interpolate_mesh(mesh.astype(np.float32), size))
        cells = cv2.remap(working, across, down, cv2.INTER_NEAREST, borderMode=cv2.BORDER_CONSTANT)
        inside = (across > 1) & (down > 1) & (across < width - 2) & (down < height - 2)
        return np.asarray(colour_table.values(table, np.asarray(cells, np.uint8), _BITS) * inside)

    def log_odds(self, points: Floats) -> Floats:
        """Log-odds (n,) at ground points (n, 2); 0 where unknown."""
        return _lookup(self._log_odds, self._origin, points)

    def smooth_around(self, centre: Floats, reach: float) -> None:
        """Smooth the map around a position, for ``smooth_log_odds``."""
        first = np.clip(np.floor((centre - reach - self._origin) / CELL).astype(int), 0, _MAP_CELLS - 1)
        last = np.clip(np.ceil((centre + reach - self._origin) / CELL).astype(int), 1, _MAP_CELLS)
        part = self._log_odds[first[1] : last[1], first[0] : last[0]]
        # The closing fills lane markings and cars, which are narrower.
        closed = cv2.morphologyEx(part, cv2.MORPH_CLOSE, np.ones((3, 3), np.uint8))
        self._smooth = np.asarray(cv2.blur(closed, (3, 3)), np.float32)
        self._smooth_origin = self._origin + first * CELL

    @property
    def smooth_grid(self) -> tuple[Singles, Floats]:
        """The smoothed part (h, w), or else the map, and where its first cell begins (2,)."""
        return (self._log_odds, self._origin) if self._smooth is None else (self._smooth, self._smooth_origin)

    def smooth_log_odds(self, points: Floats) -> Floats:
        """Smoothed log-odds (n,) at ground points (n, 2) of the smoothed part; 0 outside it."""
        return _lookup(*self.smooth_grid, points)

    def road_cells(self, centre: Floats, reach: float) -> Floats:
        """Ground points (n, 2) of cells with high log-odds of road, subsampled, for overlays."""
        first = np.clip(np.floor((centre - reach - self._origin) / CELL).astype(int), 0, _MAP_CELLS - 1)
        last = np.clip(np.ceil((centre + reach - self._origin) / CELL).astype(int), 1, _MAP_CELLS)
        rows, columns = np.nonzero(self._log_odds[first[1] : last[1] : 2, first[0] : last[0] : 2] > 1.0)
        return np.asarray((np.column_stack([2 * columns, 2 * rows]) + first + 0.5) * CELL + self._origin)

    def _recentre(self, centre: Floats) -> None:
        """Shift the grid so that ``centre`` is well inside."""
        offset = (centre - self._origin) / CELL - 0.5 * _MAP_CELLS
        if np.abs(offset).max() < 0.2 * _MAP_CELLS:
            return
        move = np.round(offset).astype(int)
        shifted = np.zeros_like(self._log_odds)
        if np.abs(move).max() < _MAP_CELLS:
            sx, sy = move
            old = self._log_odds[max(sy, 0) : _MAP_CELLS + min(sy, 0), max(sx, 0) : _MAP_CELLS + min(sx, 0)]
            shifted[max(-sy, 0) : _MAP_CELLS - max(sy, 0), max(-sx, 0) : _MAP_CELLS - max(sx, 0)] = old
        self._log_odds = shifted
        self._origin = self._origin + move * CELL
        self._smooth = None


def _interpolate_mesh(mesh: Singles, size: tuple[int, int]) -> Singles:
    """A mesh (ny, nx, 2), whose first and last points are the first and last cells, interpolated at every cell."""
    ny, nx = mesh.shape[:2]
    columns = np.linspace(0.0, nx - 1.0, size[0], dtype=np.float32)
    rows = np.linspace(0.0, ny - 1.0, size[1], dtype=np.float32)
    grid = np.meshgrid(columns, rows)
    return np.asarray(cv2.remap(mesh, grid[0], grid[1], cv2.INTER_LINEAR), np.float32)


def kernel_arguments(field: Singles, origin: Floats) -> tuple[Any, ...]:
    """What the kernels take of a map (h, w) whose first cell begins at ``origin`` (2,)."""
    return (*origin.tolist(), CELL, *field.shape, field)


def _lookup(field: Singles, origin: Floats, points: Floats) -> Floats:
    """Values (n,) at ground points (n, 2) of a map (h, w) whose first cell begins at ``origin`` (2,); 0 outside."""
    height, width = field.shape
    if kernels.AVAILABLE:
        out, points = np.empty(len(points)), np.ascontiguousarray(points)
        kernels.call("grid_values", *kernel_arguments(field, origin), len(out), points, out)
        return out
    index = np.floor((points - origin) / CELL)
    with np.errstate(invalid="ignore"):
        good = (index[..., 0] >= 0) & (index[..., 1] >= 0) & (index[..., 0] < width) & (index[..., 1] < height)
    x = np.where(good, index[..., 0], 0).astype(np.int64)
    y = np.where(good, index[..., 1], 0).astype(np.int64)
    return np.asarray(np.where(good, field[y, x], 0.0), dtype=np.float64)
