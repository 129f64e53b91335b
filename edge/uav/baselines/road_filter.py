"""Section 3.1: road tracking along white lines by a particle filter over position and curvature (3.3 to 3.8).

Stored midline points move with the background; those in the image are corrected by the edges of each frame; where a
part of the road enters the image for the first time, the filter extends the midline stride by stride.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from scipy.ndimage import uniform_filter1d

from edge.uav.baselines.road import RoadMidline
from edge.uav.baselines.white_lines import DISTANCE_CAP, EdgeDistance, RoadSection
from edge.uav.prediction import particle_filter as pf
from protocols.geometry.types import Floats

_PARTICLES = 120  # at either end of the road: two dimensions, and a stride moves them little
_SHARPNESS = 0.35  # lambda of (3.7) [1/px^2]
_OFFSET_STD = 1.5  # px: std of the position that the spline gives
_FIT_STRIDES = 4  # strides of known road that the arc is fitted to before it extends beyond the end
_GAPS = (1, 3, 6, 10, 14)  # strides tried at once: at crossings and in shadows there are no white lines
_TURN_IN_GAP = 0.25  # rad: largest turn of the arc over a gap
_LINE_FOUND_PX = 3.2  # px: mean distance to edges below which white lines are found
_LINE_LOST_PX = 5.0  # px: mean distance to edges above which they are lost
_GAPS_EVERY = 3  # frames
_STRIDE = 0.6  # length of a stride in half widths
_MIN_STRIDE = 6.0  # px
_FIRST_CURVATURE = 0.05  # initial std, in 1 / half width
_CURVATURE_NOISE = 0.03  # std per stride, in 1 / half width
_MARGIN = 6.0  # px: distance of a new point from the border
_MAX_STRIDES = 60  # per frame and end
_SHIFTS = np.arange(-4.0, 4.1)  # px
_FIT_TURNS = np.radians([-3.0, -1.5, 0.0, 1.5, 3.0])
_FIT_SHIFTS = np.arange(-12.0, 12.1)  # px
_SMOOTHING_WINDOW = 7  # points: window of the moving average over shifts
_MIN_POINTS = 6  # points: a shorter road is dropped
_KEEP_RADIUS = 1.6  # image diagonals from the centre: points farther away are dropped


@dataclass(frozen=True, slots=True, eq=False)
class _ArcObservation:
    """Where new arcs begin. base: (2,). heading [rad]. lengths: (m,) along the arc at which edges are evaluated."""

    edges: EdgeDistance
    base: Floats
    heading: float
    half_width: float
    lengths: Floats


class ArcModel:
    """States (offset, curvature): across the road at the arc's base [px], and R [1/px]."""

    def __init__(self, curvature_noise: float) -> None:
        self.curvature_noise = curvature_noise

    def propagate(self, states: Floats, rng: np.random.Generator) -> Floats:
        """Eqs. (3.3) to (3.5): the position is the spline's, the curvature a random walk.

        Deviation: the spline's position gets an error, or the filter could not return onto the lines.
        """
        offset, bend = (rng.normal(0.0, std, len(states)) for std in (_OFFSET_STD, self.curvature_noise))
        return np.column_stack([offset, states[:, 1] + bend])

    def log_likelihood(self, states: Floats, observation: _ArcObservation) -> Floats:
        """Eqs. (3.6) to (3.8): exp(-lambda d^2), d^2 the mean squared distance of both white lines to the edges."""
        middle, normal = arcs(states, observation.base, observation.heading, observation.lengths)
        return np.asarray(
            -_SHARPNESS * line_distance(observation.edges, middle, normal, observation.half_width, 2.0),
            dtype=np.float64,
        )


def arcs(states: Floats, base: Floats, heading: float, lengths: Floats) -> tuple[Floats, Floats]:
    """The road's midline S~ (n, m, 2) and normals (n, m, 2) of states (n, 2), at lengths (m,) [px] from base (2,)."""
    offset, curvature = states[:, 0, None], states[:, 1, None]
    turned = heading + curvature * lengths
    half = heading + 0.5 * curvature * lengths
    chord = lengths * np.sinc(0.5 * curvature * lengths / np.pi)
    x = base[0] - offset * np.sin(heading) + chord * np.cos(half)
    y = base[1] + offset * np.cos(heading) + chord * np.sin(half)
    return np.stack([x, y], axis=-1), np.stack([-np.sin(turned), np.cos(turned)], axis=-1)


def line_distance(edges: EdgeDistance, middle: Floats, normal: Floats, half_width: float, power: float = 1.0) -> Floats:
    """Mean (n,) over m of (capped) distance ** power to the edges, of the lines at half_width on both sides.

    middle, normal: (n, m, 2). Only points in the image count; without any, the cap.
    """
    both = np.concatenate([middle + half_width * normal, middle - half_width * normal], axis=1)
    distance, inside = edges.at(both)
    seen = inside.sum(axis=1)
    total = (distance**power * inside).sum(axis=1)
    return np.asarray(np.where(seen > 0, total / np.maximum(seen, 1), DISTANCE_CAP**power), dtype=np.float64)


