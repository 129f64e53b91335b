"""Where the target was seen lately, and the motion that fits it: what the speed is pulled to."""

from __future__ import annotations

from collections import deque
from dataclasses import dataclass

import numpy as np

from edge.uav.ground.image_plane import transfer
from protocols.geometry.types import Floats

_SPAN_S = 0.9
_MOST = 40
_RECENT_S = 0.3
_BETTER = 0.4  # of a sighting's std is what differs from frame to frame; the rest is common to all
_ACCELERATION_STD = 3.5  # of a car, along each axis [units/s²]
_AGILITY = 0.3  # the same over the speed, where that is more [1/s]
_SPEED_STD = 15.0
_FRESH_S = 0.2  # age of the fit that judges
_FIRM = 8  # sightings from which a fit is good enough to judge the next one by


@dataclass(frozen=True, slots=True, eq=False)
class MotionFit:
    """The target's motion at the last sighting.

    position, velocity, acceleration: (2,) ground units and seconds. velocity_std, acceleration_std: of one
    coordinate. residual: of the sightings, one coordinate. samples: how many.
    """

    time: float
    position: Floats
    velocity: Floats
    acceleration: Floats
    velocity_std: float
    acceleration_std: float
    residual: float
    samples: int

    @property
    def speed(self) -> float:
        return float(np.hypot(*self.velocity))

    @property
    def heading(self) -> float:
        return float(np.arctan2(self.velocity[1], self.velocity[0]))

    @property
    def along(self) -> float:
        """Acceleration along the heading."""
        return float(self.acceleration @ self.velocity) / max(self.speed, 1e-6)

    @property
    def turn_rate(self) -> float:
        """d heading / dt [rad/s]; 0 for what hardly moves."""
        if self.speed < 1.0:
            return 0.0
        v, a = self.velocity, self.acceleration
        return float(v[0] * a[1] - v[1] * a[0]) / self.speed**2


class Sightings:
    """Measured places of the target on the ground, the last second of them."""

    def __init__(self) -> None:
        self._times: deque[float] = deque(maxlen=_MOST)
        self._places: deque[Floats] = deque(maxlen=_MOST)
        self._stds: deque[float] = deque(maxlen=_MOST)
        self._prior: tuple[Floats, float] | None = None
        self._since: float | None = None  # when the prior was true
        self._fits: deque[MotionFit] = deque()

    def __len__(self) -> int:
        return len(self._times)

    def add(self, time: float, place: Floats, std: float) -> None:
        """One sighting: (2,) ground, std of one coordinate."""
        if not self._times:
            self._since = time
        self._times.append(time)
        self._places.append(np.asarray(place, dtype=np.float64))
        self._stds.append(std)

    def begin_anew(self, velocity: Floats, std: float) -> None:
        """After a gap: only what is seen from now on counts, with a prior for the velocity (2,) by then."""
        self._times.clear()
        self._places.clear()
        self._stds.clear()
        self._fits.clear()
        self._prior = (np.asarray(velocity, dtype=np.float64), std)

    def moved(self, new_from_old: Floats) -> None:
        """Into another ground frame."""
        if self._places:
            places = transfer(new_from_old, np.array(self._places))
            self._places = deque(list(places), maxlen=_MOST)
        self._prior = None
        self._fits.clear()

    def travelled(self) -> float:
        """Distance between the first and the last sighting held."""
        return float(np.linalg.norm(self._places[-1] - self._places[0])) if len(self._places) > 1 else 0.0

    def places(self) -> Floats:
        """(n, 2), the oldest first."""
        return np.array(self._places).reshape(-1, 2)

    def fit(self) -> MotionFit | None:
        """Least squares of place, velocity and a modest acceleration over the last second; None with < 3.

        What jumps off the fit of a moment ago, faster than a car can brake or steer, counts little: that is the part of
        the target which something leaves in sight.
        """
        if len(self._times) < 3:
            return None
        times = np.array(self._times)
        recent = times >= times[-1] - _SPAN_S
        t = times[recent] - times[-1]
        if len(t) < 3 or t[-1] - t[0] < 0.05:
            return None
        places = np.array(self._places)[recent]
        stds = np.array(self._stds)[recent]
        design = np.column_stack([np.ones_like(t), t, 0.5 * t * t])
        # A film in quick motion, or units that are not metres: what is fast also changes its speed fast.
        pace = float(np.hypot(*(places[-1] - places[0]))) / float(t[-1] - t[0])
        agility = max(_ACCELERATION_STD, _AGILITY * pace)
        mean, spread = np.zeros(2), _SPEED_STD
        if self._prior is not None and self._since is not None:
            # It was true when the target was found again: since then the driver has braked and steered.
            mean, spread = self._prior[0], float(np.hypot(self._prior[1], agility * (times[-1] - self._since)))
            if spread > _SPEED_STD:
                mean, spread = np.zeros(2), _SPEED_STD
        information = np.diag([1e-8, 1.0 / spread**2, 1.0 / agility**2])
        right0 = np.zeros((3, 2))
        right0[1] = mean / spread**2
        # The newest count most: drivers brake and steer within a second.
        stds = np.maximum(stds * _BETTER, 1e-3) * np.exp(-0.5 * t / _RECENT_S)
        weight = 1.0 / np.square(stds)
        while self._fits and self._fits[0].time < times[-1] - _FRESH_S:
            self._fits.popleft()
        if self._fits and self._fits[0].samples >= _FIRM:
            before = self._fits[0]
            ahead = (times[recent] - before.time)[:, None]
            expected = before.position + ahead * (before.velocity + 0.5 * ahead * before.acceleration)
            error = np.linalg.norm(expected - places, axis=1)
            weight = _robust(stds, error)
        for _ in range(3):
            normal = (design * weight[:, None]).T @ design + information
            solution = np.linalg.solve(normal, (design * weight[:, None]).T @ places + right0)
            error = np.linalg.norm(design @ solution - places, axis=1)
            weight = _robust(stds, error)
        residual = float(np.sqrt(0.5 * np.mean(np.square(error))))
        inflate = max(1.0, float(np.sqrt(0.5 * np.mean(np.square(error / stds)))))
        covariance = np.linalg.inv(normal) * inflate**2
        found = MotionFit(
            float(times[-1]),
            solution[0],
            solution[1],
            solution[2],
            float(np.sqrt(covariance[1, 1])),
            float(np.sqrt(covariance[2, 2])),
            residual,
            len(t),
        )
        self._fits.append(found)
        return found


def _robust(stds: Floats, error: Floats) -> Floats:
    """Weights (n,) of sightings by their stds and their distance from a motion (n,), both ground units."""
    return np.asarray(1.0 / np.square(stds) / (1.0 + np.square(error / (3.0 * stds))))
