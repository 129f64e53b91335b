"""Images that repeat an earlier one: of a stream whose link stalls, or whose frame rate was converted.

They show no later moment. Tracked as if they did, everything has stopped, and then jumps.
"""

from __future__ import annotations

import cv2
import numpy as np

from protocols.geometry.types import Image

_ROWS = 64  # px: one row of so many distinguishes nearly all pairs
_BLOCK = 16  # px: the smallest target is seen in the mean of such a block
_MEAN_CHANGE, _MOST_CHANGE = 0.4, 7
"""Grey levels, of the image and of any block's mean. What H.264 makes of a repeated image differs by 0.00 to 0.27 and
0 to 7; of an empty street before a camera that stands nine of ten images by 0.36 or more, and by 3 or more."""


def is_repeated(earlier: Image, image: Image) -> bool:
    """Whether an image (H, W, 3) shows what an earlier one does, up to what an encoder makes of the same picture."""
    if earlier.shape != image.shape or cv2.absdiff(earlier[::_ROWS], image[::_ROWS]).mean() > 4.0 * _MEAN_CHANGE:
        return False
    change = cv2.absdiff(earlier, image)
    if change.mean() > _MEAN_CHANGE:
        return False
    height, width = image.shape[:2]
    blocks = max(width // _BLOCK, 1), max(height // _BLOCK, 1)
    return int(np.max(cv2.resize(change, blocks, interpolation=cv2.INTER_AREA))) <= _MOST_CHANGE
