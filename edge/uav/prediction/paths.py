"""Road paths ahead of the target, traced on the road map by candidate arcs from its last known position.

On known road a path stays on it at a constant distance from its edges; beyond it continues as an arc of decaying
curvature, where the cubic spline of the background-aware tracking paper (eq. 3.1) diverges; side roads give further
paths.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from edge.uav.ground.road_map import RoadMap, kernel_arguments
from protocols.geometry import kernels
from protocols.geometry.types import Floats

STEP = 1.5
"""Distance between the points of a path [ground units]."""
_LOOKAHEAD = 18.0  # length of a candidate arc
# Clip of the log-odds, for crowns of trees hide road that continues below them, and value of unknown cells: with less,
# paths would bend back to known road.
_CELL_VALUES = (-0.5, 1.5, 1.35)
_LANE_OFFSETS = (-1.1, 0.0, 1.1)  # lateral, within the car's lane
_ROAD_OFFSETS, _EDGE_MARGIN = 5, 0.8  # number of lateral offsets across a known road, margin to its edges
_ROAD_WIDTH_LIMITS = (3.0, 14.0)  # plausible
_MIN_EDGE_DISTANCE = 1.3  # of a car from an edge
_MAX_CURVATURE = 0.16  # of a candidate arc [1/unit]
_CURVATURE_DECAY = 14.0  # length constant of the decay on unknown ground
_EDGE_REACH = 9.0  # to each side [ground units]: half of the widest road, and two more
_EDGE_STEP = 0.5  # of the search for an edge: a cell of the map
_OFF_ROAD, _UNSEEN = -0.4, 0.15  # log-odds of what is no road, and size of those of what is hardly known
_MOST_UNSEEN = 2  # cells that are hardly known before an edge
_KNOWN = 0.05  # size of log-odds from which a cell counts as observed
_NEAR_STEPS = 3  # first points of the arcs, without any of which the road ends
_CURVATURE_HALF_WINDOW = 2  # steps to each side over which curvature is measured
_SIDE_RADII = (7.0, 11.0)  # of the arc into a side road [ground units]: a tight and a wide turn
_SIDE_LENGTH = 16.0  # of a side road that must be known
_LANE_POINTS = 6  # last points of a turn from which the lane is estimated
_MAX_EDGE_DISAGREEMENT = 0.8  # between the two edges: beyond, one of them is occluded
_MAX_LANE_SHIFT = 5.0  # to a lane of the same road [ground units]

_CURVATURES = _MAX_CURVATURE * np.sinh(np.linspace(-2.2, 2.2, 29)) / np.sinh(2.2)


@dataclass(frozen=True, slots=True, eq=False)
class RoadPath:
    """A path on the ground. points: (m, 2), STEP apart; headings: (m,) [rad]; known_length: observed as road.

    weight: probability that the car takes it; the paths of one position add up to 1.
    """

    points: Floats
    headings: Floats
    known_length: float
    weight: float

    def pose_at(self, arc_length: Floats, lateral_offset: Floats) -> tuple[Floats, Floats]:
        """Ground points (n, 2) and headings (n,) at arc lengths (n,) and offsets to the right (n,)."""
        index = np.clip(arc_length / STEP, 0.0, len(self.points) - 1.001)
        low = index.astype(np.int64)
        fraction = index - low
        # Before the start and beyond the end: straight extrapolation.
        beyond = arc_length - np.clip(arc_length, 0.0, (len(self.points) - 1.001) * STEP)
        heading = self.headings[low] + fraction * _wrap_angle(self.headings[low + 1] - self.headings[low])
        at = self.points[low] + fraction[:, None] * (self.points[low + 1] - self.points[low])
        forward = np.column_stack([np.cos(heading), np.sin(heading)])
        right = np.column_stack([-forward[:, 1], forward[:, 0]])
        return at + beyond[:, None] * forward + lateral_offset[:, None] * right, heading

    def curvature_at(self, arc_length: Floats) -> Floats:
        """(n,) curvature [1/unit] at arc lengths (n,), over several points: a single step is noisy."""
        middle = (arc_length / STEP).astype(np.int64)
        last = len(self.points) - 1
        low, high = (
            np.clip(middle - _CURVATURE_HALF_WINDOW, 0, last - 1),
            np.clip(middle + _CURVATURE_HALF_WINDOW, 1, last),
        )
        return np.asarray(_wrap_angle(self.headings[high] - self.headings[low]) / ((high - low) * STEP))


def road_edges(road: RoadMap, points: Floats, headings: Floats) -> tuple[Floats, Floats]:
    """Distances (n,) to the road's edge on the right and on the left, NaN where none is found within reach."""
    reach = np.arange(0.0, _EDGE_REACH, _EDGE_STEP)
    if kernels.AVAILABLE:
        both, given = np.empty((2, len(points))), (np.ascontiguousarray(points), np.ascontiguousarray(headings))
        limits = len(reach), _EDGE_STEP, _OFF_ROAD, _UNSEEN, _MOST_UNSEEN
        kernels.call("road_edges", *kernel_arguments(*road.smooth_grid), len(points), *given, *limits, both)
        return both[0], both[1]
    right = np.column_stack([-np.sin(headings), np.cos(headings)])
    found = []
    for sign in (1.0, -1.0):
        line = points[:, None, :] + sign * reach[None, :, None] * right[:, None, :]
        odds = road.smooth_log_odds(line.reshape(-1, 2)).reshape(len(points), -1)
        off_road = odds < _OFF_ROAD
        first = np.argmax(off_road, axis=1)
        # Not if there are unknown cells before the edge.
        known = np.cumsum(np.abs(odds) < _UNSEEN, axis=1)[np.arange(len(points)), first] <= _MOST_UNSEEN
        found.append(np.where(off_road.any(axis=1) & known & (first > 0), reach[first], np.nan))
    return found[0], found[1]


