"""Hue-saturation histograms of many boxes at once, and their similarity to the target's (2.7, 2.8, 3.13)."""

from __future__ import annotations

from functools import cache

import cv2
import numpy as np
import numpy.typing as npt

from edge.uav.base import Box
from protocols.geometry.types import Bools, Floats, Image

Bins = npt.NDArray[np.uint8]

HUES, SATURATIONS = 12, 4  # bins: more tell similar colours apart, fewer bear other light
BINS = 1 + HUES * SATURATIONS
_SHARPNESS = 20.0  # lambda of eq. (2.8); the paper gives no value
_BITS = 5  # of each channel in the look-up table
_GREY_SATURATION = 40  # of 255: below it the hue is unreliable; such pixels share one bin
_DARK = 40  # of 255: the same for the value
_GRID = 9  # samples across a box, along each side
_MEAN_STEP = 4  # subsampling in both axes for the histogram of the whole frame


@cache
def _table() -> Bins:
    """(32768,) the bin of each quantised colour; index blue << 10 | green << 5 | red."""
    axis = (np.arange(1 << _BITS) << (8 - _BITS)) + (1 << (7 - _BITS))
    colours = np.stack(np.meshgrid(axis, axis, axis, indexing="ij"), axis=-1).reshape(1, -1, 3).astype(np.uint8)
    hue, saturation, value = np.moveaxis(cv2.cvtColor(colours, cv2.COLOR_BGR2HSV)[0].astype(np.int64), -1, 0)
    level = (saturation - _GREY_SATURATION) * SATURATIONS // (256 - _GREY_SATURATION)
    coloured = 1 + (hue * HUES // 180) * SATURATIONS + level
    return np.where((saturation < _GREY_SATURATION) | (value < _DARK), 0, coloured).astype(np.uint8)


def colour_bins(colours: npt.NDArray[np.uint8]) -> Bins:
    """The histogram bin (...) of BGR colours (..., 3). Bin 0 holds colours without a reliable hue (grey, dark)."""
    shift = 8 - _BITS
    wide = colours.astype(np.int32) >> shift
    return np.asarray(_table()[(wide[..., 0] << 2 * _BITS) | (wide[..., 1] << _BITS) | wide[..., 2]])


def target_histogram(image: Image, box: Box) -> Floats:
    """(BINS,) of the pixels of a box in the image, normalised to 1: the template p of (2.7)."""
    left, top = max(round(box.x), 0), max(round(box.y), 0)
    inside = image[top : max(round(box.y + box.height), top + 1), left : max(round(box.x + box.width), left + 1)]
    counts = np.bincount(colour_bins(inside).ravel(), minlength=BINS).astype(np.float64)
    return np.asarray(counts / max(counts.sum(), 1.0), dtype=np.float64)


def mean_histogram(image: Image) -> Floats:
    """(BINS,) of the whole frame, normalised to 1: q(I_k) of (3.13)."""
    counts = np.bincount(colour_bins(image[::_MEAN_STEP, ::_MEAN_STEP]).ravel(), minlength=BINS)
    return np.asarray(counts / counts.sum(), dtype=np.float64)


def _box_bins(image: Image, centres: Floats, box: Box) -> tuple[Bins, Bools]:
    """Bins (n, m) of a grid of pixels in boxes about centres (n, 2), and which of these pixels lie in the image.

    A pixel beyond the border gets the bin of the nearest pixel in the image.
    """
    step = (np.arange(_GRID) + 0.5) / _GRID - 0.5
    x = np.rint(centres[:, 0, None] + step * box.width)
    y = np.rint(centres[:, 1, None] + step * box.height)
    height, width = image.shape[:2]
    inside = ((y >= 0) & (y < height))[:, :, None] & ((x >= 0) & (x < width))[:, None, :]
    column = np.clip(x, 0, width - 1).astype(np.int64)[:, None, :]
    row = np.clip(y, 0, height - 1).astype(np.int64)[:, :, None]
    packed = image.reshape(-1, 3)[row * width + column]
    return colour_bins(packed).reshape(len(centres), -1), inside.reshape(len(centres), -1)


def _histograms(bins: Bins, counted: Bools | None = None) -> Floats:
    """(n, BINS) of bins (n, m), each pixel 1 / m; pixels that are not counted (n, m) are left out."""
    flat = bins + np.arange(0, len(bins) * BINS, BINS)[:, None]
    weights = None if counted is None else counted.ravel().astype(np.float64)
    counts = np.bincount(flat.ravel(), weights, minlength=len(bins) * BINS)
    return np.asarray(counts.reshape(len(bins), BINS) / bins.shape[1], dtype=np.float64)


def bhattacharyya(template: Floats, histograms: Floats) -> Floats:
    """Eq. (2.7): L = sum over u of sqrt(p_u q_u); 1 for equal histograms. (BINS,), (n, BINS) -> (n,)."""
    return np.asarray(np.sqrt(histograms) @ np.sqrt(template), dtype=np.float64)


def colour_log_likelihood(similarity: Floats) -> Floats:
    """Eq. (2.8): the logarithm of exp(-lambda (1 - L)), of similarities (n,)."""
    return np.asarray(-_SHARPNESS * (1.0 - similarity), dtype=np.float64)


def visible_similarity(image: Image, centres: Floats, box: Box, template: Floats) -> Floats:
    """Eq. (2.7) for boxes about centres (n, 2), without treatment of borders (section 2).

    Pixels outside the image match nothing: the histogram sums to the share of the box within the image.
    """
    bins, inside = _box_bins(image, centres, box)
    return bhattacharyya(template, _histograms(bins, inside))


def border_filled_similarity(image: Image, centres: Floats, box: Box, template: Floats, mean: Floats) -> Floats:
    """Eqs. (2.7) and (3.13) for boxes about centres (n, 2), by the three cases of section 3.2.

    Wholly outside: the mean histogram of the frame (BINS,) is used. Partly outside: missing pixels are filled from
    the nearest border pixels. Inside: unchanged.
    """
    bins, inside = _box_bins(image, centres, box)
    similarity = bhattacharyya(template, _histograms(bins))
    return np.where(inside.any(axis=1), similarity, bhattacharyya(template, mean[None])[0])
