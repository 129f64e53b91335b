"""Black bars above and below a picture, or beside it: of a recorder or a screen of another shape.

They are no part of the view: behind a bar a target is as much out of the picture as beyond the image's border.
"""

from __future__ import annotations

import cv2
import numpy as np

from protocols.geometry.types import Image

_BLACK = 32  # grey levels: what an encoder leaves of black beside a bright edge
_LIT = 0.1  # share of a row's pixels that are lighter in a picture, but not in a bar with text
_EQUAL_PX, _LEAST_PX = 2, 4  # difference of two bars, for a dark sky has none opposite; width of one
_LEAST_SHARE = 0.3  # of a side that is picture: an upright one has 0.316 of a wide one; a hot spot on cold ground less
_FLAT = 1.0  # grey levels between the quartiles of a bar: text and a poor encoder leave 0, noise of a dark ground 2


def picture_area(image: Image) -> tuple[int, int, int, int]:
    """x, y, width, height [px] of the picture in an image (H, W, 3); all of the image where it has no bars."""
    dark = np.asarray(cv2.inRange(image, (0, 0, 0), (_BLACK,) * 3), np.uint8)
    y, height = _between(image, dark)
    x, width = _between(image.transpose(1, 0, 2), dark.T)
    return x, y, width, height


def _between(image: Image, dark: Image) -> tuple[int, int]:
    """Start and number of the rows between two equal bars; all where there are none. dark: (H, W), 255 where it is."""
    rows = np.flatnonzero(dark.mean(axis=1) < 255.0 * (1.0 - _LIT))
    if not rows.size:
        return 0, len(dark)
    low, end = int(rows[0]), int(rows[-1]) + 1
    high = len(dark) - end
    if min(low, high) < _LEAST_PX or abs(low - high) > _EQUAL_PX or end - low < _LEAST_SHARE * len(dark):
        return 0, len(dark)
    quartiles = np.quantile(np.concatenate([image[:low], image[end:]]), (0.25, 0.75), axis=(0, 1))
    return (0, len(dark)) if np.ptp(quartiles, axis=0).max() > _FLAT else (low, end - low)
