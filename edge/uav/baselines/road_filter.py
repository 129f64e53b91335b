"""Section 3.1: the road, followed along its white lines by a particle filter over position and curvature (3.3 to 3.8).

Coordinates that are held move with the background; those in the picture are set right by the edges of each frame; where
a part of the road comes into the picture for the first time, the filter walks into it, stride by stride.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from scipy.ndimage import uniform_filter1d

from edge.uav.baselines.road import Road
from edge.uav.baselines.white_lines import CAP, Edges, Section
from edge.uav.prediction import particles as pf
from protocols.geometry.types import Floats

_PARTICLES = 120
_SHARPNESS = 0.35  # lambda of (3.7) [1/px^2]
_OFFSET_STD = 1.5  # px: of the position that the spline gives
_BACK = 4  # strides of held road that the arc is laid over before it reaches into the new
_GAPS = (1, 3, 6, 10, 14)  # strides at once: a crossing or a shadow has no white lines
_TURN_IN_GAP = 0.25  # rad
_LINES_SEEN = 3.2  # px: mean distance to edges below which these are the white lines
_NO_LINES = 5.0  # px: the same, above which they are not
_GAPS_EVERY = 3  # frames
_STRIDES = 0.6  # a stride in half widths
_SHORTEST_STRIDE = 6.0  # px
_FIRST_CURVATURE = 0.05  # std at the start, in 1 / half width
_CURVATURE_NOISE = 0.03  # a stride; the same
_MARGIN = 6.0  # px that a new coordinate keeps from the border
_MOST_STRIDES = 60  # a frame and an end
_SHIFTS = np.arange(-4.0, 4.1)  # px
_FIT_TURNS = np.radians([-3.0, -1.5, 0.0, 1.5, 3.0])
_FIT_SHIFTS = np.arange(-12.0, 12.1)  # px
_SMOOTHED = 7  # coordinates that are shifted alike
_FEWEST = 6  # held coordinates: less is no road any more
_KEPT = 1.6  # image diagonals from the centre: held coordinates farther away are dropped


@dataclass(frozen=True, slots=True, eq=False)
class _Reach:
    """Where new arcs begin. base: (2,). heading [rad]. lengths: (m,) along the arc at which edges are asked for."""

    edges: Edges
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

        Deviation: the spline's position has an error of its own, or the filter could not step back onto the lines.
        """
        return np.column_stack(
            [
                rng.normal(0.0, _OFFSET_STD, len(states)),
                states[:, 1] + rng.normal(0.0, self.curvature_noise, len(states)),
            ]
        )

    def log_likelihood(self, states: Floats, observation: _Reach) -> Floats:
        """Eqs. (3.6) to (3.8): exp(-lambda d^2), d^2 the mean squared distance of both white lines to the edges."""
        middle, normal = arcs(states, observation.base, observation.heading, observation.lengths)
        return np.asarray(
            -_SHARPNESS * line_distance(observation.edges, middle, normal, observation.half_width, 2.0),
            dtype=np.float64,
        )


def arcs(states: Floats, base: Floats, heading: float, lengths: Floats) -> tuple[Floats, Floats]:
    """The road's middle S~ (n, m, 2) and normals (n, m, 2) of states (n, 2), at lengths (m,) [px] from base (2,)."""
    offset, curvature = states[:, 0, None], states[:, 1, None]
    turned = heading + curvature * lengths
    half = heading + 0.5 * curvature * lengths
    chord = lengths * np.sinc(0.5 * curvature * lengths / np.pi)
    x = base[0] - offset * np.sin(heading) + chord * np.cos(half)
    y = base[1] + offset * np.cos(heading) + chord * np.sin(half)
    return np.stack([x, y], axis=-1), np.stack([-np.sin(turned), np.cos(turned)], axis=-1)


def line_distance(edges: Edges, middle: Floats, normal: Floats, half_width: float, power: float = 1.0) -> Floats:
    """Mean (n,) over m of (capped) distance ** power to the edges, of the lines half_width to both sides of the middle.

    middle, normal: (n, m, 2). Only what is in the image counts; the cap where nothing is.
    """
    both = np.concatenate([middle + half_width * normal, middle - half_width * normal], axis=1)
    distance, inside = edges.at(both)
    seen = inside.sum(axis=1)
    total = (distance**power * inside).sum(axis=1)
    return np.asarray(np.where(seen > 0, total / np.maximum(seen, 1), CAP**power), dtype=np.float64)


