"""Validation of a target bounding box that a user drew."""

from __future__ import annotations

import numpy as np

from edge.uav.base import Box, Image
from protocols.core.errors import InputError

_MIN_BOX_PX = 4.0  # side
_MIN_INSIDE_SHARE = 0.3  # share of the box


def check_target_box(image: Image, size: tuple[int, int], target: Box) -> None:
    """Raises InputError for a box that cannot be a target, or for an image of another size."""
    width, height = size
    if image.ndim != 3 or image.shape[:2] != (height, width):
        raise InputError(f"an image of {image.shape[1]}x{image.shape[0]}, not {width}x{height}", remedy="check --rig")
    values = (target.x, target.y, target.width, target.height)
    text = ",".join(f"{value:g}" for value in values)
    if not np.isfinite(values).all():
        raise InputError(f"target {text} is not finite", remedy="give x,y,w,h in pixels")
    if min(target.width, target.height) < _MIN_BOX_PX:
        remedy = f"draw a box of at least {_MIN_BOX_PX:g} pixels a side round the car"
        raise InputError(f"target {text} is too small to be recognised", remedy=remedy)
    overlap_x = min(target.x + target.width, width) - max(target.x, 0.0)
    overlap_y = min(target.y + target.height, height) - max(target.y, 0.0)
    if min(overlap_x, overlap_y) <= 0 or overlap_x * overlap_y < _MIN_INSIDE_SHARE * target.width * target.height:
        raise InputError(
            f"target {text} is outside the image of {width}x{height}", remedy="give x,y,w,h of a car in the image"
        )
    if target.width * target.height > 0.5 * width * height:
        raise InputError(f"target {text} fills the image", remedy="draw the box round one target")