def trace_paths(
    road: RoadMap,
    start: Floats,
    heading: float,
    curvature: float,
    length: float,
    edge_distances: tuple[float, float],
    turn_probability: float = 0.36,
) -> list[RoadPath]:
    """Road paths from ``start`` (2,). edge_distances: to the right and left edge there, NaN where unknown.

    curvature: of the car's present path [1/unit]. length: of the paths. turn_probability: that it leaves the road at a
    junction. The first path follows the road itself.
    """
    road.smooth_around(start, length + 25.0)
    main = _trace_one(road, start, heading, curvature, length, edge_distances)
    found = [main]
    for side in _side_roads(road, main[0], main[1]):
        index, points, headings = side
        points = _shift_into_lane(road, points, headings, edge_distances)
        rest = max(length - STEP * (index + len(points)), 0.0)
        tail = _trace_one(road, points[-1], float(headings[-1]), 0.0, max(rest, 3 * STEP), edge_distances)
        found.append(
            (
                np.concatenate([main[0][:index], points, tail[0][1:]]),
                np.concatenate([main[1][:index], headings, tail[1][1:]]),
                STEP * (index + len(points)) + tail[2],
            )
        )
    share = turn_probability / max(len(found) - 1, 1)
    weights = [1.0] if len(found) == 1 else [1.0 - turn_probability] + [share] * (len(found) - 1)
    return [RoadPath(p, h, k, w) for (p, h, k), w in zip(found, weights, strict=True)]


