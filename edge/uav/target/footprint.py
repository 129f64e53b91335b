"""The target's outline: from its box in the picture to a rectangle on the ground, and back."""

from __future__ import annotations

import numpy as np

from edge.uav.ground.image_plane import ImagePlane, transfer
from protocols.geometry.types import Floats

_SLIM = 0.45  # width over length of a car, where the box can't tell
_SLIMMEST, _STOUTEST = 0.25, 0.8


def local_axes(plane: ImagePlane, matrix: Floats, place: Floats) -> Floats:
    """Derivative (2, 2) of image pixels by ground coordinates at a ground point (2,), by differences."""
    step = 0.25
    points = place + step * np.array([[1.0, 0.0], [-1.0, 0.0], [0.0, 1.0], [0.0, -1.0]])
    seen = plane.pixels(transfer(matrix, points))
    return np.asarray(np.column_stack([seen[0] - seen[1], seen[2] - seen[3]]) / (2.0 * step))


def oriented(along: float, across: float, turn: float) -> tuple[float, float]:
    """Length and width of a car whose upright box is ``along`` x ``across`` when it is turned by ``turn`` in it.

    along = l |cos| + w |sin|, across = l |sin| + w |cos|: solved where that is well conditioned and gives a car's
    shape, else for a car's usual shape.
    """
    c, s = abs(float(np.cos(turn))), abs(float(np.sin(turn)))
    determinant = c * c - s * s
    if abs(determinant) > 0.35:
        length = (along * c - across * s) / determinant
        width = (across * c - along * s) / determinant
        if length > 0 and _SLIMMEST < width / length < _STOUTEST:
            return length, width
    a, b = c + _SLIM * s, s + _SLIM * c
    length = (a * along + b * across) / (a * a + b * b)
    return length, _SLIM * length


def corners(place: Floats, heading: float, length: float, width: float) -> Floats:
    """(4, 2) ground corners of a rectangle about a place (2,)."""
    c, s = np.cos(heading), np.sin(heading)
    forward, right = 0.5 * length * np.array([c, s]), 0.5 * width * np.array([-s, c])
    return np.array(
        [place + forward + right, place + forward - right, place - forward - right, place - forward + right]
    )


def between(corners: Floats) -> Floats:
    """(16, 2) points along the sides of a quadrilateral (4, 2)."""
    share = np.linspace(0.0, 1.0, 4, endpoint=False)[:, None]
    return np.concatenate([a + share * (b - a) for a, b in zip(corners, np.roll(corners, -1, axis=0), strict=True)])
