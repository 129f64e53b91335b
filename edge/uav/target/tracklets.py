"""Tracklets of all candidates: the velocity distinguishes the target from similar-looking cars."""

from __future__ import annotations

from collections import deque
from collections.abc import Sequence
from dataclasses import dataclass, field

import numpy as np

from edge.uav.target.appearance import Candidate
from protocols.geometry.types import Floats

_MAX_SPEED = 45.0  # of any candidate [units/s]
_GATE = 0.6  # between predicted and detected position [units]
_MAX_MISSED = 2  # frames without detection before a tracklet is dropped
_WINDOW = 10  # detections kept
_MIN_SPEED_RATIO = 5.0  # speed over its std from which the course is used
_POSITION_STD = 0.2  # of a detection [units]


@dataclass(slots=True, eq=False)
class Tracklet:
    """One candidate tracked over several frames. times, positions: its last detections.

    score: their mean; angle: of the last; missed: frames since.
    """

    times: deque[float] = field(default_factory=lambda: deque(maxlen=_WINDOW))
    positions: deque[Floats] = field(default_factory=lambda: deque(maxlen=_WINDOW))
    score: float = 0.0
    angle: float = 0.0
    missed: int = 0
    odds_limit: float | None = None
    """Upper bound on the odds that it is the target: the scores of a similar car are correlated over frames."""

    @property
    def age(self) -> int:
        """Number of detections held."""
        return len(self.times)

    def velocity(self) -> tuple[Floats, float] | None:
        """(2,) ground units a second and the std of one coordinate; None with fewer than three detections."""
        if len(self.times) < 3:
            return None
        t = np.array(self.times) - self.times[-1]
        t = t - t.mean()
        spread = float(t @ t)
        if spread < 1e-6:
            return None
        slope = t @ np.array(self.positions) / spread
        return np.asarray(slope), float(np.hypot(1.0, _POSITION_STD / np.sqrt(spread)))

    def predict(self, time: float) -> tuple[Floats, float]:
        """Predicted position (2,) and gate radius."""
        interval = time - self.times[-1]
        motion = self.velocity()
        if motion is None:
            return self.positions[-1], _GATE + _MAX_SPEED * interval
        return self.positions[-1] + motion[0] * interval, _GATE + 2.0 * motion[1] * interval

    def add(self, time: float, candidate: Candidate) -> None:
        """Add a detection."""
        self.times.append(time)
        self.positions.append(candidate.ground)
        weight = 1.0 / min(len(self.times), 5)
        self.score += weight * (candidate.score - self.score)
        self.angle = candidate.angle
        self.missed = 0

    def course(self) -> float | None:
        """Direction of motion [rad]; None while not well determined."""
        motion = self.velocity()
        if motion is None or float(np.hypot(*motion[0])) < _MIN_SPEED_RATIO * motion[1]:
            return None
        return float(np.arctan2(motion[0][1], motion[0][0]))


class Tracklets:
    """All live tracklets, with greedy nearest-neighbour association."""

    def __init__(self) -> None:
        self._live: list[Tracklet] = []

    def reset(self) -> None:
        """Drop all: the ground frame has changed, or the search was interrupted for long."""
        self._live = []

    def nearest(self, time: float, position: Floats, max_distance: float) -> Tracklet | None:
        """The tracklet predicted nearest to a position (2,), within ``max_distance`` of it; None if there is none."""
        distances = [float(np.hypot(*(tracklet.predict(time)[0] - position))) for tracklet in self._live]
        k = int(np.argmin(distances)) if distances else -1
        return self._live[k] if distances and distances[k] < max_distance else None

    def update(self, time: float, candidates: Sequence[Candidate]) -> list[Tracklet]:
        """The tracklet of each candidate, in their order; nearest pairs are associated first."""
        pairs = []
        for k, tracklet in enumerate(self._live):
            expected, reach = tracklet.predict(time)
            for j, candidate in enumerate(candidates):
                distance = float(np.hypot(*(candidate.ground - expected)))
                if distance < reach:
                    pairs.append((distance, k, j))
        taken: dict[int, int] = {}
        used: set[int] = set()
        for _, k, j in sorted(pairs):
            if k not in used and j not in taken:
                taken[j] = k
                used.add(k)
        out = []
        for j, candidate in enumerate(candidates):
            tracklet = self._live[taken[j]] if j in taken else Tracklet()
            tracklet.add(time, candidate)
            out.append(tracklet)
        for k, tracklet in enumerate(self._live):
            if k not in used:
                tracklet.missed += 1
        kept = [tracklet for tracklet in self._live if tracklet.missed <= _MAX_MISSED]
        self._live = kept + [tracklet for tracklet in out if tracklet not in kept]
        return out