def _trace_one(
    road: RoadMap, start: Floats, heading: float, curvature: float, length: float, edge_distances: tuple[float, float]
) -> tuple[Floats, Floats, float]:
    """One path: points (m, 2), headings (m,), and its known length."""
    arc_length = np.linspace(1.5, _LOOKAHEAD, 8)
    # Candidate arcs in the car's axes: (curvature, arc length, lateral offset).
    angle = _CURVATURES[:, None] * arc_length[None, :]
    is_straight = np.abs(angle) < 1e-6
    safe_angle = np.where(is_straight, 1.0, angle)
    forward = np.where(is_straight, 1.0, np.sin(safe_angle) / safe_angle) * arc_length
    lateral = np.where(is_straight, 0.0, (1.0 - np.cos(safe_angle)) / safe_angle) * arc_length
    offsets = _lateral_offsets(edge_distances)
    lx = forward[:, :, None] - np.sin(angle)[:, :, None] * offsets
    ly = lateral[:, :, None] + np.cos(angle)[:, :, None] * offsets
    weights = np.linspace(1.3, 0.7, len(arc_length))
    points, headings = [start], [heading]
    at, known, past_known = start, 0.0, False
    for _ in range(max(int(np.ceil(length / STEP)), 2)):
        value, observed, near = _look_ahead(road, at, heading, (lx, ly), weights)
        expected = curvature * np.exp(-STEP / _CURVATURE_DECAY)
        best = int(np.argmax(value - 60.0 * np.square(_CURVATURES - expected) - 14.0 * np.square(_CURVATURES)))
        if not near:
            curvature, past_known = expected, True
        else:
            # Near the end of known road only one side is known, which hardly determines the curvature.
            expected_arc = int(np.argmin(np.abs(_CURVATURES - expected)))
            gain = 0.5 * max(0.0, 2.5 * float(observed[expected_arc]) - 1.5) ** 2
            curvature += gain * (float(_CURVATURES[best]) - curvature)
        heading = heading + curvature * STEP
        at = at + STEP * np.array([np.cos(heading - 0.5 * curvature * STEP), np.sin(heading - 0.5 * curvature * STEP)])
        if not past_known:
            known += STEP
            correction = _lateral_correction(road, at, heading, edge_distances)
            at = at + correction * np.array([-np.sin(heading), np.cos(heading)])
            heading += 0.15 * correction / STEP
        points.append(at)
        headings.append(heading)
    return np.array(points), np.array(headings), known


def _look_ahead(
    road: RoadMap, at: Floats, heading: float, arcs: tuple[Floats, Floats], weights: Floats
) -> tuple[Floats, Floats, bool]:
    """Mean values (a,) along arcs (a, m, k) ahead and aside of a car, shares (a,) that are observed, and whether any is
    where they begin. weights: (m,) of the steps.
    """
    if kernels.AVAILABLE:
        out, limits = np.empty(2 * len(arcs[0]) + 1), np.array(_CELL_VALUES)
        given = *arcs[0].shape, *arcs, weights, *at.tolist(), float(heading), _KNOWN, limits, _NEAR_STEPS, out
        kernels.call("arc_values", *kernel_arguments(*road.smooth_grid), *given)
        return out[: len(arcs[0])], out[len(arcs[0]) : -1], bool(out[-1])
    c, s = np.cos(heading), np.sin(heading)
    line = np.stack([at[0] + c * arcs[0] - s * arcs[1], at[1] + s * arcs[0] + c * arcs[1]], axis=-1)
    odds = road.smooth_log_odds(line.reshape(-1, 2)).reshape(arcs[0].shape)
    observed = np.abs(odds) > _KNOWN
    value = np.where(observed, np.clip(odds, *_CELL_VALUES[:2]), _CELL_VALUES[2])
    mean = (value * weights[:, None]).mean(axis=(1, 2))
    return mean, observed.mean(axis=(1, 2)), bool(observed[:, :_NEAR_STEPS].any())


def _lateral_offsets(edge_distances: tuple[float, float]) -> Floats:
    """Lateral offsets sampled along an arc: the whole road where both edges are known, else the lane.

    A tree crown over the lane leaves the rest of the road visible.
    """
    right, left = edge_distances
    if not (_ROAD_WIDTH_LIMITS[0] < right + left < _ROAD_WIDTH_LIMITS[1] and min(edge_distances) > _MIN_EDGE_DISTANCE):
        return np.array(_LANE_OFFSETS)
    return np.linspace(_EDGE_MARGIN - left, right - _EDGE_MARGIN, _ROAD_OFFSETS)


