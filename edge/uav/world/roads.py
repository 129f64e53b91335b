"""Roads as curves of given curvature, and speed profiles of cars along them.

Ground axes: north, east [m]. A curve's right-hand normal is (−sin ψ, cos ψ) for course ψ = atan2(east, north).
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property

import numpy as np

from protocols.geometry.types import Floats

STEP = 0.5  # metres between the points of a curve
_TRANSITION_LENGTH = 6.0  # m over which the curvature ramps up and down at a bend
_MAX_LATERAL, _MAX_LONGITUDINAL = 3.0, 2.2  # m/s²: of a car in a bend, and along its path
_CORNER_CUT = 5.0  # m of kerb by which the corners of a crossing are cut
LANE = 3.5  # m, of a usual road
ROAD_WIDTH = 2 * LANE


@dataclass(frozen=True, slots=True)
class Bend:
    """A bend that begins at arc length ``start`` [m]; angle [rad], positive turns right; radius [m]."""

    start: float
    angle: float
    radius: float

    @property
    def length(self) -> float:
        """Arc length [m]."""
        return abs(self.angle) * self.radius


@dataclass(frozen=True, eq=False)
class Curve:
    """A curve by arc length. points: (n, 2) north, east [m] every STEP from ``begin``. course: (n,) [rad]."""

    begin: float
    points: Floats
    course: Floats

    @cached_property
    def arc(self) -> Floats:
        """Arc length (n,) of the points [m]."""
        return np.asarray(self.begin + STEP * np.arange(len(self.points)), np.float64)

    @property
    def end(self) -> float:
        """Arc length of the last point [m]."""
        return float(self.begin + STEP * (len(self.points) - 1))

    def at(self, s: Floats, lateral: Floats | float = 0.0) -> tuple[Floats, Floats]:
        """Points (k, 2) and course (k,) at arc lengths (k,), ``lateral`` metres to the right."""
        course = np.interp(s, self.arc, self.course)
        north = np.interp(s, self.arc, self.points[:, 0]) - lateral * np.sin(course)
        east = np.interp(s, self.arc, self.points[:, 1]) + lateral * np.cos(course)
        return np.column_stack([north, east]), course

    def offset(self, lateral: float) -> Curve:
        """The curve ``lateral`` metres to the right, at the same parameter."""
        normal = np.column_stack([-np.sin(self.course), np.cos(self.course)])
        return Curve(self.begin, self.points + lateral * normal, self.course)

    def distance(self, points: Floats) -> Floats:
        """Distance (k,) of points (k, 2) from the curve [m], resolved to 2 m along it."""
        coarse = self.points[::4]
        return np.asarray(np.linalg.norm(points[:, None] - coarse[None], axis=2).min(axis=1))


@dataclass(frozen=True, eq=False)
class Road:
    """A two-lane road about its centre line."""

    centre: Curve
    width: float = ROAD_WIDTH


def curve_from_bends(
    bends: Sequence[Bend],
    begin: float,
    end: float,
    course: float,
    sway: Floats | None = None,
) -> Curve:
    """The curve from arc length ``begin`` to ``end`` that passes the origin at 0 with ``course`` [rad].

    sway: amplitudes (k,) [1/m] of sinusoidal curvature of wavelengths 80 / 1 … k metres.
    """
    s = np.arange(begin, end + STEP, STEP)
    curvature = np.zeros(len(s))
    for bend in bends:
        ease = min(_TRANSITION_LENGTH, 0.8 * bend.length)
        rise = np.clip((s - bend.start) / ease + 0.5, 0.0, 1.0)
        fall = np.clip((s - bend.start - bend.length) / ease + 0.5, 0.0, 1.0)
        curvature += np.sign(bend.angle) / bend.radius * (rise - fall)
    for order, amplitude in enumerate(() if sway is None else sway, 1):
        curvature += amplitude * np.sin(2.0 * np.pi * order * s / 80.0 + 1.7 * order)
    heading = np.r_[0.0, np.cumsum(0.5 * STEP * (curvature[1:] + curvature[:-1]))]
    middle = 0.5 * (heading[1:] + heading[:-1])
    zero = int(np.argmin(np.abs(s)))
    middle += course - heading[zero]
    heading += course - heading[zero]
    steps = STEP * np.column_stack([np.cos(middle), np.sin(middle)])
    points = np.vstack([np.zeros(2), np.cumsum(steps, axis=0)])
    return Curve(float(s[0]), points - points[zero], heading)


def straight_curve(point: Floats, course: float, begin: float, end: float) -> Curve:
    """A straight line with arc length 0 at ``point`` (2,)."""
    line = curve_from_bends((), begin, end, course)
    return Curve(line.begin, line.points + point, line.course)


def crossing_outline(one: Road, other: Road) -> Floats | None:
    """Outline (8, 2) of the asphalt where two roads cross, with cut corners for turning cars; None: no crossing."""
    gap = np.linalg.norm(one.centre.points[:, None, :] - other.centre.points[None, ::2], axis=2)
    i, j = np.unravel_index(int(gap.argmin()), gap.shape)
    if gap[i, j] > 2.0 * STEP:
        return None
    places = []
    for road, s, partner in ((one, one.centre.arc[i], other), (other, other.centre.arc[::2][j], one)):
        reach = 0.5 * partner.width + _CORNER_CUT
        ends = np.array([s + reach, s + reach, s - reach, s - reach])
        course = road.centre.at(ends)[1]
        side = 0.5 * road.width * np.array([1.0, -1.0, 1.0, -1.0])
        places.append(road.centre.at(ends)[0] + side[:, None] * np.column_stack([-np.sin(course), np.cos(course)]))
    outline = np.vstack(places)
    middle = outline.mean(axis=0)
    return np.asarray(outline[np.argsort(np.arctan2(*(outline - middle).T))])


def arc_length_over_time(path: Curve, times: Floats, cruise: float | Floats) -> Floats:
    """Arc length (n,) of a car on ``path`` at ``times`` (n,) [s]; at arc length 0 at time 0.

    cruise: speed on a straight [m/s], one or (n,) along the path.
    """
    curvature = np.abs(np.gradient(path.course, STEP))
    limit = np.minimum(cruise, np.sqrt(_MAX_LATERAL / np.maximum(curvature, 1e-6)))
    squares = limit**2
    for k in range(1, len(squares)):  # forward pass: limit of acceleration
        squares[k] = min(squares[k], squares[k - 1] + 2.0 * _MAX_LONGITUDINAL * STEP)
    for k in range(len(squares) - 2, -1, -1):  # backward pass: limit of braking
        squares[k] = min(squares[k], squares[k + 1] + 2.0 * _MAX_LONGITUDINAL * STEP)
    speed = np.sqrt(squares)
    moment = np.r_[0.0, np.cumsum(STEP / (0.5 * (speed[1:] + speed[:-1])))]
    moment -= np.interp(0.0, path.arc, moment)
    return np.asarray(np.interp(times, moment, path.arc))
