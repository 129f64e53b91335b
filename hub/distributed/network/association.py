"""Brings together what this camera and its neighbours saw of one target at one time.

A neighbour's observation at a time of its own is met by this camera's track, interpolated there: cubic through four
observations, or a line through two; the uncertainty grows by that of both clocks and by the bend that a line leaves
out. Constant memory: the latest of a label, the latest labels.
"""

from __future__ import annotations

import math
from collections import OrderedDict, deque

from hub.distributed.network.messages import SharedObservation

SAME_TIME = 1e-6
"""Times [s] that differ by less are one."""
GAP = 0.2
"""Longest time [s] between own observations across which a target is interpolated."""
_OWN = 16
_WAITING = 64
_LABELS = 64

Row = tuple[float, float, float, float, float, float, float, float, float, float]


class Pairing:
    """Own observations by label, and neighbours' that wait for them.

    gap: longest time [s] between own observations across which a target is interpolated; 0 = only same times meet.
    """

    def __init__(self, gap: float = GAP) -> None:
        self.gap = gap
        self._own: OrderedDict[int, deque[SharedObservation]] = OrderedDict()
        self._waiting: OrderedDict[int, deque[SharedObservation]] = OrderedDict()

    def own(self, seen: SharedObservation) -> list[tuple[int, Row]]:
        """Takes an observation of this camera; returns the pairs it completes (neighbour, row)."""
        track = self._own.get(seen.label)
        if track is None:
            track = self._own[seen.label] = deque(maxlen=_OWN)
            if len(self._own) > _LABELS:
                self._own.popitem(last=False)
        if track and seen.time <= track[-1].time:
            return []  # late: what it could have met has gone
        track.append(seen)
        waiting = self._waiting.get(seen.label)
        if waiting is None:
            return []
        out, left = [], deque[SharedObservation](maxlen=_WAITING)
        for other in waiting:
            met, final = _meet(track, other, self.gap)
            if met is not None:
                out.append((other.camera, met))
            elif not final:
                left.append(other)
        if left:
            self._waiting[seen.label] = left
        else:
            del self._waiting[seen.label]
        return out

    def other(self, seen: SharedObservation) -> tuple[int, Row] | None:
        """Takes a neighbour's observation; returns the pair if this camera saw the target then."""
        track = self._own.get(seen.label)
        if track is not None:
            met, final = _meet(track, seen, self.gap)
            if met is not None:
                return seen.camera, met
            if final:
                return None
        waiting = self._waiting.get(seen.label)
        if waiting is None:
            waiting = self._waiting[seen.label] = deque(maxlen=_WAITING)
            if len(self._waiting) > _LABELS:
                self._waiting.popitem(last=False)
        waiting.append(seen)
        return None


def _meet(track: deque[SharedObservation], other: SharedObservation, gap: float) -> tuple[Row | None, bool]:
    """The pair with the own track at the other's time, and whether waiting longer is in vain."""
    last = track[-1]
    time = other.time
    if abs(last.time - time) < SAME_TIME and last.time_std == 0.0 and other.time_std == 0.0:
        return _row(last.x, last.y, last.std, last.size, last.size_std, other), True
    if time > last.time:
        return None, False
    after = next(i for i, own in enumerate(track) if own.time >= time - SAME_TIME)
    hit = track[after]
    if abs(hit.time - time) < SAME_TIME and hit.time_std == 0.0 and other.time_std == 0.0:
        return _row(hit.x, hit.y, hit.std, hit.size, hit.size_std, other), True
    if gap <= 0.0 or after == 0 or track[after].time - track[after - 1].time > gap:
        return None, True
    if after + 1 >= len(track) and time > track[after - 1].time + SAME_TIME:
        # The next observation would make it cubic; wait for it.
        return None, False
    return _interpolated(track, after, other, gap), True


def _interpolated(track: deque[SharedObservation], after: int, other: SharedObservation, gap: float) -> Row:
    a, b = track[after - 1], track[after]
    time = other.time
    near = [a, b]
    if after >= 2 and a.time - track[after - 2].time <= gap:
        near.insert(0, track[after - 2])
    if after + 1 < len(track) and track[after + 1].time - b.time <= gap:
        near.append(track[after + 1])
    weights = []
    for p in near:
        weight = 1.0
        for q in near:
            if q is not p:
                weight *= (time - q.time) / (p.time - q.time)
        weights.append(weight)
    x = sum(w * p.x for w, p in zip(weights, near, strict=True))
    y = sum(w * p.y for w, p in zip(weights, near, strict=True))
    noise = sum((w * p.std) ** 2 for w, p in zip(weights, near, strict=True))
    span = b.time - a.time
    speed2 = ((b.x - a.x) ** 2 + (b.y - a.y) ** 2) / (span * span)
    # What the cubic leaves out is taken for a tenth of what it added to the line; a line for all of a like bend.
    share = (time - a.time) / span
    line_x, line_y = a.x + share * (b.x - a.x), a.y + share * (b.y - a.y)
    left = 0.1 * math.hypot(x - line_x, y - line_y) if len(near) == 4 else 0.05 * math.sqrt(speed2) * span
    time_variance = other.time_std**2 + b.time_std**2
    std = math.sqrt(noise + 0.5 * speed2 * time_variance + left * left)
    sized = all(p.size > 0 for p in (a, b))
    size = math.exp((1 - share) * math.log(a.size) + share * math.log(b.size)) if sized else 0.0
    return _row(x, y, std, size, max(a.size_std, b.size_std), other)


def _row(x: float, y: float, std: float, size: float, size_std: float, other: SharedObservation) -> Row:
    mine = size > 0.0 and size_std > 0.0
    theirs = other.size > 0.0 and other.size_std > 0.0
    return (
        x,
        y,
        math.log(size) if mine else 0.0,
        other.x,
        other.y,
        math.log(other.size) if theirs else 0.0,
        1.0 / std,
        1.0 / size_std if mine else 0.0,
        1.0 / other.std,
        1.0 / other.size_std if theirs else 0.0,
    )
