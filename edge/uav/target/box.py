"""Validation of a target bounding box that a user drew, and of frames; visible share of a box."""

from __future__ import annotations

import numpy as np

from edge.uav.base import Box
from protocols.core.errors import InputError
from protocols.geometry.types import Image

MIN_BOX_PX = 4.0  # side
_MIN_IMAGE_PX, _MOST_NARROW = 16, 50  # side of an image; ratio of its sides: reduced to work on, less has no rows
_MIN_INSIDE_SHARE = 0.3  # share of the box
_BEYOND = 1.1  # of the picture's side: a box drawn by hand may end somewhat outside


def check_target_box(image: Image, size: tuple[int, int], target: Box) -> None:
    """Raises InputError for a box that cannot be a target, or for an image of another size."""
    width, height = size
    if not has_frame_format(image, size):
        raise InputError(f"an image of {image.shape[1]}x{image.shape[0]}, not {width}x{height}", remedy="check --rig")
    needed = max(_MIN_IMAGE_PX, max(size) // _MOST_NARROW)
    if min(size) < needed:
        what = f"images of {width}x{height} are too narrow"
        raise InputError(what, remedy=f"give a video of at least {needed} pixels a side")
    values = (target.x, target.y, target.width, target.height)
    text = ",".join(f"{value:g}" for value in values)
    if not np.isfinite(values).all():
        raise InputError(f"target {text} is not finite", remedy="give x,y,w,h in pixels")
    if min(target.width, target.height) < MIN_BOX_PX:
        remedy = f"draw a box of at least {MIN_BOX_PX:g} pixels a side round it"
        raise InputError(f"target {text} is too small to be recognised", remedy=remedy)
    if visible_share(target.x + target.width / 2, target.y + target.height / 2, target, size) < _MIN_INSIDE_SHARE:
        what = f"target {text} is outside the image of {width}x{height}"
        raise InputError(what, remedy="give x,y,w,h of what is to be seen in it")
    inside = target.x < target.width <= width and target.y < target.height <= height
    if inside and (target.x + target.width > _BEYOND * width or target.y + target.height > _BEYOND * height):
        what = f"target {text} reaches beyond the image, and looks like its left, top, right and lower edge"
        raise InputError(what, remedy="give x,y,w,h with width and height")
    if target.width * target.height > 0.5 * width * height:
        raise InputError(f"target {text} fills the image", remedy="draw the box round one target")
    left, top = max(int(target.x - target.width), 0), max(int(target.y - target.height), 0)
    around = image[top : int(target.y + 2 * target.height), left : int(target.x + 2 * target.width)]
    if (around.min(axis=0).min(axis=0) == around.max(axis=0).max(axis=0)).all():  # over both at once is slow
        what = f"target {text} and all around it have one colour: it cannot be distinguished"
        raise InputError(what, remedy="select it in an image that shows it, in a video by --start FRAME")


def has_frame_format(image: Image, size: tuple[int, int]) -> bool:
    """Whether it is a BGR image (h, w, 3) of bytes of the given size (w, h)."""
    return image.shape == (size[1], size[0], 3) and image.dtype == np.uint8


def visible_share(x: float, y: float, box: Box, size: tuple[int, int]) -> float:
    """The share, 0..1, of a box of box's size about (x, y) that lies in an image of size (w, h)."""
    wide = min(x + box.width / 2, size[0]) - max(x - box.width / 2, 0.0)
    high = min(y + box.height / 2, size[1]) - max(y - box.height / 2, 0.0)
    return max(wide, 0.0) * max(high, 0.0) / (box.width * box.height)
