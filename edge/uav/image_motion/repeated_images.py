"""Images that repeat an earlier one: of a stream whose link stalls, or whose frame rate was converted.

They show no later moment. Tracked as if they did, everything has stopped, and then jumps.
"""

from __future__ import annotations

import cv2
import numpy as np

from protocols.geometry.types import Image

_ROWS = 64  # px: one row of so many tells nearly every pair apart
_BLOCK = 16  # px: the smallest target is seen in the mean of such a block
_MOST_CHANGE = 7  # grey levels, of any block's mean: H.264 refines a repeated image by 0 to 7, real ones differ by 9


def is_repeated(earlier: Image, image: Image) -> bool:
    """Whether an image (H, W, 3) shows what an earlier one does, up to what an encoder makes of the same picture."""
    if earlier.shape != image.shape or cv2.absdiff(earlier[::_ROWS], image[::_ROWS]).mean() > 1.0:
        return False
    height, width = image.shape[:2]
    blocks = max(width // _BLOCK, 1), max(height // _BLOCK, 1)
    change = cv2.resize(cv2.absdiff(earlier, image), blocks, interpolation=cv2.INTER_AREA)
    return int(np.max(change)) <= _MOST_CHANGE