def _lateral_correction(road: RoadMap, at: Floats, heading: float, edge_distances: tuple[float, float]) -> float:
    """Shift to the right that keeps the distances to the edges constant; at most 0.4 per step."""
    if not (np.isfinite(edge_distances[0]) or np.isfinite(edge_distances[1])):
        return 0.0
    right, left = road_edges(road, at[None], np.array([heading]))
    errors = []
    if np.isfinite(right[0]) and np.isfinite(edge_distances[0]) and abs(right[0] - edge_distances[0]) < 3.0:
        errors.append(float(right[0]) - edge_distances[0])
    if np.isfinite(left[0]) and np.isfinite(edge_distances[1]) and abs(left[0] - edge_distances[1]) < 3.0:
        errors.append(edge_distances[1] - float(left[0]))
    if not errors:
        return 0.0
    if len(errors) == 2 and abs(errors[0] - errors[1]) > _MAX_EDGE_DISAGREEMENT:
        # An occluder over one edge brings it nearer and leaves the other unchanged.
        errors = [min(errors, key=abs)]
    return float(np.clip(0.35 * np.mean(errors), -0.4, 0.4))


def _shift_into_lane(road: RoadMap, points: Floats, headings: Floats, edge_distances: tuple[float, float]) -> Floats:
    """A turn (m, 2) shifted so that it ends at the same distance from the nearer edge as the car keeps now.

    A car that drives on the right continues on the right of the side road.
    """
    side = 0 if not np.isfinite(edge_distances[1]) or edge_distances[0] <= edge_distances[1] else 1
    if not np.isfinite(edge_distances[side]):
        return points
    found = road_edges(road, points[-_LANE_POINTS:], headings[-_LANE_POINTS:])[side]
    found = found[np.isfinite(found)]
    if len(found) < 3:
        return points
    lateral = (float(np.median(found)) - edge_distances[side]) * (1.0 if side == 0 else -1.0)
    if abs(lateral) > _MAX_LANE_SHIFT:
        return points
    # Applied smoothly over the turn.
    share = np.clip(np.arange(1, len(points) + 1) / max(len(points) - _LANE_POINTS, 1), 0.0, 1.0)
    right = np.column_stack([-np.sin(headings), np.cos(headings)])
    return np.asarray(points + (lateral * share * share * (3.0 - 2.0 * share))[:, None] * right)


def _side_roads(road: RoadMap, points: Floats, headings: Floats) -> list[tuple[int, Floats, Floats]]:
    """Side roads: index on the path, and the turn into each as points and headings; at most two per side."""
    starts = np.arange(0, len(points) - 2, 2)
    found: list[tuple[float, int, Floats, Floats]] = []
    for sign in (-1.0, 1.0):
        best: list[tuple[float, int, Floats, Floats]] = []
        for radius in _SIDE_RADII:
            arc = np.arange(STEP, 0.5 * np.pi * radius, STEP) / radius
            straight = np.arange(STEP, _SIDE_LENGTH, STEP)
            x = np.concatenate([radius * np.sin(arc), radius + 0.0 * straight])
            y = np.concatenate([radius * (1 - np.cos(arc)), radius + straight]) * sign
            turn = np.concatenate([arc, np.full(len(straight), 0.5 * np.pi)]) * sign
            c, s = np.cos(headings[starts])[:, None], np.sin(headings[starts])[:, None]
            line = points[starts][:, None, :] + np.stack([c * x - s * y, s * x + c * y], axis=-1)
            odds = road.smooth_log_odds(line.reshape(-1, 2)).reshape(len(starts), -1)
            value = np.clip(odds, -2.0, 1.5)
            score = value.mean(axis=1)
            # A side road is road along the whole turn, in contrast to wide asphalt.
            worst = value.min(axis=1)
            for k in np.flatnonzero((score > 0.85) & (worst > -0.3)):
                best.append((float(score[k]), int(starts[k]), line[k], headings[starts[k]] + turn))
        best.sort(key=lambda entry: -entry[0])
        kept: list[tuple[float, int, Floats, Floats]] = []
        for entry in best:
            if all(np.linalg.norm(entry[2][-1] - other[2][-1]) > 12.0 for other in kept) and len(kept) < 2:
                kept.append(entry)
        found.extend(kept)
    # A candidate that ends on the path itself is a bend and no side road.
    out = []
    for _, index, line, turn in found:
        gap = np.linalg.norm(points - line[-1], axis=1).min()
        if gap > 6.0:
            out.append((index, line, turn))
    return out


def _wrap_angle(angle: Floats) -> Floats:
    return np.asarray((angle + np.pi) % (2 * np.pi) - np.pi)
