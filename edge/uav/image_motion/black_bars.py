"""Black bars above and below a picture, or beside it: of a recorder or a screen of another shape.

They are no part of the view: behind a bar a target is as much out of the picture as beyond the image's border.
"""

from __future__ import annotations

import numpy as np

from protocols.geometry.types import Bools, Image

_BLACK = 32  # grey levels: what an encoder leaves of black beside a bright edge
_LIT = 0.1  # share of a row's pixels that are lighter in a picture, but not in a bar with text
_EQUAL_PX, _LEAST_PX = 2, 4  # difference of two bars, for a dark sky has none opposite; width of one


def picture_area(image: Image) -> tuple[int, int, int, int]:
    """x, y, width, height [px] of the picture in an image (H, W, 3); all of the image where it has no bars."""
    lit = image.max(axis=2) > _BLACK
    (y, height), (x, width) = (_between(lit.mean(axis=axis) > _LIT) for axis in (1, 0))
    return x, y, width, height


def _between(lit: Bools) -> tuple[int, int]:
    """Start and length of what lies between two equal dark ends; all where they are not equal."""
    rows = np.flatnonzero(lit)
    if not rows.size:
        return 0, len(lit)
    low, high = int(rows[0]), len(lit) - 1 - int(rows[-1])
    if min(low, high) < _LEAST_PX or abs(low - high) > _EQUAL_PX:
        return 0, len(lit)
    return low, len(lit) - low - high
