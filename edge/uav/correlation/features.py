"""Dense cell features of an image patch: orientation histograms (HOG), lightness and colour.

Histograms of oriented gradients after Dalal and Triggs (2005), here without blocks: each cell is normalised by the
energy of its 3x3 neighbourhood. Lightness and the two colour axes of CIE L*a*b* are averaged over the cell.
"""

from __future__ import annotations

import cv2
import numpy as np
import numpy.typing as npt

from protocols.geometry import kernels
from protocols.geometry.types import Image

Features = npt.NDArray[np.float32]

ORIENTATIONS = 9  # as in Felzenszwalb's HOG
CHANNELS = ORIENTATIONS + 3
_CLIP = 0.4  # of a normalised histogram entry: one strong edge does not make the cell
_NOISE_LEVEL = 4.0  # gradient [grey levels a pixel] of sensor noise and compression, which gets no unit contrast
_COLOUR_GAIN = 1.0 / 48.0  # a difference of 48 grey levels counts as much as a full histogram entry


def cell_features(patch: Image, cell: int = 4) -> Features:
    """Features (12, h / cell, w / cell) of a patch (h, w, 3) BGR: nine orientations, lightness, two colours."""
    height, width = patch.shape[:2]
    size = (width // cell, height // cell)
    lab = cv2.cvtColor(patch, cv2.COLOR_BGR2LAB)
    lightness = cv2.extractChannel(lab, 0).astype(np.float32)
    across, down = (cv2.Sobel(lightness, cv2.CV_32F, *axis, ksize=1) for axis in ((1, 0), (0, 1)))
    magnitude, angle = (np.asarray(one, np.float32) for one in cv2.cartToPolar(across, down))
    out = np.empty((CHANNELS, size[1], size[0]), np.float32)
    histogram = out[:ORIENTATIONS]
    if kernels.AVAILABLE and (height % cell, width % cell) == (0, 0):
        kernels.orientation_cells(magnitude, angle, cell, histogram)
    else:
        _orientation_cells(magnitude, angle, size, histogram)
    energy = cv2.boxFilter(np.square(histogram).sum(axis=0), -1, (3, 3))
    histogram /= np.sqrt(energy + np.float32(_NOISE_LEVEL**2))
    np.minimum(histogram, np.float32(_CLIP), out=histogram)
    histogram *= np.float32(1.0 / _CLIP)
    small = cv2.resize(lab, size, interpolation=cv2.INTER_AREA).astype(np.float32)
    out[ORIENTATIONS:] = (np.moveaxis(small, 2, 0) - np.float32(128.0)) * np.float32(_COLOUR_GAIN)
    return out


def _orientation_cells(magnitude: Features, angle: Features, size: tuple[int, int], out: Features) -> None:
    """Into ``out`` (9, rows, columns) the means over cells of gradients (h, w) by orientation. size: columns, rows."""
    at = angle * np.float32(ORIENTATIONS / np.pi)
    at[at >= ORIENTATIONS] -= ORIENTATIONS
    for orientation in range(ORIENTATIONS):
        away = np.abs(at - np.float32(orientation))
        if orientation == 0:
            away = np.minimum(away, ORIENTATIONS - away)
        share = np.maximum(np.float32(1.0) - away, np.float32(0.0))
        out[orientation] = cv2.resize(magnitude * share, size, interpolation=cv2.INTER_AREA)
