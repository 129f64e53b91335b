"""Short tracks of everything that looks like the target: how it moves tells the target from a look-alike."""

from __future__ import annotations

from collections import deque
from collections.abc import Sequence
from dataclasses import dataclass, field

import numpy as np

from edge.uav.target.appearance import Candidate
from protocols.geometry.types import Floats

_FASTEST = 45.0  # of anything followed [units/s]
_SLACK = 0.6  # between where one is expected and found [units]
_PATIENCE = 2  # frames that one may be missing
_MEMORY = 10
_SURE = 5.0  # speed over its std from which the direction is known
_NOISE = 0.2  # of a place [units]


@dataclass(slots=True, eq=False)
class Tracklet:
    """One look-alike, or the target. times, places: its last sightings; score: their mean; angle: of the last."""

    times: deque[float] = field(default_factory=lambda: deque(maxlen=_MEMORY))
    places: deque[Floats] = field(default_factory=lambda: deque(maxlen=_MEMORY))
    score: float = 0.0
    angle: float = 0.0
    missing: int = 0
    odds_limit: float | None = None
    """That it is the target, by all that is known when it is first seen: a look-alike is as alike in each frame."""

    @property
    def age(self) -> int:
        """Sightings held."""
        return len(self.times)

    def velocity(self) -> tuple[Floats, float] | None:
        """(2,) ground units a second and the std of one coordinate; None with fewer than three sightings."""
        if len(self.times) < 3:
            return None
        t = np.array(self.times) - self.times[-1]
        t = t - t.mean()
        spread = float(t @ t)
        if spread < 1e-6:
            return None
        slope = t @ np.array(self.places) / spread
        return np.asarray(slope), float(np.hypot(1.0, _NOISE / np.sqrt(spread)))

    def expected(self, time: float) -> tuple[Floats, float]:
        """Where it should be (2,), and how far from there it may be."""
        ahead = time - self.times[-1]
        motion = self.velocity()
        if motion is None:
            return self.places[-1], _SLACK + _FASTEST * ahead
        return self.places[-1] + motion[0] * ahead, _SLACK + 2.0 * motion[1] * ahead

    def add(self, time: float, candidate: Candidate) -> None:
        """One more sighting."""
        self.times.append(time)
        self.places.append(candidate.ground)
        weight = 1.0 / min(len(self.times), 5)
        self.score += weight * (candidate.score - self.score)
        self.angle = candidate.angle
        self.missing = 0

    def course(self) -> float | None:
        """Which way it moves [rad]; None while that is not known well."""
        motion = self.velocity()
        if motion is None or float(np.hypot(*motion[0])) < _SURE * motion[1]:
            return None
        return float(np.arctan2(motion[0][1], motion[0][0]))


class Tracklets:
    """All of them at once."""

    def __init__(self) -> None:
        self._live: list[Tracklet] = []

    def clear(self) -> None:
        """Forget all: the ground frame is another one, or nothing was looked at for long."""
        self._live = []

    def near(self, time: float, place: Floats, within: float) -> Tracklet | None:
        """The one that should be at a place (2,) now, or no farther from it than ``within``."""
        away = [float(np.hypot(*(tracklet.expected(time)[0] - place))) for tracklet in self._live]
        k = int(np.argmin(away)) if away else -1
        return self._live[k] if away and away[k] < within else None

    def update(self, time: float, candidates: Sequence[Candidate]) -> list[Tracklet]:
        """The tracklet of each candidate, in their order; nearest pairs first."""
        pairs = []
        for k, tracklet in enumerate(self._live):
            expected, reach = tracklet.expected(time)
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
                tracklet.missing += 1
        kept = [tracklet for tracklet in self._live if tracklet.missing <= _PATIENCE]
        self._live = kept + [tracklet for tracklet in out if tracklet not in kept]
        return out
