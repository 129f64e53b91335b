"""Road model: a cubic spline along the midline (3.1), its extrapolation, and the road likelihoods.

The paper writes the spline as x = S(y), which excludes roads that run across the image. Here the parameter is the arc
length s, so S(s) = (x, y).
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from scipy.interpolate import BSpline, make_lsq_spline

from edge.uav.baselines.background import BackgroundMotion
from protocols.geometry.types import Floats

_POINTS_PER_SEGMENT = 16  # stored midline points per spline segment
_MAX_BEND = 1.2  # rad: turn of an extrapolated cubic, which diverges


@dataclass(frozen=True, slots=True, eq=False)
class RoadMidline:
    """points: (n, 2) along the midline, in order, about evenly spaced [px]. half_width: from there to a white line."""

    points: Floats
    half_width: float

    def moved(self, motion: BackgroundMotion, centre: Floats) -> RoadMidline:
        """The road in the next frame, moved with the background (in the paper: by the helicopter's controls)."""
        return RoadMidline(motion.moved(self.points, centre), self.half_width)


@dataclass(frozen=True, slots=True, eq=False)
class RoadCourse:
    """A road's sampled spline, extrapolated beyond its ends. points: (m, 2). headings: (m,) of the tangent [rad].

    known: (m,) True between the ends, False where extrapolated.
    """

    points: Floats
    headings: Floats
    known: np.ndarray[tuple[int, ...], np.dtype[np.bool_]]
    half_width: float

    def nearest(self, positions: Floats) -> tuple[Floats, Floats]:
        """Distances (n,) [px] from positions (n, 2) to the course and its headings (n,) [rad] there."""
        difference = (
            np.square(positions).sum(axis=1)[:, None]
            - 2.0 * positions @ self.points.T
            + np.square(self.points).sum(axis=1)
        )
        at = difference.argmin(axis=1)
        heading = self.headings[at]
        offset = positions - self.points[at]
        # Distance across the tangent, except beyond an end: distance to the end point.
        across = np.abs(offset[:, 1] * np.cos(heading) - offset[:, 0] * np.sin(heading))
        along = np.abs(offset[:, 0] * np.cos(heading) + offset[:, 1] * np.sin(heading))
        at_end = (at == 0) | (at == len(self.points) - 1)
        return np.where(at_end, np.hypot(across, along), across), heading


def spline(points: Floats) -> tuple[BSpline, float]:
    """Eq. (3.1): the cubic spline S(s) near points (n, 2), by arc length s, and its length [px].

    Deviations: by arc length instead of x = S(y); least squares with one segment per sixteen stored points
    instead of interpolation, as their scatter would make the extrapolation unstable. Raises ValueError
    for fewer than two distinct points.
    """
    lengths = np.concatenate([[0.0], np.cumsum(np.hypot(*np.diff(points, axis=0).T))])
    keep = np.concatenate([[True], np.diff(lengths) > 1e-6])
    points, lengths = points[keep], lengths[keep]
    if len(points) < 2:
        raise ValueError("a spline needs two distinct points")
    degree = min(3, len(points) - 1)
    at = np.linspace(0, len(points) - 1, max(len(points) // _POINTS_PER_SEGMENT, 1) + 1)[1:-1]
    inner = np.interp(at, np.arange(len(points)), lengths)
    ends = np.ones(degree + 1)
    return make_lsq_spline(lengths, points, np.concatenate([0.0 * ends, inner, lengths[-1] * ends]), degree), float(
        lengths[-1]
    )


def extrapolated_course(road: RoadMidline, beyond: float, step: float) -> RoadCourse:
    """The road and its cubic extrapolation by up to ``beyond`` [px] at both ends, sampled every ``step`` [px].

    A cubic diverges: where it has turned by more than ``_MAX_BEND`` from the road's end, the course goes straight on.
    """
    curve, length = spline(road.points)
    inside = np.linspace(0.0, length, max(int(length / step), 2) + 1)
    middle = np.asarray(curve(inside))
    slopes = np.asarray(curve(inside, 1))
    headings = np.arctan2(slopes[:, 1], slopes[:, 0])
    after, after_heading = _extrapolated(curve, length, beyond, step)
    before, before_heading = _extrapolated(curve, 0.0, -beyond, step)
    return RoadCourse(
        np.vstack([before[::-1], middle, after]),
        np.concatenate([before_heading[::-1], headings, after_heading]),
        np.concatenate([np.zeros(len(before), bool), np.ones(len(middle), bool), np.zeros(len(after), bool)]),
        road.half_width,
    )


def _extrapolated(curve: BSpline, start: float, beyond: float, step: float) -> tuple[Floats, Floats]:
    """Points (m, 2), a step apart, and headings (m,) along the increasing parameter, from start outwards."""
    forward = np.sign(beyond)
    parameter = start + forward * np.linspace(0.0, abs(beyond), int(abs(beyond) / step) + 1)
    slopes = np.asarray(curve(parameter, 1))
    turned = np.unwrap(np.arctan2(slopes[:, 1], slopes[:, 0]))
    past = np.abs(turned - turned[0]) > _MAX_BEND
    last = int(past.argmax()) - 1 if past.any() else len(turned) - 1
    turned[last + 1 :] = turned[last]
    # Equal steps along the heading: beyond its ends the spline's parameter is not the arc length.
    strides = forward * step * np.column_stack([np.cos(turned), np.sin(turned)])
    points = np.asarray(curve(start)) + np.cumsum(strides[1:], axis=0)
    return points, turned[1:]


def road_heading(tangent: Floats, direction: Floats | float) -> Floats:
    """Eq. (3.9): theta_road = atan2 of the tangent, plus pi where travel is against the order of the points.

    tangent: headings (n,) [rad]. direction: +1 along the order of the road's points, -1 against it.
    """
    return np.where(np.asarray(direction) < 0, tangent + np.pi, tangent)


def road_log_likelihood(distance: Floats, scale: float) -> Floats:
    """Eq. (3.11): the logarithm of exp(-|x - S(y)|), of distances (n,) [px].

    Deviation: the distance is across the road and in units of scale [px]; as printed it is in pixels, and the
    likelihood would depend on the flight altitude.
    """
    return np.asarray(-np.abs(distance) / scale, dtype=np.float64)


def mixture_log_likelihood(colour: Floats, road: Floats, alpha: float) -> Floats:
    """Eq. (3.12): log(alpha p_colour + (1 - alpha) p_road), of logarithms (n,).

    Both have the maximum 1, at a perfect histogram and on the midline of the road.
    """
    return np.asarray(np.logaddexp(np.log(alpha) + colour, np.log1p(-alpha) + road), dtype=np.float64)


def orientation_log_likelihood(heading: Floats, road: Floats, std: float) -> Floats:
    """Eq. (4.22): the logarithm of exp(-wrap(theta - theta_road)^2 / (2 sigma^2)), of angles (n,) [rad].

    Deviation: printed without wrapping and without sigma.
    """
    difference = np.angle(np.exp(1j * (heading - road)))
    return np.asarray(-0.5 * np.square(difference / std), dtype=np.float64)
