"""Validation of the initial target box and of frames; visible share of a box."""

from __future__ import annotations

import numpy as np
import numpy.typing as npt

from edge.uav.base import Box, Image
from protocols.core.errors import InputError

_MIN_SIDE = 4.0  # px: below this a box holds too few pixels for a histogram
_MIN_VISIBLE_SHARE = 0.25  # of the box that must lie in the image


def check_target(target: Box, size: tuple[int, int]) -> None:
    """Raises InputError for a box that is not finite, smaller than 4 px or mostly outside an image of size (w, h)."""
    remedy = "give x,y,w,h in pixels, x and y the top left corner, around the car in its first frame"
    if not np.isfinite([target.x, target.y, target.width, target.height]).all():
        raise InputError("the target's box has a value that is not finite", remedy=remedy)
    if target.width < _MIN_SIDE or target.height < _MIN_SIDE:
        raise InputError(
            f"the target's box is {target.width:g} x {target.height:g} px; at least 4 x 4 is needed", remedy=remedy
        )
    if visible_share(target.x + target.width / 2, target.y + target.height / 2, target, size) < _MIN_VISIBLE_SHARE:
        raise InputError(
            f"the target's box {target.x:g},{target.y:g},{target.width:g},{target.height:g} lies outside the image of "
            f"{size[0]} x {size[1]} px",
            remedy=remedy,
        )


def check_image(image: npt.NDArray[np.uint8], size: tuple[int, int]) -> None:
    """Raises InputError if the first frame is no BGR image of the given size (w, h)."""
    if not has_frame_format(image, size):
        raise InputError(
            f"the first frame has the shape {image.shape}, not {(size[1], size[0], 3)}",
            remedy="construct the tracker with the video's own size",
        )


def has_frame_format(image: Image, size: tuple[int, int]) -> bool:
    """Whether it is a BGR image (h, w, 3) of bytes of the given size (w, h)."""
    return image.shape == (size[1], size[0], 3) and image.dtype == np.uint8


def visible_share(x: float, y: float, box: Box, size: tuple[int, int]) -> float:
    """The share, 0..1, of a box of box's size about (x, y) that lies in an image of size (w, h)."""
    wide = min(x + box.width / 2, size[0]) - max(x - box.width / 2, 0.0)
    high = min(y + box.height / 2, size[1]) - max(y - box.height / 2, 0.0)
    return max(wide, 0.0) * max(high, 0.0) / (box.width * box.height)
