"""Relocalisation: where the scene around the target's last sight is in a later image.

What is chained from image to image is lost in a fast pan, a cut or seconds of blur. A keyframe keeps the corners of
the image in which the target was seen last; once part of that scene is back in the image, their descriptors (ORB,
Rublee et al., ICCV 2011) give the map from there at once.
"""

from __future__ import annotations

import cv2
import numpy as np
import numpy.typing as npt

from protocols.geometry.types import Floats

Gray = npt.NDArray[np.uint8]

_CORNERS = 350
_MIN_INLIERS = 18
_MIN_SHARE = 0.3  # of the matches that agree
_RANSAC_PX = 2.5


class Keyframe:
    """The corners of one image (h, w)."""

    def __init__(self, gray: Gray) -> None:
        self._points, self._descriptors = _describe(gray)

    def locate(self, gray: Gray) -> Floats | None:
        """Similarity (2, 3) to another image from this one; None where too little of it is there."""
        points, descriptors = _describe(gray)
        if min(len(points), len(self._points)) < _MIN_INLIERS:
            return None
        matches = cv2.BFMatcher(cv2.NORM_HAMMING, crossCheck=True).match(self._descriptors, descriptors)
        if len(matches) < _MIN_INLIERS:
            return None
        old = self._points[[m.queryIdx for m in matches]]
        new = points[[m.trainIdx for m in matches]]
        matrix, inlier = cv2.estimateAffinePartial2D(old, new, method=cv2.RANSAC, ransacReprojThreshold=_RANSAC_PX)
        if matrix is None or inlier.sum() < max(_MIN_INLIERS, _MIN_SHARE * len(matches)):
            return None
        zoom = float(np.hypot(matrix[0, 0], matrix[1, 0]))
        return np.asarray(matrix, np.float64) if 0.4 < zoom < 2.5 else None


def _describe(gray: Gray) -> tuple[npt.NDArray[np.float32], npt.NDArray[np.uint8]]:
    finder = cv2.ORB.create(nfeatures=_CORNERS, scaleFactor=1.3, nlevels=4, fastThreshold=8)
    corners, descriptors = finder.detectAndCompute(gray, None)
    if descriptors is None:
        return np.zeros((0, 2), np.float32), np.zeros((0, 32), np.uint8)
    return np.array([corner.pt for corner in corners], np.float32), np.asarray(descriptors, np.uint8)
