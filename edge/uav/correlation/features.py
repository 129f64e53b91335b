"""Dense cell features of an image patch: orientation histograms (HOG), lightness and colour.

Histograms of oriented gradients after Dalal and Triggs (2005), here without blocks: each cell is normalised by the
energy of its 3x3 neighbourhood. Lightness and the two colour axes of CIE L*a*b* are averaged over the cell.
"""

from __future__ import annotations

import cv2
import numpy as np
import numpy.typing as npt

from edge.uav.base import Image

Features = npt.NDArray[np.float32]

ORIENTATIONS = 9  # as in Felzenszwalb's HOG
CHANNELS = ORIENTATIONS + 3
_CLIP = 0.4  # of a normalised histogram entry: one strong edge does not make the cell
_NOISE_LEVEL = 4.0  # gradient [grey levels a pixel] of sensor noise and compression, which gets no unit contrast
_LEVELS = 14  # of the angle from one orientation to the next: 1.4 degrees each, and a turn fits a byte
# Shares (9, 256) of the orientations at each level of the angle: linear between neighbours, alike after half a turn.
_SHARES = np.arange(256) / _LEVELS - np.arange(ORIENTATIONS)[:, None] + 0.5 * ORIENTATIONS
_SHARES = np.maximum(1.0 - np.abs(_SHARES % ORIENTATIONS - 0.5 * ORIENTATIONS), 0.0).astype(np.float32)
_COLOUR_GAIN = 1.0 / 48.0  # a difference of 48 grey levels counts as much as a full histogram entry


def cell_features(patch: Image, cell: int = 4) -> Features:
    """Features (12, h / cell, w / cell) of a patch (h, w, 3) BGR: nine orientations, lightness, two colours."""
    height, width = patch.shape[:2]
    size = (width // cell, height // cell)
    lab = cv2.cvtColor(patch, cv2.COLOR_BGR2LAB)
    lightness = cv2.extractChannel(lab, 0)
    magnitude, angle = cv2.cartToPolar(
        cv2.Sobel(lightness, cv2.CV_32F, 1, 0, ksize=1), cv2.Sobel(lightness, cv2.CV_32F, 0, 1, ksize=1)
    )
    at = cv2.convertScaleAbs(angle, alpha=_LEVELS * ORIENTATIONS / np.pi)
    out = np.empty((CHANNELS, size[1], size[0]), np.float32)
    for orientation, shares in enumerate(_SHARES):
        cv2.resize(cv2.multiply(magnitude, cv2.LUT(at, shares)), size, out[orientation], interpolation=cv2.INTER_AREA)
    histogram = out[:ORIENTATIONS]
    energy = cv2.boxFilter(np.square(histogram).sum(axis=0), -1, (3, 3))
    histogram /= np.sqrt(energy + np.float32(_NOISE_LEVEL**2))
    np.minimum(histogram, np.float32(_CLIP), out=histogram)
    histogram *= np.float32(1.0 / _CLIP)
    small = cv2.resize(lab, size, interpolation=cv2.INTER_AREA).astype(np.float32)
    out[ORIENTATIONS:] = (np.moveaxis(small, 2, 0) - np.float32(128.0)) * np.float32(_COLOUR_GAIN)
    return out
