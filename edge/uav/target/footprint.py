"""The target's footprint: from its bounding box in the image to a rectangle on the ground, and back."""

from __future__ import annotations

import numpy as np

from edge.uav.ground.image_plane import ImagePlane
from protocols.geometry.types import Floats

_ASPECT = 0.45  # width over length of a car, where the box does not determine it
_MIN_ASPECT, _MAX_ASPECT = 0.25, 0.8  # of vehicles: beyond, the box is inexact, and a car's ratio is taken
AROUND = 0.25 * np.array([[1.0, 0.0], [-1.0, 0.0], [0.0, 1.0], [0.0, -1.0]])
"""Points [ground units] between which the derivative by ground coordinates is taken."""


def pixel_jacobian(plane: ImagePlane, matrix: Floats, position: Floats) -> Floats:
    """Derivative (2, 2) of image pixels by ground coordinates at a ground point (2,), by differences."""
    return jacobian_of(plane.project(matrix, position + AROUND))


def jacobian_of(pixels: Floats) -> Floats:
    """The same from the pixels (4, 2) of the points ``AROUND`` it."""
    return np.asarray((pixels[::2] - pixels[1::2]).T / (2.0 * AROUND[0, 0]))


def footprint_from_box(along: float, across: float, turn: float) -> tuple[float, float]:
    """Length and width of a car whose upright box is ``along`` x ``across`` when it is rotated by ``turn`` in it.

    along = l |cos| + w |sin|, across = l |sin| + w |cos|: solved where that is well conditioned and gives a car's
    aspect ratio, else for a typical aspect ratio.
    """
    c, s = abs(float(np.cos(turn))), abs(float(np.sin(turn)))
    determinant = c * c - s * s
    if abs(determinant) > 0.35:
        length = (along * c - across * s) / determinant
        width = (across * c - along * s) / determinant
        if length > 0 and _MIN_ASPECT < width / length < _MAX_ASPECT:
            return length, width
    a, b = c + _ASPECT * s, s + _ASPECT * c
    length = (a * along + b * across) / (a * a + b * b)
    return length, _ASPECT * length


def corners(position: Floats, heading: float, length: float, width: float) -> Floats:
    """(4, 2) ground corners of a rectangle about a position (2,)."""
    c, s = np.cos(heading), np.sin(heading)
    forward, right = 0.5 * length * np.array([c, s]), 0.5 * width * np.array([-s, c])
    return np.array(
        [position + forward + right, position + forward - right, position - forward - right, position - forward + right]
    )


def edge_points(corners: Floats) -> Floats:
    """(16, 2) points along the sides of a quadrilateral (4, 2)."""
    fraction = np.linspace(0.0, 1.0, 4, endpoint=False)[:, None]
    return np.concatenate([a + fraction * (b - a) for a, b in zip(corners, np.roll(corners, -1, axis=0), strict=True)])
