"""The ways ahead on the road map: arcs tried like feelers from the last place where the car was seen.

Where the road is known the way stays on it and keeps its distance from the edges; beyond the known end it goes on
as an arc of decaying curvature; where other roads leave, there are further ways (METHODS B, 3).
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from edge.uav.ground.road_map import RoadMap
from protocols.geometry.types import Floats

STEP = 1.5
"""Distance between the points of a way [ground units]."""
_LOOK = 18.0  # length of a feeler
_LEAST = -0.5  # what surely no road is worth: crowns of trees hang over a road that goes on below them
_STRIPS = (-1.1, 0.0, 1.1)  # across, within the car's lane
_ACROSS, _VERGE = 5, 0.8  # strips where the whole road's width is known, and how far within its edges they lie
_WIDTHS = (3.0, 14.0)  # of a road, least and most
_LANE_HALF = 1.3  # least distance of a car from an edge that is one
_UNKNOWN = 1.35  # what never-seen ground is worth, asphalt being up to 1.5: less would bend ways back to what is known
_SHARPEST = 0.16  # curvature of a feeler [1/unit]
_DECAY = 14.0  # length over which curvature decays where nothing is known
_EDGE_REACH = 9.0
_SMOOTH = 2  # steps to each side over which a bend is measured
_SIDE_RADII = (7.0, 11.0)
_SIDE_LOOK = 16.0  # of a side road that must be seen to count
_LANE_POINTS = 6  # points of a turn, the last, from which the lane is told
_DISAGREE = 0.8  # of what both edges say: more, and something hangs over one of them
_MOST_ASIDE = 5.0  # a lane farther aside is not one of this road's [ground units]

_CURVATURES = _SHARPEST * np.sinh(np.linspace(-2.2, 2.2, 29)) / np.sinh(2.2)


@dataclass(frozen=True, slots=True, eq=False)
class Way:
    """A line on the ground. points: (m, 2), STEP apart; headings: (m,) [rad]; known: length seen to be road.

    weight: how likely the car takes it; the ways of one place add up to 1.
    """

    points: Floats
    headings: Floats
    known: float
    weight: float

    def at(self, along: Floats, across: Floats) -> tuple[Floats, Floats]:
        """Ground points (n, 2) and headings (n,) at lengths (n,) and offsets to the right (n,)."""
        index = np.clip(along / STEP, 0.0, len(self.points) - 1.001)
        low = index.astype(np.int64)
        share = index - low
        # Before the start and beyond the end: straight on.
        beyond = along - np.clip(along, 0.0, (len(self.points) - 1.001) * STEP)
        heading = self.headings[low] + share * _wrap(self.headings[low + 1] - self.headings[low])
        at = self.points[low] + share[:, None] * (self.points[low + 1] - self.points[low])
        forward = np.column_stack([np.cos(heading), np.sin(heading)])
        right = np.column_stack([-forward[:, 1], forward[:, 0]])
        return at + beyond[:, None] * forward + across[:, None] * right, heading

    def bend(self, along: Floats) -> Floats:
        """(n,) curvature [1/unit] at lengths (n,), over _SMOOTH points to each side: a single step is noise."""
        middle = (along / STEP).astype(np.int64)
        last = len(self.points) - 1
        low, high = np.clip(middle - _SMOOTH, 0, last - 1), np.clip(middle + _SMOOTH, 1, last)
        return np.asarray(_wrap(self.headings[high] - self.headings[low]) / ((high - low) * STEP))


def edges(road: RoadMap, points: Floats, headings: Floats) -> tuple[Floats, Floats]:
    """Distances (n,) to the road's edge on the right (+) and on the left, NaN where none is seen within reach."""
    reach = np.arange(0.0, _EDGE_REACH, 0.5)
    right = np.column_stack([-np.sin(headings), np.cos(headings)])
    found = []
    for sign in (1.0, -1.0):
        line = points[:, None, :] + sign * reach[None, :, None] * right[:, None, :]
        odds = road.smooth_at(line.reshape(-1, 2)).reshape(len(points), -1)
        off = odds < -0.4
        first = np.argmax(off, axis=1)
        # Not if something unknown lies before the edge.
        known = np.cumsum(np.abs(odds) < 0.15, axis=1)[np.arange(len(points)), first] <= 2
        found.append(np.where(off.any(axis=1) & known & (first > 0), reach[first], np.nan))
    return found[0], found[1]