class RoadFilter:
    """Keeps a road's shape from frame to frame. size: (width, height) [px]."""

    def __init__(self, size: tuple[int, int], rng: np.random.Generator) -> None:
        self._size, self._rng = np.array(size, dtype=np.float64), rng
        self._clouds: dict[bool, pf.Particles] = {}
        self._frames = 0

    def begin(self, edges: Edges, sections: Sequence[Section]) -> Road | None:
        """Trace white lines both ways from each section that the road may have beside the target.

        The road is what lies along the most of them; None if no white lines lead on from any.
        """
        best: Road | None = None
        most, clouds = 0.0, self._clouds
        for section in (fitted(part, edges) for part in sections):
            stride = _stride(section.half_width)
            along = stride * (np.arange(2 * _BACK + 1) - _BACK)
            points = section.middle + along[:, None] * np.array([np.cos(section.heading), np.sin(section.heading)])
            self._clouds, self._frames = {}, 0
            road = self.grown(Road(points, section.half_width), edges)
            length = stride * support(road, edges)[0]
            if len(road.points) > len(points) + 2 and length > most:
                best, most, clouds = road, length, self._clouds
        self._clouds = clouds
        return best

    def step(self, road: Road, edges: Edges) -> Road | None:
        """The road, moved into this frame already, set right by this frame's edges and followed into what is new.

        None where too little of it is left in the picture's surroundings.
        """
        self._frames += 1
        kept = self._kept(aligned(road, edges))
        if len(kept.points) < _FEWEST:
            return None
        points = self._trimmed(kept.points, kept.half_width, edges)
        points = self._trimmed(points[::-1], kept.half_width, edges)[::-1]
        return self.grown(Road(points, kept.half_width), edges)

    def grown(self, road: Road, edges: Edges) -> Road:
        """Both ends walked on for as long as white lines are seen."""
        points = self._walk(road.points, road.half_width, edges, at_end=True)
        points = self._walk(points[::-1], road.half_width, edges, at_end=False)[::-1]
        return Road(points, road.half_width)

    def _walk(self, points: Floats, half_width: float, edges: Edges, at_end: bool) -> Floats:
        """points with what was found beyond the last one."""
        stride = _stride(half_width)
        gaps = _GAPS if self._frames % _GAPS_EVERY == 0 else _GAPS[:1]
        cloud = self._clouds.get(at_end)
        if cloud is None:
            spread = self._rng.normal(0.0, _FIRST_CURVATURE / half_width, _PARTICLES)
            cloud = pf.Particles.evenly(np.column_stack([np.zeros(_PARTICLES), spread]))
        model = ArcModel(_CURVATURE_NOISE / half_width)
        for _ in range(_MOST_STRIDES):
            if len(points) <= _BACK + 1 or not self._inside(points[-1]):
                break
            base, heading = _end_pose(points[-2 * _BACK - 1 :])
            known = float(np.hypot(*(points[-1] - base)))
            found = None
            for gap in gaps:
                new = known + stride * np.arange(1.0, gap + 1.0)
                asked = np.concatenate([np.linspace(0.3 * known, known, 4), new[-3:]])
                tried = pf.step(
                    cloud, model, _Reach(edges, base, heading, half_width, asked), self._rng, resample_below=1.0
                )
                state = pf.weighted_mean(tried.states, tried.weights)[None]
                middle, normal = arcs(state, base, heading, new)
                if not self._inside(middle[0, 0]):
                    break
                last = slice(-3, None)
                # Over a gap there is nothing to bend by: what turns there has taken another road's lines.
                straight = gap == 1 or abs(state[0, 1]) * (new[-1] - known) < _TURN_IN_GAP
                seen = line_distance(edges, middle[:, last], normal[:, last], half_width)[0] < _LINES_SEEN
                if straight and seen:
                    found = middle[0]
                    cloud = tried
                    break
            if found is None:
                break
            points = np.vstack([points, found])
        self._clouds[at_end] = cloud
        return points

    def _trimmed(self, points: Floats, half_width: float, edges: Edges) -> Floats:
        """points without the last ones, where these are in the picture and no white lines beside them."""
        if len(points) <= _BACK + 4 or not self._inside(points[-1]):
            return points
        normal = _normals(points)
        last = slice(-3, None)
        if line_distance(edges, points[None, last], normal[None, last], half_width)[0] < _NO_LINES:
            return points
        return points[:-3]

    def _inside(self, point: Floats) -> bool:
        return bool(((point > _MARGIN) & (point < self._size - _MARGIN)).all())

    def _kept(self, road: Road) -> Road:
        far = np.hypot(*(road.points - self._size / 2).T) > _KEPT * float(np.hypot(*self._size))
        near = np.flatnonzero(~far)
        return Road(road.points[near[0] : near[-1] + 1] if len(near) else road.points[:0], road.half_width)


