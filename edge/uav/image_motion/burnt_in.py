"""What is burnt into the picture, as an on-screen display is: it stands still in the picture while the scene moves.

Its corners are sharper than those of the ground, and agree with each other that nothing moves. They are found out where
the picture as a whole has changed meanwhile, and corners elsewhere agree on another motion.
"""

from __future__ import annotations

import cv2
import numpy as np
import numpy.typing as npt

from protocols.geometry.types import Floats

Gray = npt.NDArray[np.uint8]

_REDUCTION = 4  # of the images that are compared: the noise of a pixel leaves no change
_COARSE_PX = 9  # side of the neighbourhood over which brightness may change [px, reduced]
_STOOD_PX = 0.5  # of a corner [px of the working image]: ten times the error of a sharp one
ALIKE = 0.8  # correlation of pictures of one scene from one place; noise of 3 levels at dusk leaves 0.9
_REACH_PX = 12  # about such a corner within which others are burnt in, too: the spacing of corners [px]
_MOST = 0.65  # share of the picture that is left: a display takes 0.23 to 0.30, what strong compression freezes more


class BurntIn:
    """mask: (h, w) of the working image, 255 where the scene may be seen, 0 on what is burnt in."""

    def __init__(self, size: tuple[int, int]) -> None:
        self.mask = np.full(size[::-1], 255, np.uint8)
        self._since: Floats | None = None  # detail of the picture since which nothing seems to have moved
        self._moved: Floats = np.zeros((2, 2))  # of two corners of the picture meanwhile

    def contradicts(self, gray: Gray, matrix: Floats) -> bool:
        """Whether a picture has changed while the motions (2, 3) since an earlier one say that nothing has moved."""
        self._moved = self._moved + shift(gray, matrix)
        if self._since is not None and np.abs(self._moved).max() < 2.0 * _STOOD_PX:
            return float((detail(gray) * self._since).sum()) < ALIKE
        self._since, self._moved = detail(gray), np.zeros((2, 2))
        return False

    def restart(self) -> None:
        """The motion is not known in one image."""
        self._since = None

    def without(self, points: Floats) -> Gray:
        """The mask without what lies about corners (n, 2); the mask itself where too little would be left."""
        mask = self.mask.copy()
        for x, y in points.astype(int):
            mask[max(y - _REACH_PX, 0) : y + _REACH_PX + 1, max(x - _REACH_PX, 0) : x + _REACH_PX + 1] = 0
        return mask if cv2.countNonZero(mask) > _MOST * mask.size else self.mask

    def filled(self, gray: Gray, mask: Gray) -> Gray:
        """The image with what is burnt in replaced by what lies around."""
        if cv2.countNonZero(mask) == mask.size:
            return gray
        # Less than the corners are kept away from: no edge of it is one.
        mask = np.asarray(cv2.dilate(mask, np.ones((7, 7), np.uint8)), np.uint8)
        weight = cv2.boxFilter(mask, cv2.CV_32F, (4 * _REACH_PX + 1,) * 2)
        around = cv2.boxFilter(cv2.bitwise_and(gray, mask), cv2.CV_32F, (4 * _REACH_PX + 1,) * 2)
        level = np.asarray(np.clip(255.0 * around / np.maximum(weight, 1.0), 0, 255), np.uint8)
        return np.asarray(np.where(mask > 0, gray, level), np.uint8)


def shift(gray: Gray, matrix: Floats) -> Floats:
    """By how much two corners (2, 2) of the picture are moved by a map (2, 3) [px]."""
    corner = np.array([[0.0, 0.0], gray.shape[::-1]])
    return np.asarray(corner @ matrix[:, :2].T + matrix[:, 2] - corner)


def stood(old: Floats, new: Floats) -> Floats:
    """The corners of ``old`` (n, 2) that are at the same place in ``new`` [px of the working image]."""
    return np.asarray(old[np.abs(new - old).max(axis=1, initial=0.0) < _STOOD_PX])


def detail(gray: Gray) -> Floats:
    """The reduced picture without its coarse brightness, as a unit vector, (h, w)."""
    small = cv2.resize(gray, None, fx=1.0 / _REDUCTION, fy=1.0 / _REDUCTION, interpolation=cv2.INTER_AREA)
    level = small.astype(np.float32)
    fine = level - cv2.blur(level, (_COARSE_PX, _COARSE_PX))
    return np.asarray(fine / (float(np.linalg.norm(fine)) + 1e-6))
