"""How the target's driver drives: the speed kept on straights and the acceleration accepted across in bends.

Both are learnt while it is seen, and say how fast it goes on while it is not: slower into a bend, faster out of it.
"""

from __future__ import annotations

from collections import deque
from dataclasses import dataclass

import numpy as np

from edge.uav.target.motion_history import MotionFit
from protocols.geometry.types import Floats

_EVERY_S = 0.1
_MEMORY_S = 10.0
_STRAIGHT = 1.0  # acceleration across up to which a road counts as straight [units/s²]
_BENDING = 1.6  # and from which it tells how fast this driver takes a bend
_USUAL_SIDEWAYS, _SIDEWAYS_SPREAD = 3.4, 0.3  # median of what drivers accept [units/s²], std of its logarithm
_KNOWN_SPREAD = 0.15  # the same of a driver who was seen in a bend
_NOW = 0.5  # share of the speed now, of its mean before the rest
_SPEED_SPREAD = 0.04  # std of the speed kept, over it
_FASTER_AFTER = 0.12  # of who was only seen in a bend: how much faster the straight is driven, mean and std


@dataclass(frozen=True, slots=True, eq=False)
class Habits:
    """Of n possible drivers. cruise: (n,) speed on a straight [units/s]. sideways: (n,) acceleration [units/s²]."""

    cruise: Floats
    sideways: Floats


class Driving:
    """What was seen of the driver: speed and acceleration across, some seconds of it."""

    def __init__(self) -> None:
        self._seen: deque[tuple[float, float, float]] = deque()

    def saw(self, fit: MotionFit) -> None:
        """Take one good fit."""
        if self._seen and fit.time < self._seen[-1][0] + _EVERY_S:
            return
        self._seen.append((fit.time, fit.speed, abs(fit.turn_rate) * fit.speed))
        while self._seen[0][0] < fit.time - _MEMORY_S:
            self._seen.popleft()

    def rescaled(self, factor: float) -> None:
        """Ground units became smaller by ``factor``."""
        self._seen = deque((time, factor * speed, factor * across) for time, speed, across in self._seen)

    def habits(self, fit: MotionFit, speeds: Floats, rng: np.random.Generator) -> Habits:
        """Drivers to go with particles of speeds (n,) that set out with a fit."""
        count = len(speeds)
        across_now = abs(fit.turn_rate) * fit.speed
        seen = np.array(self._seen).reshape(-1, 3)
        straight = seen[seen[:, 2] < _STRAIGHT, 1]
        spread = fit.speed * _SPEED_SPREAD * rng.standard_normal(count)
        if across_now < _BENDING:
            usual = float(straight.mean()) if len(straight) else fit.speed
            # Much slower or faster than before is meant: it brakes or gets going.
            weight = _NOW if abs(usual - fit.speed) < 0.15 * fit.speed else 1.0
            cruise = weight * speeds + (1.0 - weight) * usual + spread
        elif len(straight):
            cruise = np.maximum(float(straight.mean()) + spread, speeds)
        else:
            cruise = speeds * (1.0 + np.abs(_FASTER_AFTER * rng.standard_normal(count)))
        most = float(np.quantile(seen[:, 2], 0.9)) if len(seen) >= 5 else 0.0
        logarithm = np.log(_USUAL_SIDEWAYS) + _SIDEWAYS_SPREAD * rng.standard_normal(count)
        if most > _BENDING:
            known = np.log(most) + _KNOWN_SPREAD * rng.standard_normal(count)
            logarithm = np.maximum(known, np.where(rng.random(count) < 0.5, known, logarithm))
        return Habits(np.maximum(cruise, 0.0), np.exp(logarithm))