def trace(
    road: RoadMap,
    start: Floats,
    heading: float,
    curvature: float,
    length: float,
    keep: tuple[float, float],
    turning: float = 0.36,
) -> list[Way]:
    """The ways from ``start`` (2,). keep: distances to the right and left edge there, NaN where not seen.

    curvature: of the car's path now [1/unit]. length: how far to go. turning: chance that it leaves the road where it
    can. The first way is the road's own course.
    """
    road.prepare(start, length + 25.0)
    main = _follow(road, start, heading, curvature, length, keep)
    found = [main]
    for side in _sides(road, main[0], main[1]):
        index, points, headings = side
        points = _into_lane(road, points, headings, keep)
        rest = max(length - STEP * (index + len(points)), 0.0)
        tail = _follow(road, points[-1], float(headings[-1]), 0.0, max(rest, 3 * STEP), keep)
        found.append(
            (
                np.concatenate([main[0][:index], points, tail[0][1:]]),
                np.concatenate([main[1][:index], headings, tail[1][1:]]),
                STEP * (index + len(points)) + tail[2],
            )
        )
    share = turning / max(len(found) - 1, 1)
    weights = [1.0] if len(found) == 1 else [1.0 - turning] + [share] * (len(found) - 1)
    return [Way(p, h, k, w) for (p, h, k), w in zip(found, weights, strict=True)]


def _follow(
    road: RoadMap, start: Floats, heading: float, curvature: float, length: float, keep: tuple[float, float]
) -> tuple[Floats, Floats, float]:
    """One way: points (m, 2), headings (m,), and the length of it that is known."""
    along = np.linspace(1.5, _LOOK, 8)
    # Feelers in the car's own axes: (curvature, length, strip).
    turn = _CURVATURES[:, None] * along[None, :]
    flat = np.abs(turn) < 1e-6
    safe = np.where(flat, 1.0, turn)
    ahead = np.where(flat, 1.0, np.sin(safe) / safe) * along
    aside = np.where(flat, 0.0, (1.0 - np.cos(safe)) / safe) * along
    strips = _strips(keep)
    lx = ahead[:, :, None] - np.sin(turn)[:, :, None] * strips
    ly = aside[:, :, None] + np.cos(turn)[:, :, None] * strips
    near = np.linspace(1.3, 0.7, len(along))[None, :, None]
    points, headings = [start], [heading]
    at, known, open_end = start, 0.0, False
    for _ in range(max(int(np.ceil(length / STEP)), 2)):
        c, s = np.cos(heading), np.sin(heading)
        line = np.stack([at[0] + c * lx - s * ly, at[1] + s * lx + c * ly], axis=-1)
        odds = road.smooth_at(line.reshape(-1, 2)).reshape(lx.shape)
        seen = np.abs(odds) > 0.05
        value = np.where(seen, np.clip(odds, _LEAST, 1.5), _UNKNOWN)
        expected = curvature * np.exp(-STEP / _DECAY)
        score = (value * near).mean(axis=(1, 2))
        score = score - 60.0 * np.square(_CURVATURES - expected) - 14.0 * np.square(_CURVATURES)
        best = int(np.argmax(score))
        if not seen[:, :3].any():
            curvature, open_end = expected, True
        else:
            # Near the end of what is known the known lies on one side, which says little of a bend.
            on = int(np.argmin(np.abs(_CURVATURES - expected)))
            trust = 0.5 * max(0.0, 2.5 * float(seen[on].mean()) - 1.5) ** 2
            curvature += trust * (float(_CURVATURES[best]) - curvature)
        heading = heading + curvature * STEP
        at = at + STEP * np.array([np.cos(heading - 0.5 * curvature * STEP), np.sin(heading - 0.5 * curvature * STEP)])
        if not open_end:
            known += STEP
            side = _side_shift(road, at, heading, keep)
            at = at + side * np.array([-np.sin(heading), np.cos(heading)])
            heading += 0.15 * side / STEP
        points.append(at)
        headings.append(heading)
    return np.array(points), np.array(headings), known


def _strips(keep: tuple[float, float]) -> Floats:
    """Offsets to the right at which a feeler looks: all of the road where both edges are known, else the lane.

    A crown over the lane leaves the rest of the road in sight.
    """
    right, left = keep
    if not (_WIDTHS[0] < right + left < _WIDTHS[1] and min(keep) > _LANE_HALF):
        return np.array(_STRIPS)
    return np.linspace(_VERGE - left, right - _VERGE, _ACROSS)