class RoadFilter:
    """Tracks the midline of the road from frame to frame. size: (width, height) [px]."""

    def __init__(self, size: tuple[int, int], rng: np.random.Generator) -> None:
        self._size, self._rng = np.array(size, dtype=np.float64), rng
        self._end_particles: dict[bool, pf.Particles] = {}
        self._frames = 0

    def begin(self, edges: EdgeDistance, sections: Sequence[RoadSection]) -> RoadMidline | None:
        """Trace white lines in both directions from each candidate cross-section beside the target.

        The road is the candidate with the longest line support; None if no white lines continue from any.
        """
        best: RoadMidline | None = None
        most, end_particles = 0.0, self._end_particles
        for section in (fit_section(part, edges) for part in sections):
            stride = _stride(section.half_width)
            along = stride * (np.arange(2 * _FIT_STRIDES + 1) - _FIT_STRIDES)
            points = section.middle + along[:, None] * np.array([np.cos(section.heading), np.sin(section.heading)])
            self._end_particles, self._frames = {}, 0
            road = self.extended(RoadMidline(points, section.half_width), edges)
            length = stride * line_support(road, edges)[0]
            if len(road.points) > len(points) + 2 and length > most:
                best, most, end_particles = road, length, self._end_particles
        self._end_particles = end_particles
        return best

    def step(self, road: RoadMidline, edges: EdgeDistance) -> RoadMidline | None:
        """The road, already moved into this frame, corrected by this frame's edges and extended at its ends.

        None where too few points are left near the image.
        """
        self._frames += 1
        kept = self._kept(align_to_edges(road, edges))
        if len(kept.points) < _MIN_POINTS:
            return None
        points = self._trimmed(kept.points, kept.half_width, edges)
        points = self._trimmed(points[::-1], kept.half_width, edges)[::-1]
        return self.extended(RoadMidline(points, kept.half_width), edges)

    def extended(self, road: RoadMidline, edges: EdgeDistance) -> RoadMidline:
        """The road extended at both ends for as long as white lines are found."""
        points = self._extend_end(road.points, road.half_width, edges, at_end=True)
        points = self._extend_end(points[::-1], road.half_width, edges, at_end=False)[::-1]
        return RoadMidline(points, road.half_width)

    def _extend_end(self, points: Floats, half_width: float, edges: EdgeDistance, at_end: bool) -> Floats:
        """``points`` with those found beyond the last one."""
        stride = _stride(half_width)
        gaps = _GAPS if self._frames % _GAPS_EVERY == 0 else _GAPS[:1]
        particles = self._end_particles.get(at_end)
        if particles is None:
            spread = self._rng.normal(0.0, _FIRST_CURVATURE / half_width, _PARTICLES)
            particles = pf.Particles.uniform(np.column_stack([np.zeros(_PARTICLES), spread]))
        model = ArcModel(_CURVATURE_NOISE / half_width)
        for _ in range(_MAX_STRIDES):
            if len(points) <= _FIT_STRIDES + 1 or not self._inside(points[-1]):
                break
            base, heading = _end_pose(points[-2 * _FIT_STRIDES - 1 :])
            known = float(np.hypot(*(points[-1] - base)))
            found = None
            for gap in gaps:
                new = known + stride * np.arange(1.0, gap + 1.0)
                lengths = np.concatenate([np.linspace(0.3 * known, known, 4), new[-3:]])
                seen = _ArcObservation(edges, base, heading, half_width, lengths)
                tried = pf.step(particles, model, seen, self._rng, resample_below=1.0)
                state = pf.weighted_mean(tried.states, tried.weights)[None]
                middle, normal = arcs(state, base, heading, new)
                if not self._inside(middle[0, 0]):
                    break
                last = slice(-3, None)
                # A gap has no evidence of curvature: an arc that turns there follows the lines of another road.
                straight = gap == 1 or abs(state[0, 1]) * (new[-1] - known) < _TURN_IN_GAP
                seen = line_distance(edges, middle[:, last], normal[:, last], half_width)[0] < _LINE_FOUND_PX
                if straight and seen:
                    found = middle[0]
                    particles = tried
                    break
            if found is None:
                break
            points = np.vstack([points, found])
        self._end_particles[at_end] = particles
        return points

    def _trimmed(self, points: Floats, half_width: float, edges: EdgeDistance) -> Floats:
        """``points`` without the last ones, where these are in the image without white lines beside them."""
        if len(points) <= _FIT_STRIDES + 4 or not self._inside(points[-1]):
            return points
        normal = _normals(points)
        last = slice(-3, None)
        if line_distance(edges, points[None, last], normal[None, last], half_width)[0] < _LINE_LOST_PX:
            return points
        return points[:-3]

    def _inside(self, point: Floats) -> bool:
        return bool(((point > _MARGIN) & (point < self._size - _MARGIN)).all())

    def _kept(self, road: RoadMidline) -> RoadMidline:
        far = np.hypot(*(road.points - self._size / 2).T) > _KEEP_RADIUS * float(np.hypot(*self._size))
        near = np.flatnonzero(~far)
        return RoadMidline(road.points[near[0] : near[-1] + 1] if len(near) else road.points[:0], road.half_width)


