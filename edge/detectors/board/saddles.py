"""Where a chessboard may be: saddle points of the grey levels that are linked as neighbouring corners are.

At a corner of a chessboard the grey levels are those of a saddle, and its neighbours' saddles are turned by 90 degrees
against it, along the edges of the squares. Saddles in other textures are not turned alike, so that their links stay
few (of Duda and Frese, "Accurate Detection and Localization of Checkerboard Corners", BMVC 2018, the idea that corners
come first and the grid next; the measure on a ring is that of Bennett and Lasenby, "ChESS", CVIU 2014).
"""

from __future__ import annotations

import cv2
import numpy as np
import numpy.typing as npt
from scipy.sparse import coo_array
from scipy.sparse.csgraph import connected_components
from scipy.spatial import KDTree

from protocols.geometry.types import Bools, Floats

Complexes = npt.NDArray[np.complex128]

_SIGMA = 1.5  # px: smoothing before derivatives
_MIN_CONTRAST = 8.0  # grey levels between dark and light squares
_MOST = 4000  # strongest saddles
_RING = 5  # px: radius at which a saddle's phase is measured
_NEIGHBOURS = 12  # in a board tilted by 60 degrees, the next corner across is the ninth at worst
_ANGLE = np.radians(45.0)  # of a phase, which is twice an angle, from that of ideal corners, seen straight
_BEND = 0.3  # of the step between corners to the next
_SHARE = 0.6  # of the second harmonic in the variance on the ring; 0.81 round an ideal corner, seen straight


def linked_saddles(grey: npt.NDArray[np.uint8], least: int) -> list[tuple[Floats, Floats, int]]:
    """Boxes (low, high; each x, y in px) round groups of at least ``least`` linked corners, the largest first.

    The third value is the number of corners.
    """
    pixels, phase = _saddles(grey)
    if len(pixels) < least:
        return []
    near = np.asarray(KDTree(pixels).query(pixels, min(_NEIGHBOURS + 1, len(pixels)))[1])[:, 1:]
    step = pixels[near] - pixels[:, None]
    linked = _are_neighbours(step, phase[:, None], phase[near])
    # Corners lie in rows: of a link counts what goes on, as far and as straight, on the corner's other side.
    inner = np.flatnonzero(linked.sum(axis=1) > 1)
    near, step, linked = near[inner], step[inner], linked[inner]
    size = np.linalg.norm(step, axis=2)
    bend = np.linalg.norm(step[:, :, None] + step[:, None], axis=3) < 0.5 * _BEND * (size[:, :, None] + size[:, None])
    linked &= (bend & linked[:, :, None] & linked[:, None]).any(axis=2)
    first, place = np.nonzero(linked)
    first, second = inner[first], near[first, place]
    graph = coo_array((np.ones(len(first)), (first, second)), shape=(len(pixels), len(pixels)))
    count, group = connected_components(graph, directed=False)
    sizes = np.bincount(group, minlength=count)
    members = [pixels[group == k] for k in np.argsort(-sizes, kind="stable") if sizes[k] >= least]
    return [(one.min(axis=0), one.max(axis=0), len(one)) for one in members]


def _saddles(grey: npt.NDArray[np.uint8]) -> tuple[Floats, Complexes]:
    """Pixels (n, 2) of saddle points, and their second harmonic on a ring (n,), of absolute value 1."""
    smooth = cv2.GaussianBlur(grey.astype(np.float32), (0, 0), _SIGMA)
    xx, xy, yy = (cv2.Sobel(smooth, cv2.CV_32F, *order, ksize=3) for order in ((2, 0), (1, 1), (0, 2)))
    saddle = (0.25 * xy) ** 2 - (0.25 * xx) * (0.25 * yy)
    # A corner of contrast C, smoothed by s, has the mixed derivative C / (pi s^2), and the others are 0.
    weakest = (_MIN_CONTRAST / (np.pi * _SIGMA**2)) ** 2
    peak = (saddle > weakest) & (saddle >= cv2.dilate(saddle, np.ones((5, 5), np.uint8)))
    peak[: _RING + 1] = peak[-_RING - 1 :] = peak[:, : _RING + 1] = peak[:, -_RING - 1 :] = False
    rows, columns = np.nonzero(peak)
    if len(rows) > _MOST:
        best = np.argpartition(-saddle[rows, columns], _MOST)[:_MOST]
        rows, columns = rows[best], columns[best]
    angles = np.arange(16) * np.pi / 8
    x, y = (np.rint(_RING * part(angles)).astype(int) for part in (np.cos, np.sin))
    ring = smooth[rows[:, None] + y, columns[:, None] + x].astype(np.float64)
    ring -= ring.mean(axis=1, keepdims=True)
    second = ring @ np.exp(2j * angles) / 8.0
    share = 0.5 * np.abs(second) ** 2 / np.maximum((ring**2).mean(axis=1), 1e-9)
    good = share > _SHARE
    return np.column_stack([columns, rows])[good].astype(np.float64), (second / np.abs(second))[good]


def _are_neighbours(step: Floats, first: Complexes, second: Complexes) -> Bools:
    """Whether saddles a step (..., 2) apart are turned against each other, and the step follows the edges of both."""
    along = np.exp(2j * np.arctan2(step[..., 1], step[..., 0]))
    opposite = (first * second.conj()).real < -np.cos(_ANGLE)
    edges = [np.abs((one.conj() * along).real) < np.sin(_ANGLE) for one in (first, second)]
    return np.asarray(opposite & edges[0] & edges[1])
