"""The target's footprint: from its bounding box in the image to a rectangle on the ground, and back."""

from __future__ import annotations

import numpy as np

from edge.uav.ground.image_plane import ImagePlane
from protocols.geometry.types import Floats

_ASPECT = 0.45  # width over length of a car, where the box does not determine it
_MIN_ASPECT, _MAX_ASPECT = 0.25, 0.8  # of vehicles: beyond, the box is inexact, and a car's ratio is taken
_TURN_STEP = np.deg2rad(5.0)  # between the rectangles that are compared: a template bears twice as much
_MAX_BOX_ERROR = 1.2  # of the sides of a rectangle's upright box over those drawn: hands draw no better
_MIN_EXPLAINED = 0.4  # share of the variance of evidence that a clear outline explains: camouflage leaves less
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


def oriented_rectangle(points: Floats, evidence: Floats, box: tuple[float, float]) -> tuple[float, float, float] | None:
    """Turn [rad], length and width of the rectangle within an upright ``box`` that the evidence shows; None if unclear.

    points: (n, 2) in and around the box, from its centre; evidence: (n,) log-likelihood ratio of target to background
    there. Of the box and the rectangles of a vehicle's shape in it the one is taken that explains most of its variance.
    """
    best, found = _MIN_EXPLAINED * float(evidence.var()), None
    for turn in (None, *np.arange(-0.5 * np.pi, 0.5 * np.pi, _TURN_STEP)):
        c, s = (1.0, 0.0) if turn is None else (float(np.cos(turn)), float(np.sin(turn)))
        length, width = box if turn is None else footprint_from_box(*box, turn)
        sides = np.array([[abs(c), abs(s)], [abs(s), abs(c)]]) @ [length, width] / box
        if max(sides.max(), 1.0 / sides.min()) > _MAX_BOX_ERROR:
            continue
        inside = (np.abs(points @ np.array([[c, -s], [s, c]])) <= [0.5 * length, 0.5 * width]).all(axis=1)
        share = float(inside.mean())
        if not 0.0 < share < 1.0:
            continue
        difference = float(evidence[inside].mean() - evidence[~inside].mean())
        explained = share * (1.0 - share) * difference * abs(difference)
        if explained > best:
            best, found = explained, None if turn is None else (float(turn), length, width)
    return found


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
