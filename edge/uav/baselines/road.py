"""The road's shape: a cubic spline through coordinates held along its middle (3.1), and what it says of a place.

The paper writes the spline as x = S(y), which no road satisfies that runs across the picture. Here the parameter is the
arc length s, so S(s) = (x, y).
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from scipy.interpolate import BSpline, make_lsq_spline

from edge.uav.baselines.background import Motion
from protocols.geometry.types import Floats

_PIECE = 16  # held coordinates to one piece of the spline


@dataclass(frozen=True, slots=True, eq=False)
class Road:
    """points: (n, 2) along the middle, in order, about evenly spaced [px]. half_width: from there to a white line."""

    points: Floats
    half_width: float

    def moved(self, motion: Motion, centre: Floats) -> Road:
        """Where the road is in the next frame: moved as the background is (the paper: by the helicopter's controls)."""
        return Road(motion.moved(self.points, centre), self.half_width)


@dataclass(frozen=True, slots=True, eq=False)
class Course:
    """A road's spline drawn out, also beyond its ends. points: (m, 2). headings: (m,) of the tangent [rad].

    known: (m,) whether it lies between the ends, or is extrapolated.
    """

    points: Floats
    headings: Floats
    known: np.ndarray[tuple[int, ...], np.dtype[np.bool_]]
    half_width: float

    def nearest(self, positions: Floats) -> tuple[Floats, Floats]:
        """Distances (n,) [px] from positions (n, 2) to the course and headings (n,) [rad] of it there."""
        apart = (
            np.square(positions).sum(axis=1)[:, None]
            - 2.0 * positions @ self.points.T
            + np.square(self.points).sum(axis=1)
        )
        at = apart.argmin(axis=1)
        heading = self.headings[at]
        offset = positions - self.points[at]
        # Across the tangent, except beyond an end, where the distance to the end counts.
        across = np.abs(offset[:, 1] * np.cos(heading) - offset[:, 0] * np.sin(heading))
        along = np.abs(offset[:, 0] * np.cos(heading) + offset[:, 1] * np.sin(heading))
        at_end = (at == 0) | (at == len(self.points) - 1)
        return np.where(at_end, np.hypot(across, along), across), heading


def spline(points: Floats) -> tuple[BSpline, float]:
    """Eq. (3.1): the cubic spline S(s) near points (n, 2), by arc length s, and its length [px].

    Deviations: by arc length instead of x = S(y); fitted by least squares with one piece for about sixteen held
    coordinates instead of through each, as their scatter would throw the extrapolation anywhere. Raises ValueError
    for fewer than two different points.
    """
    lengths = np.concatenate([[0.0], np.cumsum(np.hypot(*np.diff(points, axis=0).T))])
    keep = np.concatenate([[True], np.diff(lengths) > 1e-6])
    points, lengths = points[keep], lengths[keep]
    if len(points) < 2:
        raise ValueError("a spline needs two different coordinates")
    degree = min(3, len(points) - 1)
    at = np.linspace(0, len(points) - 1, max(len(points) // _PIECE, 1) + 1)[1:-1]
    inner = np.interp(at, np.arange(len(points)), lengths)
    ends = np.ones(degree + 1)
    return make_lsq_spline(lengths, points, np.concatenate([0.0 * ends, inner, lengths[-1] * ends]), degree), float(
        lengths[-1]
    )


def course(road: Road, beyond: float, step: float, bend: float = 1.2) -> Course:
    """The road and its cubic extrapolation by up to beyond [px] at both ends, a point every step [px].

    A cubic runs away: where it has turned by more than bend [rad] from the road's end, the course goes straight on.
    """
    curve, length = spline(road.points)
    inside = np.linspace(0.0, length, max(int(length / step), 2) + 1)
    middle = np.asarray(curve(inside))
    slopes = np.asarray(curve(inside, 1))
    headings = np.arctan2(slopes[:, 1], slopes[:, 0])
    after, after_heading = _extrapolated(curve, length, beyond, step, bend)
    before, before_heading = _extrapolated(curve, 0.0, -beyond, step, bend)
    return Course(
        np.vstack([before[::-1], middle, after]),
        np.concatenate([before_heading[::-1], headings, after_heading]),
        np.concatenate([np.zeros(len(before), bool), np.ones(len(middle), bool), np.zeros(len(after), bool)]),
        road.half_width,
    )


def _extrapolated(curve: BSpline, start: float, beyond: float, step: float, bend: float) -> tuple[Floats, Floats]:
    """Points (m, 2), a step apart, and headings (m,) along the increasing parameter, from start outwards."""
    forward = np.sign(beyond)
    parameter = start + forward * np.linspace(0.0, abs(beyond), int(abs(beyond) / step) + 1)
    slopes = np.asarray(curve(parameter, 1))
    turned = np.unwrap(np.arctan2(slopes[:, 1], slopes[:, 0]))
    past = np.abs(turned - turned[0]) > bend
    last = int(past.argmax()) - 1 if past.any() else len(turned) - 1
    turned[last + 1 :] = turned[last]
    # By equal steps along the heading: the spline's parameter is no arc length beyond its ends.
    strides = forward * step * np.column_stack([np.cos(turned), np.sin(turned)])
    points = np.asarray(curve(start)) + np.cumsum(strides[1:], axis=0)
    return points, turned[1:]


def road_heading(tangent: Floats, direction: Floats | float) -> Floats:
    """Eq. (3.9): theta_road = atan2 of the tangent, turned round where travel goes against the order of the points.

    tangent: headings (n,) [rad]. direction: +1 along the order of the road's points, -1 against it.
    """
    return np.where(np.asarray(direction) < 0, tangent + np.pi, tangent)


def road_log_likelihood(distance: Floats, scale: float) -> Floats:
    """Eq. (3.11): the logarithm of exp(-|x - S(y)|), of distances (n,) [px].

    Deviation: the distance is across the road and in units of scale [px]; as printed it is in pixels, and the
    likelihood would depend on the height of the flight.
    """
    return np.asarray(-np.abs(distance) / scale, dtype=np.float64)


def mixture_log_likelihood(colour: Floats, road: Floats, alpha: float) -> Floats:
    """Eq. (3.12): log(alpha p_colour + (1 - alpha) p_road), of logarithms (n,).

    On one scale: both have 1 as their largest value, at a perfect histogram and on the middle of the road.
    """
    return np.asarray(np.logaddexp(np.log(alpha) + colour, np.log1p(-alpha) + road), dtype=np.float64)


def orientation_log_likelihood(heading: Floats, road: Floats, std: float) -> Floats:
    """Eq. (4.22): the logarithm of exp(-wrap(theta - theta_road)^2 / (2 sigma^2)), of angles (n,) [rad].

    Deviation: printed without wrapping and without sigma.
    """
    apart = np.angle(np.exp(1j * (heading - road)))
    return np.asarray(-0.5 * np.square(apart / std), dtype=np.float64)
