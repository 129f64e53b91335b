"""Colours of eight bits a channel in bins: their histogram, and tables over the bins."""

from __future__ import annotations

import numpy as np
import numpy.typing as npt

from protocols.geometry import kernels
from protocols.geometry.types import Floats, Image, Singles


def values(table: Singles, colours: Image, bits: int) -> Singles:
    """Entries (...) of a table (8**bits,) at colours (..., 3)."""
    if not kernels.AVAILABLE:
        return table[_bin_index(colours, bits)]
    out = np.empty(colours.shape[:-1], np.float32)
    kernels.call("colour_values", out.size, np.ascontiguousarray(colours), bits, table, out)
    return out


def histogram(colours: Image, weights: Floats | None, bits: int, side: float) -> Floats:
    """Sums (8**bits,) of weights (...), or numbers, of colours (..., 3), smoothed along each channel.

    side: share that a bin gets of either neighbour.
    """
    bins, centre = 1 << bits, 1.0 - 2.0 * side
    if kernels.AVAILABLE:
        out, colours = np.empty(bins**3), np.ascontiguousarray(colours)
        kernels.call("colour_histogram", colours.size // 3, colours, weights, bits, centre, side, out)
        return out
    of_bin = None if weights is None else weights.ravel()
    cube = np.bincount(_bin_index(colours, bits).ravel(), of_bin, bins**3).reshape(bins, bins, bins)
    for axis in range(3):
        padded = np.pad(cube, [(1, 1) if k == axis else (0, 0) for k in range(3)])
        beside = np.take(padded, range(bins), axis) + np.take(padded, range(2, bins + 2), axis)
        cube = centre * cube + side * beside
    return np.asarray(cube.ravel(), dtype=np.float64)


def _bin_index(colours: Image, bits: int) -> npt.NDArray[np.int64]:
    q = (colours >> (8 - bits)).astype(np.int64)
    return np.asarray((q[..., 0] << 2 * bits) + (q[..., 1] << bits) + q[..., 2])
