"""Association of this camera's and its neighbours' observations of the same target at the same time.

A neighbour's observation is paired with this camera's track interpolated at its time: cubic through four observations,
or linear through two. The std is increased by those of both clocks and by the curvature that the interpolation omits.
Memory is constant: the latest observations of the latest labels.
"""

from __future__ import annotations

import math
from collections import OrderedDict, deque

from hub.distributed.network.messages import SharedObservation

TIME_TOLERANCE_S = 1e-6
"""Times [s] that differ by less are equal."""
MAX_GAP_S = 0.2
"""Longest time [s] between own observations across which a target is interpolated."""
_OWN_CAPACITY = 16  # frames: half a second at 30 Hz
_PENDING_CAPACITY = 64  # frames of a neighbour: two seconds at 30 Hz
_MAX_LABELS = 64  # of one node

PairedRow = tuple[float, float, float, float, float, float, float, float, float, float]


class Associator:
    """Own observations by label, and neighbours' observations waiting for them.

    gap: longest time [s] between own observations across which a target is interpolated; 0 = equal times only.
    """

    def __init__(self, gap: float = MAX_GAP_S) -> None:
        self.gap = gap
        self._own: OrderedDict[int, deque[SharedObservation]] = OrderedDict()
        self._pending: OrderedDict[int, deque[SharedObservation]] = OrderedDict()

    def add_own(self, seen: SharedObservation) -> list[tuple[int, PairedRow]]:
        """Add an observation of this camera; returns the pairs it completes (neighbour, row)."""
        track = self._own.get(seen.label)
        if track is None:
            track = self._own[seen.label] = deque(maxlen=_OWN_CAPACITY)
            if len(self._own) > _MAX_LABELS:
                self._own.popitem(last=False)
        if track and seen.time <= track[-1].time:
            return []  # late: its counterparts have been discarded
        track.append(seen)
        pending = self._pending.get(seen.label)
        if pending is None:
            return []
        out, waiting = [], list[SharedObservation]()
        for other in pending:
            pair, final = _associate(track, other, self.gap)
            if pair is not None:
                out.append((other.camera, pair))
            elif not final:
                waiting.append(other)
        if waiting:
            self._pending[seen.label] = deque(waiting, maxlen=_PENDING_CAPACITY)
        else:
            del self._pending[seen.label]
        return out

    def add_neighbour(self, seen: SharedObservation) -> PairedRow | None:
        """Add a neighbour's observation; returns the pair if this camera observed the target at that time."""
        track = self._own.get(seen.label)
        if track is not None:
            pair, final = _associate(track, seen, self.gap)
            if pair is not None or final:
                return pair
        pending = self._pending.get(seen.label)
        if pending is None:
            pending = self._pending[seen.label] = deque(maxlen=_PENDING_CAPACITY)
            if len(self._pending) > _MAX_LABELS:
                self._pending.popitem(last=False)
        pending.append(seen)
        return None


def _associate(track: deque[SharedObservation], other: SharedObservation, gap: float) -> tuple[PairedRow | None, bool]:
    """The pair with the own track at the other's time (None without one), and whether that result is final."""
    last = track[-1]
    time = other.time
    if abs(last.time - time) < TIME_TOLERANCE_S and last.time_std == 0.0 and other.time_std == 0.0:
        return _row(last.x, last.y, last.std, last.size, last.size_std, other), True
    if time > last.time:
        return None, False
    after = next(i for i, own in enumerate(track) if own.time >= time - TIME_TOLERANCE_S)
    hit = track[after]
    if abs(hit.time - time) < TIME_TOLERANCE_S and hit.time_std == 0.0 and other.time_std == 0.0:
        return _row(hit.x, hit.y, hit.std, hit.size, hit.size_std, other), True
    if gap <= 0.0 or after == 0 or track[after].time - track[after - 1].time > gap:
        return None, True
    if after + 1 >= len(track) and time > track[after - 1].time + TIME_TOLERANCE_S:
        # The next observation would allow cubic interpolation; wait for it.
        return None, False
    return _interpolated(track, after, other, gap), True


def _interpolated(track: deque[SharedObservation], after: int, other: SharedObservation, gap: float) -> PairedRow:
    a, b = track[after - 1], track[after]
    time = other.time
    support = [a, b]
    if after >= 2 and a.time - track[after - 2].time <= gap:
        support.insert(0, track[after - 2])
    if after + 1 < len(track) and track[after + 1].time - b.time <= gap:
        support.append(track[after + 1])
    weights = []
    for p in support:
        weight = 1.0
        for q in support:
            if q is not p:
                weight *= (time - q.time) / (p.time - q.time)
        weights.append(weight)
    x = sum(w * p.x for w, p in zip(weights, support, strict=True))
    y = sum(w * p.y for w, p in zip(weights, support, strict=True))
    noise = sum((w * p.std) ** 2 for w, p in zip(weights, support, strict=True))
    span = b.time - a.time
    speed2 = ((b.x - a.x) ** 2 + (b.y - a.y) ** 2) / (span * span)
    # Interpolation error: a tenth of the difference between cubic and line; for a line, a fixed share of the motion.
    share = (time - a.time) / span
    line_x, line_y = a.x + share * (b.x - a.x), a.y + share * (b.y - a.y)
    interpolation_std = (
        0.1 * math.hypot(x - line_x, y - line_y) if len(support) == 4 else 0.05 * math.sqrt(speed2) * span
    )
    time_variance = other.time_std**2 + b.time_std**2
    std = math.sqrt(noise + 0.5 * speed2 * time_variance + interpolation_std * interpolation_std)
    sized = all(p.size > 0 for p in (a, b))
    size = math.exp((1 - share) * math.log(a.size) + share * math.log(b.size)) if sized else 0.0
    return _row(x, y, std, size, max(a.size_std, b.size_std), other)


def _row(x: float, y: float, std: float, size: float, size_std: float, other: SharedObservation) -> PairedRow:
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