def align_to_edges(road: RoadMidline, edges: EdgeDistance) -> RoadMidline:
    """The road with its points in the image shifted laterally by a few pixels onto this frame's edges.

    The paper moves the points by the helicopter's controls, which it takes as exact; the motion estimated here is not,
    and its errors would accumulate.
    """
    points = road.points
    if len(points) < _MIN_POINTS:
        return road
    normal = _normals(points)
    tried = points[:, None] + _SHIFTS[None, :, None] * normal[:, None]
    cost = np.zeros(tried.shape[:2])
    seen = np.zeros(len(points), dtype=np.bool_)
    for side in (-1.0, 1.0):
        distance, inside = edges.at(tried + side * road.half_width * normal[:, None])
        cost += np.where(inside, distance, DISTANCE_CAP)
        seen |= inside.all(axis=1)
    smooth = uniform_filter1d(
        np.where(seen[:, None], cost, 2.0 * DISTANCE_CAP), _SMOOTHING_WINDOW, axis=0, mode="nearest"
    )
    best = np.argmin(smooth + 0.15 * np.abs(_SHIFTS), axis=1)
    good = seen & (smooth[np.arange(len(points)), best] < 2.0 * _LINE_FOUND_PX)
    shift = uniform_filter1d(np.where(good, _SHIFTS[best], 0.0), _SMOOTHING_WINDOW, mode="nearest")
    moved = points + 0.5 * shift[:, None] * normal
    return RoadMidline(moved, road.half_width * _width_change(moved, normal, road.half_width, edges, good))


def _width_change(points: Floats, normal: Floats, half_width: float, edges: EdgeDistance, good: np.ndarray) -> float:
    """Factor on the half width, as the flight altitude changes slowly."""
    if good.sum() < 4:
        return 1.0
    factors = np.array([0.98, 1.0, 1.02])
    costs = [line_distance(edges, points[None, good], normal[None, good], half_width * f)[0] for f in factors]
    best = int(np.argmin(np.array(costs) + [0.1, 0.0, 0.1]))
    return float(1.0 + 0.2 * (factors[best] - 1.0))


def fit_section(section: RoadSection, edges: EdgeDistance) -> RoadSection:
    """The section rotated, and each of its lines shifted independently, onto the nearest edges."""
    along = _stride(section.half_width) * np.linspace(-_FIT_STRIDES, _FIT_STRIDES, 17)
    angles = section.heading + _FIT_TURNS
    tangent = np.stack([np.cos(angles), np.sin(angles)], axis=-1)[:, None, None]
    normal = np.stack([-np.sin(angles), np.cos(angles)], axis=-1)[:, None, None]
    at, costs = [], []
    for side in (-1.0, 1.0):
        offsets = side * section.half_width + _FIT_SHIFTS
        distance, inside = edges.at(section.middle + along[:, None] * tangent + offsets[None, :, None, None] * normal)
        mean = np.where(inside, distance, DISTANCE_CAP).mean(axis=2) + 0.02 * np.abs(_FIT_SHIFTS)
        at.append(offsets[mean.argmin(axis=1)])
        costs.append(mean.min(axis=1))
    best = int(np.argmin(costs[0] + costs[1]))
    left, right = at[0][best], at[1][best]
    middle = section.middle + 0.5 * (left + right) * normal[best, 0, 0]
    half_width = max(0.5 * float(right - left), 0.5 * section.half_width)
    return RoadSection(middle, float(angles[best]), half_width)


def line_support(road: RoadMidline, edges: EdgeDistance) -> tuple[int, float]:
    """Number of points on the left and right lines with a white line, and their share of the points in the image."""
    normal = _normals(road.points)
    both = np.concatenate([road.points + road.half_width * normal, road.points - road.half_width * normal])
    distance, inside = edges.at(both)
    count = int((inside & (distance < _LINE_FOUND_PX)).sum())
    return count, count / max(int(inside.sum()), 1)


def _normals(points: Floats) -> Floats:
    """Unit normals (n, 2) of a polyline (n, 2), to the right of its direction in the image."""
    slope = np.gradient(points, axis=0)
    turned = np.column_stack([-slope[:, 1], slope[:, 0]])
    return np.asarray(turned / np.maximum(np.hypot(*slope.T), 1e-9)[:, None], dtype=np.float64)


def _stride(half_width: float) -> float:
    return max(_STRIDE * half_width, _MIN_STRIDE)


def _end_pose(points: Floats) -> tuple[Floats, float]:
    """A point (2,) some strides before the last of points (n, 2) and the road's heading there, by a quadratic fit."""
    count = len(points)
    at = max(count - 1 - _FIT_STRIDES, 0)
    t = np.arange(count, dtype=np.float64) - at
    design = np.column_stack([np.ones(count), t, t * t])[:, : min(3, count)]
    fit = np.linalg.lstsq(design, points, rcond=None)[0]
    return np.asarray(fit[0]), float(np.arctan2(fit[1, 1], fit[1, 0]))
