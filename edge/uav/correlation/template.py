"""Templates: unit vectors of the cells of a box, and their whitening by what the places of a scene look like."""

from __future__ import annotations

import cv2
import numpy as np

from edge.uav.correlation.features import CHANNELS, Features, cell_features
from edge.uav.correlation.oriented_box import OrientedBox, crop
from protocols.geometry.types import Image

CELLS, CELL_PX = 6, 4  # along a side; along a cell: finer cells need a more exact place, coarser ones look alike
SIDE = CELLS * CELL_PX
VECTOR = CHANNELS * CELLS**2
"""Numbers of a box."""
CENTRED = np.float32(0.5)  # share of a channel's mean that is taken out
_COLOUR_WEIGHT = np.float32(1.3)
_SAMPLED = 300  # places of the first image: too few for a covariance without shrinkage
_STEPS = np.array([0.8191725134, 0.6710436067, 0.5497004779])  # of a sequence that fills a cube evenly (Roberts 2018)
_BESIDE = 0.8  # distance from the target's centre, in sides of its box, from which a place shows something else
_NO_TEXTURE = 1e-9  # variance of a plain scene: all directions are alike
_SHRINKAGE = 4.0
"""Weight of the mean variance in all directions, beside the covariance's own: with 1 and 4, when scans were whitened,
too, 66 and 67 of 94 nadir windows and 30 and 31 of 42 oblique ones were held."""


def weighted(features: Features) -> Features:
    """Cell features (12, h, w) with the weight of lightness and colours."""
    out = features.copy()
    out[-3:] *= _COLOUR_WEIGHT
    return out


def vectors(image: Image, boxes: list[OrientedBox]) -> Features:
    """Unit vectors (n, 432) of boxes: their cells, each channel partly without its mean."""
    side = SIDE + 2 * CELL_PX  # a cell around, which the features of the outer cells need
    patches = np.concatenate([crop(image, box.sized(box.sides * side / SIDE), (side, side)) for box in boxes])
    cells = weighted(cell_features(patches, CELL_PX)).reshape(-1, len(boxes), CELLS + 2, CELLS + 2)
    features = cells[:, :, 1:-1, 1:-1].transpose(1, 0, 2, 3).reshape(len(boxes), -1, CELLS * CELLS)
    flat = (features - CENTRED * features.mean(axis=2, keepdims=True)).reshape(len(boxes), -1)
    return np.asarray(flat / (np.linalg.norm(flat, axis=1, keepdims=True) + 1e-6), np.float32)


class Whitening:
    """What places of a scene have in common does not tell the target from them (Hariharan, Malik and Ramanan 2012).

    Vectors without the mean of places beside the target, and with their shrunk covariance (Ledoit and Wolf 2004) as the
    unit matrix.
    """

    def __init__(self, image: Image, target: OrientedBox) -> None:
        """Learn from places all over the image, of the target's size and at any angle. target: its box, left out."""
        places = np.arange(1, _SAMPLED + 1)[:, None] * _STEPS % 1.0
        centres = places[:, :2] * [image.shape[1], image.shape[0]]
        beside = (np.abs(centres - target.centre) > _BESIDE * target.extent).any(axis=1)
        step = max(int(target.sides.min() / SIDE), 1)  # finer pixels would be averaged at each place
        reduced = cv2.resize(image, None, fx=1.0 / step, fy=1.0 / step, interpolation=cv2.INTER_AREA)
        boxes = [
            target.at(centre).turned(2.0 * np.pi * turn).sized(target.sides / step)
            for centre, turn in zip(centres[beside] / step, places[beside, 2].tolist(), strict=True)
        ]
        self._mean, self._matrix = np.zeros(VECTOR, np.float32), np.eye(VECTOR, dtype=np.float32)
        if len(boxes) > 1:  # else the target fills the image, and vectors stay as they are
            seen = vectors(np.asarray(reduced, np.uint8), boxes)
            self._mean, covariance = seen.mean(axis=0), np.cov(seen.T)
            covariance[np.diag_indices(VECTOR)] += _SHRINKAGE * np.trace(covariance) / VECTOR + _NO_TEXTURE
            self._matrix = np.linalg.inv(np.linalg.cholesky(covariance)).T.astype(np.float32)

    def of(self, found: Features) -> Features:
        """Unit vectors (n, 432) of those of ``vectors``."""
        flat = (found - self._mean) @ self._matrix
        return np.asarray(flat / (np.linalg.norm(flat, axis=1, keepdims=True) + 1e-6), np.float32)
