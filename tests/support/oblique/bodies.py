"""Bodies in an oblique world: solids and upright figures, as polygons in metres, and how they are drawn.

World axes: x east, y north, z up [m]. A body's own axes: x forward, y left, z up, origin on the ground.
"""

from __future__ import annotations

from dataclasses import dataclass

import cv2
import numpy as np

from protocols.geometry.types import Floats, Image

Colour = tuple[int, int, int]
_SHIFT = 4  # bits of OpenCV's fixed-point coordinates
_NEAR_M = 0.5  # m: nearer faces are clipped


@dataclass(frozen=True, slots=True, eq=False)
class View:
    """One camera pose. matrix: (3, 4) pixels from world; centre: (3,) [m]."""

    matrix: Floats
    centre: Floats

    def project(self, points: Floats) -> tuple[Floats, Floats]:
        """Pixels (n, 2) of world points (n, 3), and their depths (n,) [m]."""
        p = points @ self.matrix[:, :3].T + self.matrix[:, 3]
        depth = p[:, 2]
        return np.asarray(p[:, :2] / np.where(depth > _NEAR_M, depth, np.nan)[:, None]), depth


@dataclass(frozen=True, slots=True, eq=False)
class Body:
    """Something that stands on the ground.

    parts: convex polygons or solids, each the hull of its points (n, 3) in body axes, with a colour, drawn in order.
    upright: a flat figure that always faces the camera, x is then to the right.
    """

    parts: tuple[tuple[Floats, Colour], ...]
    upright: bool = False

    def placed(self, place: Floats, course: float, view: View) -> list[tuple[Floats, Colour]]:
        """The parts in world axes; place: (2,) on the ground [m]; course: from the x axis [rad]."""
        if self.upright:
            away = place - view.centre[:2]
            angle = float(np.arctan2(away[1], away[0])) - 0.5 * np.pi
        else:
            angle = course
        c, s = np.cos(angle), np.sin(angle)
        turn = np.array([[c, -s, 0.0], [s, c, 0.0], [0.0, 0.0, 1.0]])
        return [(points @ turn.T + [place[0], place[1], 0.0], colour) for points, colour in self.parts]


def outline(body: Body, place: Floats, course: float, view: View) -> tuple[Floats, float]:
    """Pixels (n, 2) of all points of a body, and its mean depth [m]; nan where it is behind the camera."""
    points = np.concatenate([part for part, _ in body.placed(place, course, view)])
    pixels, depth = view.project(points)
    return pixels, float(depth.mean())


def draw(image: Image, mask: Image | None, body: Body, place: Floats, course: float, view: View, mark: int) -> None:
    """Draw a body; in ``mask`` it is filled with ``mark``."""
    for points, colour in body.placed(place, course, view):
        pixels, _ = view.project(points)
        if not np.isfinite(pixels).all() or np.abs(pixels).max() > 2e4:
            continue
        hull = cv2.convexHull(pixels.astype(np.float32)).reshape(-1, 2)
        fixed = np.rint(hull * (1 << _SHIFT)).astype(np.int32)
        cv2.fillConvexPoly(image, fixed, colour, cv2.LINE_AA, _SHIFT)
        if mask is not None:
            cv2.fillConvexPoly(mask, fixed, mark, cv2.LINE_8, _SHIFT)


def box(x: tuple[float, float], y: tuple[float, float], z: tuple[float, float]) -> Floats:
    """Corners (8, 3) of a block."""
    return np.array([(a, b, c) for a in x for b in y for c in z])


def _shade(colour: Colour, gain: float) -> Colour:
    b, g, r = (int(np.clip(gain * value, 0, 255)) for value in colour)
    return b, g, r


def block(
    x: tuple[float, float], y: tuple[float, float], z: tuple[float, float], colour: Colour
) -> list[tuple[Floats, Colour]]:
    """A block with lit top and darker sides."""
    top = box(x, y, (z[1], z[1]))
    return [(box(x, y, z), _shade(colour, 0.7)), (top, colour)]


def car(colour: Colour) -> Body:
    """4.5 m long."""
    parts = [*block((-2.25, 2.25), (-0.9, 0.9), (0.25, 0.85), colour)]
    parts += [
        (box((-1.6, 0.9), (-0.8, 0.8), (0.85, 1.4)), (60, 52, 46)),
        (box((-1.2, 0.4), (-0.72, 0.72), (1.42, 1.42)), colour),
    ]
    parts += [(box((2.1, 2.26), (-0.8, 0.8), (0.5, 0.7)), (210, 230, 235))]
    return Body(tuple(parts))


def boat(colour: Colour) -> Body:
    """9 m long, with a cabin."""
    hull = np.array([(-4.5, -1.4, 0), (-4.5, 1.4, 0), (2.5, 1.5, 0), (2.5, -1.5, 0), (4.8, 0, 0.4)], dtype=np.float64)
    deck = hull + [0.0, 0.0, 0.9]
    parts: list[tuple[Floats, Colour]] = [(np.concatenate([hull, deck]), _shade(colour, 0.75)), (deck, colour)]
    parts += block((-2.5, 1.0), (-0.9, 0.9), (0.9, 2.2), (150, 120, 90))
    parts += [(box((-4.7, -4.3), (-0.6, 0.6), (0.2, 1.2)), (40, 40, 40))]
    return Body(tuple(parts))


