"""Log-odds of asphalt on the ground, remembered where the camera has been, and the ways a car can take on it."""

from __future__ import annotations

import cv2
import numpy as np
import numpy.typing as npt

from edge.uav.ground.image_plane import ImagePlane, inverse, transfer
from protocols.geometry.types import Floats

Picture = npt.NDArray[np.uint8]
Singles = npt.NDArray[np.float32]

CELL = 0.5
"""Size of a cell [ground units]."""
_SIZE = 1024  # cells a side
_REACH = 70.0  # half side of what one frame updates [ground units]
_MESH = 12  # cells between the points that are projected exactly
_FARTHEST = 1e7  # a view beyond is no view [ground units]
_BITS = 4
_BINS = 1 << _BITS
_CLIP = 4.0
_EVIDENCE = 0.5  # of one frame, at most
_SHARE = 0.3  # of a picture that is road, before anything is known


class RoadMap:
    """A square of ground that follows the car. Cells never seen are 0."""

    def __init__(self, centre: Floats) -> None:
        self._odds: Singles = np.zeros((_SIZE, _SIZE), np.float32)
        self._origin = np.round(centre / CELL) * CELL - 0.5 * _SIZE * CELL
        self._road = np.zeros(_BINS**3)
        self._all = np.zeros(_BINS**3)
        self._table: Singles | None = None
        self._smooth: Singles | None = None
        self._smooth_origin = np.zeros(2)

    def learn(self, road: Picture, everything: Picture, rate: float) -> None:
        """Colours (n, 3) of what is road, and of a whole picture; the newer count by ``rate``."""
        if len(road) < 8:
            return
        # A verge or a marking among them is not what most of them are.
        away = np.abs(road - np.median(road, axis=0)).max(axis=1)
        road = road[away <= max(2.0 * float(np.median(away)), 12.0)]
        new_road = _blur(np.bincount(_index(road), minlength=_BINS**3).astype(np.float64))
        new_all = _blur(np.bincount(_index(everything), minlength=_BINS**3).astype(np.float64))
        new_road, new_all = new_road / max(new_road.sum(), 1e-9), new_all / max(new_all.sum(), 1e-9)
        if self._table is None or rate >= 1.0:
            self._road, self._all = new_road, new_all
        else:
            self._road = (1 - rate) * self._road + rate * new_road
            self._all = (1 - rate) * self._all + rate * new_all
        other = np.maximum(self._all - _SHARE * self._road, 0.05 * self._all)
        ratio = np.log((self._road + 1e-4) / (other / max(other.sum(), 1e-9) + 1e-4))
        self._table = np.clip(ratio, -2.0, 2.0).astype(np.float32)

    def forget(self) -> None:
        """All cells unknown again; the colours stay."""
        self._odds[:] = 0.0
        self._smooth = None

    def take(self, other: RoadMap, new_from_old: Floats) -> None:
        """What another map knows, in another ground frame. new_from_old: (3, 3) homography of the ground."""
        self._road, self._all, self._table = other._road, other._all, other._table
        new = np.array(
            [[CELL, 0.0, self._origin[0] + 0.5 * CELL], [0.0, CELL, self._origin[1] + 0.5 * CELL], [0, 0, 1]]
        )
        old = np.array(
            [[CELL, 0.0, other._origin[0] + 0.5 * CELL], [0.0, CELL, other._origin[1] + 0.5 * CELL], [0, 0, 1]]
        )
        cells = inverse(new) @ new_from_old @ old
        moved = cv2.warpPerspective(other._odds, cells, (_SIZE, _SIZE), flags=cv2.INTER_NEAREST)
        self._odds = np.asarray(moved, np.float32)
        self._smooth = None

    @property
    def ready(self) -> bool:
        """Whether any road has been learnt."""
        return self._table is not None

    def ratios(self, colours: Picture) -> Singles:
        """Log-likelihood ratio of road for colours (n, 3)."""
        assert self._table is not None
        return self._table[_index(colours)]

    def update(self, small: Picture, factor: int, plane: ImagePlane, matrix: Floats, masked: Floats | None) -> None:
        """Add one working picture (smaller by ``factor``). masked: (m, 2) corners on the ground left out."""
        if self._table is None:
            return
        corners = np.array(
            [[0, 0], [plane.width - 1, 0], [plane.width - 1, plane.height - 1], [0, plane.height - 1]], dtype=np.float64
        )
        middle = np.array([[(plane.width - 1) / 2.0, (plane.height - 1) / 2.0]])
        try:
            back = inverse(matrix)
        except np.linalg.LinAlgError:
            return
        seen = transfer(back, plane.normalise(np.concatenate([corners, middle])))
        centre = seen[4]
        if not np.isfinite(centre).all() or np.abs(centre).max() > _FARTHEST:
            return
        spread = np.where(np.isfinite(seen[:4]), seen[:4], centre + 2 * _REACH)
        low = np.maximum(
            np.min(np.vstack([spread, np.where(np.isfinite(seen[:4]), seen[:4], centre - 2 * _REACH)]), 0),
            centre - _REACH,
        )
        high = np.minimum(np.max(np.vstack([spread, seen[4:]]), 0), centre + _REACH)
        self._make_room(centre)
        first = np.maximum(np.floor((low - self._origin) / CELL).astype(int), 0)
        last = np.minimum(np.ceil((high - self._origin) / CELL).astype(int), _SIZE)
        size = last - first
        if (size < 4).any():
            return
        # Exact on a mesh, linear between: cheap also with a bent lens.
        nx, ny = (max(2, int(s) // _MESH + 1) for s in size)
        gx = np.linspace(0.0, size[0] - 1.0, nx)
        gy = np.linspace(0.0, size[1] - 1.0, ny)
        mesh = np.stack(np.meshgrid(gx, gy), axis=-1).reshape(-1, 2)
        pixels = plane.pixels(transfer(matrix, (mesh + first + 0.5) * CELL + self._origin))
        pixels = np.nan_to_num((pixels + 0.5) / factor - 0.5, nan=-1e4).clip(-1e4, 1e4).reshape(ny, nx, 2)
        maps = _stretch(pixels.astype(np.float32), (int(size[0]), int(size[1])))
        across, down = cv2.split(maps)
        warped = cv2.remap(small, across, down, cv2.INTER_NEAREST, borderMode=cv2.BORDER_CONSTANT)
        cells = np.asarray(warped, np.uint8)
        height, width = small.shape[:2]
        inside = (maps[..., 0] > 1) & (maps[..., 1] > 1) & (maps[..., 0] < width - 2) & (maps[..., 1] < height - 2)
        evidence = np.where(inside, np.clip(self._table[_index(cells)], -1.0, 1.0) * _EVIDENCE, 0.0).astype(np.float32)
        if masked is not None and np.isfinite(masked).all():
            outline = ((masked - self._origin) / CELL - first - 0.5).clip(-1e4, 1e4).astype(np.int32)
            cv2.fillConvexPoly(evidence, cv2.convexHull(outline[:, None]), 0.0)
        part = self._odds[first[1] : last[1], first[0] : last[0]]
        np.clip(part + evidence, -_CLIP, _CLIP, out=part)
        self._smooth = None

    def at(self, points: Floats) -> Floats:
        """Log-odds (n,) at ground points (n, 2); 0 where nothing is known."""
        index = np.floor((points - self._origin) / CELL)
        return _look(self._odds, index)

    def prepare(self, centre: Floats, reach: float) -> None:
        """Smooth the map around a place, for ``smooth_at``."""
        first = np.clip(np.floor((centre - reach - self._origin) / CELL).astype(int), 0, _SIZE - 1)
        last = np.clip(np.ceil((centre + reach - self._origin) / CELL).astype(int), 1, _SIZE)
        part = self._odds[first[1] : last[1], first[0] : last[0]]
        # Lane markings and cars are holes narrower than this.
        closed = cv2.morphologyEx(part, cv2.MORPH_CLOSE, np.ones((3, 3), np.uint8))
        self._smooth = np.asarray(cv2.blur(closed, (3, 3)), np.float32)
        self._smooth_origin = self._origin + first * CELL

    def smooth_at(self, points: Floats) -> Floats:
        """Smoothed log-odds (n,) at ground points (n, 2) of the prepared part; 0 outside it."""
        if self._smooth is None:
            return self.at(points)
        return _look(self._smooth, np.floor((points - self._smooth_origin) / CELL))

    def outline(self, centre: Floats, reach: float) -> Floats:
        """Ground points (n, 2) of cells that are surely road, thinned, for overlays."""
        first = np.clip(np.floor((centre - reach - self._origin) / CELL).astype(int), 0, _SIZE - 1)
        last = np.clip(np.ceil((centre + reach - self._origin) / CELL).astype(int), 1, _SIZE)
        rows, columns = np.nonzero(self._odds[first[1] : last[1] : 2, first[0] : last[0] : 2] > 1.0)
        return np.asarray((np.column_stack([2 * columns, 2 * rows]) + first + 0.5) * CELL + self._origin)

    def _make_room(self, centre: Floats) -> None:
        """Shift the square so that ``centre`` is well inside."""
        offset = (centre - self._origin) / CELL - 0.5 * _SIZE
        if np.abs(offset).max() < 0.2 * _SIZE:
            return
        move = np.round(offset).astype(int)
        shifted = np.zeros_like(self._odds)
        if np.abs(move).max() < _SIZE:
            sx, sy = move
            old = self._odds[max(sy, 0) : _SIZE + min(sy, 0), max(sx, 0) : _SIZE + min(sx, 0)]
            shifted[max(-sy, 0) : _SIZE - max(sy, 0), max(-sx, 0) : _SIZE - max(sx, 0)] = old
        self._odds = shifted
        self._origin = self._origin + move * CELL
        self._smooth = None


def _stretch(mesh: Singles, size: tuple[int, int]) -> Singles:
    """A mesh (ny, nx, 2) whose first and last points are the first and last cells, linearly at every cell."""
    ny, nx = mesh.shape[:2]
    columns = np.linspace(0.0, nx - 1.0, size[0], dtype=np.float32)
    rows = np.linspace(0.0, ny - 1.0, size[1], dtype=np.float32)
    grid = np.meshgrid(columns, rows)
    return np.asarray(cv2.remap(mesh, grid[0], grid[1], cv2.INTER_LINEAR), np.float32)


def _look(field: Singles, index: Floats) -> Floats:
    height, width = field.shape
    with np.errstate(invalid="ignore"):
        good = (index[..., 0] >= 0) & (index[..., 1] >= 0) & (index[..., 0] < width) & (index[..., 1] < height)
    x = np.where(good, index[..., 0], 0).astype(np.int64)
    y = np.where(good, index[..., 1], 0).astype(np.int64)
    return np.asarray(np.where(good, field[y, x], 0.0), dtype=np.float64)


def _index(colours: Picture) -> npt.NDArray[np.int64]:
    q = colours >> (8 - _BITS)
    index = (q[..., 0].astype(np.int64) << 2 * _BITS) + (q[..., 1].astype(np.int64) << _BITS) + q[..., 2]
    return np.asarray(index, dtype=np.int64)


def _blur(histogram: Floats) -> Floats:
    cube = histogram.reshape(_BINS, _BINS, _BINS)
    for axis in range(3):
        padded = np.pad(cube, [(1, 1) if k == axis else (0, 0) for k in range(3)])
        before = np.take(padded, range(_BINS), axis)
        after = np.take(padded, range(2, _BINS + 2), axis)
        cube = 0.6 * cube + 0.2 * (before + after)
    return np.asarray(cube.ravel())
