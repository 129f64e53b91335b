"""Cars: geometric model, rendering, and trajectories on the ground plane."""

from __future__ import annotations

from dataclasses import dataclass

import cv2
import numpy as np
import numpy.typing as npt

from protocols.geometry.types import Floats

LENGTH, WIDTH = 4.5, 1.9  # m, of a usual car
CENTRE_HEIGHT = 0.7  # m: height of the reference point taken as the car's centre
_BODY_TOP, _ROOF_TOP = 0.85, 1.45  # m above the ground
_SHIFT = 4  # fractional bits of OpenCV's fixed-point polygon coordinates
_MIN_DEPTH = LENGTH  # m: smallest depth of a car's centre in the camera frame at which it is drawn
_MAX_PIXEL = 1e5  # px: coordinates are clipped here, to keep fixed-point values in range

COLOURS_BGR = {
    "red": (42, 38, 186),
    "blue": (172, 84, 34),
    "yellow": (40, 190, 225),
    "white": (232, 234, 232),
    "silver": (176, 172, 168),
    "black": (44, 40, 38),
    "green": (70, 112, 40),
    "orange": (34, 112, 224),
}


def _chamfered(back: float, front: float, half: float, cut: float) -> Floats:
    """Rectangle with chamfered corners: an octagon (8, 2) forward, right [m]."""
    right = [(front, half - cut), (front - cut, half), (back + cut, half), (back, half - cut)]
    return np.array([(front, -half + cut), *right, (back, -half + cut), (back + cut, -half), (front - cut, -half)])


_BODY = _chamfered(-LENGTH / 2, LENGTH / 2, WIDTH / 2, 0.32)
_GLASS = _chamfered(-1.75, 0.95, 0.84, 0.2)
_ROOF = _chamfered(-1.25, 0.25, 0.68, 0.1)
_LAMPS = [
    np.array([(x, y), (x, y + 0.4), (x - 0.28, y + 0.4), (x - 0.28, y)])
    for x, y in ((2.2, -0.8), (2.2, 0.4), (-1.94, -0.8), (-1.94, 0.4))
]
_LAMP_BGR = ((215, 235, 240), (215, 235, 240), (30, 24, 150), (30, 24, 150))  # two white, two red ones
_SHADOW = _chamfered(-LENGTH / 2, LENGTH / 2, WIDTH / 2, 0.2)
_SHADOW_SHIFT = np.array([-0.55, 0.65])  # north, east [m]: offset of the shadow cast by the sun


def _stack(*layers: tuple[Floats, float]) -> tuple[Floats, list[slice]]:
    points, parts, first = [], [], 0
    for outline, height in layers:
        points.append(np.column_stack([outline, np.full(len(outline), -height)]))
        parts.append(slice(first, first + len(outline)))
        first += len(outline)
    return np.vstack(points), parts


_MODEL, _PARTS = _stack(
    (_BODY, 0.15), (_BODY, _BODY_TOP), (_GLASS, _BODY_TOP), (_ROOF, _ROOF_TOP), *((lamp, _BODY_TOP) for lamp in _LAMPS)
)
_HULL = slice(0, _PARTS[3].stop)
_GRID = np.array(
    [(LENGTH * ((i + 0.5) / 15 - 0.5), WIDTH * ((j + 0.5) / 9 - 0.5)) for i in range(15) for j in range(9)]
)


@dataclass(frozen=True, slots=True, eq=False)
class Car:
    """One car's trajectory. ground: (n, 2) north, east [m] and course: (n,) [rad] of frame 0 …; colour: BGR."""

    ground: Floats
    course: Floats
    colour: tuple[int, int, int]


def hull_points(ground: Floats, course: float) -> Floats:
    """The hull of a car's body (k, 3) in NED [m]; its projection's bounding box is the target's box."""
    return _model_at(ground, course)[_HULL]


def body_points(ground: Floats, course: float) -> Floats:
    """Sample points (135, 3) in NED [m], uniform over a car at half its height, to estimate visible area shares."""
    return np.asarray(body_points_batch(ground[None], np.array([course]))[0])


def body_points_batch(ground: Floats, course: Floats) -> Floats:
    """``body_points`` for n positions (n, 2) and courses (n,): (n, 135, 3)."""
    c, s = np.cos(course)[:, None], np.sin(course)[:, None]
    north = ground[:, :1] + c * _GRID[:, 0] - s * _GRID[:, 1]
    east = ground[:, 1:] + s * _GRID[:, 0] + c * _GRID[:, 1]
    return np.stack([north, east, np.full_like(north, -CENTRE_HEIGHT)], axis=-1)


def _yaw_rotation(course: float) -> Floats:
    c, s = np.cos(course), np.sin(course)
    return np.array([[c, -s, 0.0], [s, c, 0.0], [0.0, 0.0, 1.0]])


def _model_at(ground: Floats, course: float) -> Floats:
    return np.asarray(_MODEL @ _yaw_rotation(course).T + np.array([ground[0], ground[1], 0.0]))


def draw(
    image: npt.NDArray[np.uint8], matrix: Floats, ground: Floats, course: float, colour: tuple[int, int, int]
) -> None:
    """Draw a car into ``image``. matrix: (3, 4) projection, pixels from NED; cars behind the camera are skipped."""
    if float((matrix[2, :3] @ np.array([ground[0], ground[1], -CENTRE_HEIGHT])) + matrix[2, 3]) < _MIN_DEPTH:
        return
    shadow = np.column_stack([_SHADOW, np.zeros(len(_SHADOW))]) @ _yaw_rotation(course).T
    shadow[:, :2] += ground + _SHADOW_SHIFT
    _fill(image, project(matrix, shadow), (38, 38, 40))
    pixels = project(matrix, _model_at(ground, course))
    both = np.vstack([pixels[_PARTS[0]], pixels[_PARTS[1]]])
    _fill(image, np.asarray(cv2.convexHull(both.astype(np.float32)), np.float64).reshape(-1, 2), _shade(colour, 0.62))
    _fill(image, pixels[_PARTS[1]], _shade(colour, 1.0))
    for part, lamp in zip(_PARTS[4:], _LAMP_BGR, strict=True):
        _fill(image, pixels[part], lamp)
    _fill(image, pixels[_PARTS[2]], (46, 40, 34))
    _fill(image, pixels[_PARTS[3]], _shade(colour, 1.08))


def _shade(colour: tuple[int, int, int], gain: float) -> tuple[int, int, int]:
    b, g, r = (min(round(gain * value), 255) for value in colour)
    return b, g, r


def project(matrix: Floats, points: Floats) -> Floats:
    """Pixels (n, 2) of points (n, 3) NED [m]; matrix: (3, 4) pixels from NED."""
    seen = points @ matrix[:, :3].T + matrix[:, 3]
    return np.asarray(seen[:, :2] / seen[:, 2:])


def _fill(image: npt.NDArray[np.uint8], outline: Floats, colour: tuple[int, int, int]) -> None:
    fixed = np.rint(np.clip(outline, -_MAX_PIXEL, _MAX_PIXEL) * (1 << _SHIFT)).astype(np.int32)
    cv2.fillConvexPoly(image, fixed, colour, cv2.LINE_AA, _SHIFT)