def _flat(points: list[tuple[float, float]]) -> Floats:
    return np.array([(x, 0.0, z) for x, z in points])


def person(shirt: Colour, trousers: Colour, phase: float) -> Body:
    """1.75 m tall; phase of the step [rad]."""
    swing = 0.22 * float(np.sin(phase))
    parts: list[tuple[Floats, Colour]] = []
    for foot in (swing, -swing):
        parts.append((_flat([(-0.09, 0.9), (0.09, 0.9), (foot + 0.09, 0.0), (foot - 0.07, 0.0)]), trousers))
    parts.append((_flat([(-0.22, 1.48), (0.22, 1.48), (0.17, 0.85), (-0.17, 0.85)]), shirt))
    for hand in (-swing, swing):
        parts.append((_flat([(hand, 0.95), (hand + 0.09, 0.95), (0.05, 1.45), (-0.05, 1.45)]), _shade(shirt, 0.8)))
    head = [(0.11 * np.cos(a), 1.62 + 0.13 * np.sin(a)) for a in np.linspace(0, 2 * np.pi, 9)[:-1]]
    parts.append((_flat(head), (120, 150, 190)))
    return Body(tuple(parts), upright=True)


def bicycle(shirt: Colour, phase: float, side: float) -> Body:
    """A rider on a bicycle, 1.8 m long, seen from the side; side: 1 to the right, -1 to the left."""
    parts: list[tuple[Floats, Colour]] = []
    for middle in (-0.52, 0.52):
        rim = [(middle + 0.34 * np.cos(a), 0.34 + 0.34 * np.sin(a)) for a in np.linspace(0, 2 * np.pi, 13)[:-1]]
        parts.append((_flat(rim), (45, 45, 45)))
        hub = [(middle + 0.27 * np.cos(a), 0.34 + 0.27 * np.sin(a)) for a in np.linspace(0, 2 * np.pi, 13)[:-1]]
        parts.append((_flat(hub), (120, 130, 130)))
    pedal = 0.15 * float(np.cos(phase))
    parts.append((_flat([(-0.5, 0.36), (-0.15, 0.85), (0.45, 0.9), (0.5, 0.36)]), (50, 50, 150)))
    parts.append(
        (_flat([(-0.18, 0.95), (0.0, 0.95), (pedal + 0.1, 0.25 + 0.1 * np.sin(phase)), (pedal, 0.2)]), (60, 50, 40))
    )
    parts.append((_flat([(-0.25, 0.95), (0.0, 0.95), (0.35 * side, 1.45), (0.15 * side, 1.5)]), shirt))
    head = [(0.36 * side + 0.12 * np.cos(a), 1.62 + 0.13 * np.sin(a)) for a in np.linspace(0, 2 * np.pi, 9)[:-1]]
    parts.append((_flat(head), (110, 140, 180)))
    return Body(tuple(parts), upright=True)


def building(rng: np.random.Generator) -> Body:
    """A block with rows of windows."""
    length, width, height = rng.uniform(8, 22), rng.uniform(8, 16), rng.uniform(4, 16)
    wall = tuple(int(v) for v in rng.integers(110, 215, 3))
    half_x, half_y = 0.5 * length, 0.5 * width
    parts = block((-half_x, half_x), (-half_y, half_y), (0.0, height), (wall[0], wall[1], wall[2]))
    roof = float(rng.uniform(0.3, 0.7))
    parts.append((box((-roof * half_x, roof * half_x), (-roof * half_y, 0.0), (height, height + 0.05)), (90, 90, 95)))
    return Body(tuple(parts))


def pole(rng: np.random.Generator) -> Body:
    """A lamp post of 8 m."""
    grey = int(rng.integers(60, 190))
    return Body(((_flat([(-0.2, 0), (0.2, 0), (0.15, 8), (-0.15, 8)]), (grey, grey, grey)),), upright=True)


def tree(rng: np.random.Generator, height: float | None = None) -> Body:
    """A trunk and a ragged crown; height: of its middle [m]."""
    height, radius = rng.uniform(4, 9) if height is None else height, rng.uniform(1.3, 3.0)
    parts: list[tuple[Floats, Colour]] = [(_flat([(-0.2, 0), (0.2, 0), (0.15, height), (-0.15, height)]), (50, 70, 90))]
    for _ in range(9):
        middle = rng.normal(0, 0.35 * radius), height + rng.normal(0, 0.3 * radius)
        part = radius * rng.uniform(0.35, 0.65)
        ring = [(middle[0] + part * np.cos(a), middle[1] + part * np.sin(a)) for a in np.linspace(0, 2 * np.pi, 8)[:-1]]
        green = int(rng.integers(60, 130))
        parts.append((_flat(ring), (green // 3, green, green // 2)))
    return Body(tuple(parts), upright=True)