def _side_shift(road: RoadMap, at: Floats, heading: float, keep: tuple[float, float]) -> float:
    """How far to the right to go so that the distances to the edges stay what they were; at most 0.4 a step."""
    if not (np.isfinite(keep[0]) or np.isfinite(keep[1])):
        return 0.0
    right, left = edges(road, at[None], np.array([heading]))
    errors = []
    if np.isfinite(right[0]) and np.isfinite(keep[0]) and abs(right[0] - keep[0]) < 3.0:
        errors.append(float(right[0]) - keep[0])
    if np.isfinite(left[0]) and np.isfinite(keep[1]) and abs(left[0] - keep[1]) < 3.0:
        errors.append(keep[1] - float(left[0]))
    if not errors:
        return 0.0
    if len(errors) == 2 and abs(errors[0] - errors[1]) > _DISAGREE:
        # What hangs over one edge brings it nearer, and leaves the other where it is.
        errors = [min(errors, key=abs)]
    return float(np.clip(0.35 * np.mean(errors), -0.4, 0.4))


def _into_lane(road: RoadMap, points: Floats, headings: Floats, keep: tuple[float, float]) -> Floats:
    """A turn (m, 2) moved aside so that it ends as far from the nearer edge of the side road as the car keeps now.

    Who drives on the right drives on the right there too.
    """
    near = 0 if not np.isfinite(keep[1]) or keep[0] <= keep[1] else 1
    if not np.isfinite(keep[near]):
        return points
    found = edges(road, points[-_LANE_POINTS:], headings[-_LANE_POINTS:])[near]
    found = found[np.isfinite(found)]
    if len(found) < 3:
        return points
    aside = (float(np.median(found)) - keep[near]) * (1.0 if near == 0 else -1.0)
    if abs(aside) > _MOST_ASIDE:
        return points
    # Over the turn itself, smoothly.
    share = np.clip(np.arange(1, len(points) + 1) / max(len(points) - _LANE_POINTS, 1), 0.0, 1.0)
    right = np.column_stack([-np.sin(headings), np.cos(headings)])
    return np.asarray(points + (aside * share * share * (3.0 - 2.0 * share))[:, None] * right)


def _sides(road: RoadMap, points: Floats, headings: Floats) -> list[tuple[int, Floats, Floats]]:
    """Roads that leave the way: where, and the turn into each as points and headings; at most two a side."""
    every = np.arange(0, len(points) - 2, 2)
    found: list[tuple[float, int, Floats, Floats]] = []
    for sign in (-1.0, 1.0):
        best: list[tuple[float, int, Floats, Floats]] = []
        for radius in _SIDE_RADII:
            bend = np.arange(STEP, 0.5 * np.pi * radius, STEP) / radius
            straight = np.arange(STEP, _SIDE_LOOK, STEP)
            x = np.concatenate([radius * np.sin(bend), radius + 0.0 * straight])
            y = np.concatenate([radius * (1 - np.cos(bend)), radius + straight]) * sign
            turn = np.concatenate([bend, np.full(len(straight), 0.5 * np.pi)]) * sign
            c, s = np.cos(headings[every])[:, None], np.sin(headings[every])[:, None]
            line = points[every][:, None, :] + np.stack([c * x - s * y, s * x + c * y], axis=-1)
            odds = road.smooth_at(line.reshape(-1, 2)).reshape(len(every), -1)
            value = np.clip(odds, -2.0, 1.5)
            score = value.mean(axis=1)
            # A side road has a verge before and after it: not just wide asphalt.
            worst = value.min(axis=1)
            for k in np.flatnonzero((score > 0.85) & (worst > -0.3)):
                best.append((float(score[k]), int(every[k]), line[k], headings[every[k]] + turn))
        best.sort(key=lambda entry: -entry[0])
        kept: list[tuple[float, int, Floats, Floats]] = []
        for entry in best:
            if all(np.linalg.norm(entry[2][-1] - other[2][-1]) > 12.0 for other in kept) and len(kept) < 2:
                kept.append(entry)
        found.extend(kept)
    # What ends on the way itself again (a bend that was taken for a side road) is none.
    out = []
    for _, index, line, turn in found:
        gap = np.linalg.norm(points - line[-1], axis=1).min()
        if gap > 6.0:
            out.append((index, line, turn))
    return out


def _wrap(angle: Floats) -> Floats:
    return np.asarray((angle + np.pi) % (2 * np.pi) - np.pi)