def aligned(road: Road, edges: Edges) -> Road:
    """The road with what is in the picture shifted across by a few pixels onto this frame's edges.

    The paper moves the coordinates by the helicopter's controls, which it takes as exact; the motion estimated here is
    not, and its errors would add up.
    """
    points = road.points
    if len(points) < _FEWEST:
        return road
    normal = _normals(points)
    tried = points[:, None] + _SHIFTS[None, :, None] * normal[:, None]
    cost = np.zeros(tried.shape[:2])
    seen = np.zeros(len(points), dtype=np.bool_)
    for side in (-1.0, 1.0):
        distance, inside = edges.at(tried + side * road.half_width * normal[:, None])
        cost += np.where(inside, distance, CAP)
        seen |= inside.all(axis=1)
    smooth = uniform_filter1d(np.where(seen[:, None], cost, 2.0 * CAP), _SMOOTHED, axis=0, mode="nearest")
    best = np.argmin(smooth + 0.15 * np.abs(_SHIFTS), axis=1)
    good = seen & (smooth[np.arange(len(points)), best] < 2.0 * _LINES_SEEN)
    shift = uniform_filter1d(np.where(good, _SHIFTS[best], 0.0), _SMOOTHED, mode="nearest")
    moved = points + 0.5 * shift[:, None] * normal
    return Road(moved, road.half_width * _width_change(moved, normal, road.half_width, edges, good))


def _width_change(points: Floats, normal: Floats, half_width: float, edges: Edges, good: np.ndarray) -> float:
    """Factor on the half width: the flight's height changes slowly."""
    if good.sum() < 4:
        return 1.0
    factors = np.array([0.98, 1.0, 1.02])
    costs = [line_distance(edges, points[None, good], normal[None, good], half_width * f)[0] for f in factors]
    best = int(np.argmin(np.array(costs) + [0.1, 0.0, 0.1]))
    return float(1.0 + 0.2 * (factors[best] - 1.0))


def fitted(section: Section, edges: Edges) -> Section:
    """The section turned and its lines shifted, each by itself, onto the nearest edges along both of them."""
    along = _stride(section.half_width) * np.linspace(-_BACK, _BACK, 17)
    angles = section.heading + _FIT_TURNS
    tangent = np.stack([np.cos(angles), np.sin(angles)], axis=-1)[:, None, None]
    normal = np.stack([-np.sin(angles), np.cos(angles)], axis=-1)[:, None, None]
    at, costs = [], []
    for side in (-1.0, 1.0):
        offsets = side * section.half_width + _FIT_SHIFTS
        distance, inside = edges.at(section.middle + along[:, None] * tangent + offsets[None, :, None, None] * normal)
        mean = np.where(inside, distance, CAP).mean(axis=2) + 0.02 * np.abs(_FIT_SHIFTS)
        at.append(offsets[mean.argmin(axis=1)])
        costs.append(mean.min(axis=1))
    best = int(np.argmin(costs[0] + costs[1]))
    left, right = at[0][best], at[1][best]
    middle = section.middle + 0.5 * (left + right) * normal[best, 0, 0]
    half_width = max(0.5 * float(right - left), 0.5 * section.half_width)
    return Section(middle, float(angles[best]), half_width)


def support(road: Road, edges: Edges) -> tuple[int, float]:
    """How many of a road's places on its left and right have a white line, and what share of those in the picture."""
    normal = _normals(road.points)
    both = np.concatenate([road.points + road.half_width * normal, road.points - road.half_width * normal])
    distance, inside = edges.at(both)
    count = int((inside & (distance < _LINES_SEEN)).sum())
    return count, count / max(int(inside.sum()), 1)


def _normals(points: Floats) -> Floats:
    """Unit normals (n, 2) of a line of points (n, 2), to the right of its order on the screen."""
    slope = np.gradient(points, axis=0)
    turned = np.column_stack([-slope[:, 1], slope[:, 0]])
    return np.asarray(turned / np.maximum(np.hypot(*slope.T), 1e-9)[:, None], dtype=np.float64)


def _stride(half_width: float) -> float:
    return max(_STRIDES * half_width, _SHORTEST_STRIDE)


def _end_pose(points: Floats) -> tuple[Floats, float]:
    """A place (2,) some strides before the last of points (n, 2) and the road's heading there, by a quadratic fit."""
    count = len(points)
    at = max(count - 1 - _BACK, 0)
    t = np.arange(count, dtype=np.float64) - at
    design = np.column_stack([np.ones(count), t, t * t])[:, : min(3, count)]
    fit = np.linalg.lstsq(design, points, rcond=None)[0]
    return np.asarray(fit[0]), float(np.arctan2(fit[1, 1], fit[1, 0]))
