"""Driver model: cruise speed on straight road and accepted lateral acceleration in bends.

Both are estimated while the target is visible and determine its speed while it is not: slower into a bend, faster out
of it.
"""

from __future__ import annotations

from collections import deque
from dataclasses import dataclass

import numpy as np

from edge.uav.target.motion_history import MotionFit
from protocols.geometry.types import Floats

_SAMPLE_SPACING_S = 0.1  # motion fits of windows that overlap by more say the same
_WINDOW_S = 10.0  # a bend and the straight before it: longer ones keep speeds that traffic has ended
_MAX_STRAIGHT_LATERAL = 1.0  # lateral acceleration up to which the road counts as straight [units/s²]
_MIN_CURVE_LATERAL = 1.6  # and from which it is informative about this driver's limit in bends
LATERAL_MEDIAN, _LATERAL_LOG_STD = 3.4, 0.3  # prior of the lateral limit: median [units/s²], std of its logarithm
_OBSERVED_LOG_STD = 0.15  # the same for a driver observed in a bend
_CURRENT_SPEED_WEIGHT = 0.5  # of the current speed; the mean speed on straights has the rest
_RELATIVE_SPEED_STD = 0.04  # std of the cruise speed, over the speed
_STRAIGHT_SPEED_GAIN = 0.12  # relative increase of speed after a bend, of a driver only observed in it


@dataclass(frozen=True, slots=True, eq=False)
class DriverParameters:
    """Samples of n drivers. cruise_speed: (n,) on straights [units/s]. lateral_limit: (n,) acceleration [units/s²]."""

    cruise_speed: Floats
    lateral_limit: Floats


class DriverModel:
    """Observed speeds and lateral accelerations of the driver during some seconds."""

    def __init__(self) -> None:
        self._samples: deque[tuple[float, float, float]] = deque()

    def update(self, fit: MotionFit) -> None:
        """Add one well-determined motion fit."""
        if self._samples and fit.time < self._samples[-1][0] + _SAMPLE_SPACING_S:
            return
        self._samples.append((fit.time, fit.speed, abs(fit.turn_rate) * fit.speed))
        while self._samples[0][0] < fit.time - _WINDOW_S:
            self._samples.popleft()

    def rescale(self, factor: float) -> None:
        """Ground units became smaller by ``factor``."""
        self._samples = deque((time, factor * speed, factor * lateral) for time, speed, lateral in self._samples)

    def sample(self, fit: MotionFit, speeds: Floats, rng: np.random.Generator) -> DriverParameters:
        """Sample driver parameters for particles of speeds (n,) initialised from a fit."""
        count = len(speeds)
        lateral = abs(fit.turn_rate) * fit.speed
        samples = np.array(self._samples).reshape(-1, 3)
        straight = samples[samples[:, 2] < _MAX_STRAIGHT_LATERAL, 1]
        speed_error = fit.speed * _RELATIVE_SPEED_STD * rng.standard_normal(count)
        if lateral < _MIN_CURVE_LATERAL:
            typical = float(straight.mean()) if len(straight) else fit.speed
            # A large change of speed is intended: the driver brakes or accelerates.
            weight = _CURRENT_SPEED_WEIGHT if abs(typical - fit.speed) < 0.15 * fit.speed else 1.0
            cruise_speed = weight * speeds + (1.0 - weight) * typical + speed_error
        elif len(straight):
            cruise_speed = np.maximum(float(straight.mean()) + speed_error, speeds)
        else:
            cruise_speed = speeds * (1.0 + np.abs(_STRAIGHT_SPEED_GAIN * rng.standard_normal(count)))
        observed_limit = float(np.quantile(samples[:, 2], 0.9)) if len(samples) >= 5 else 0.0
        log_limit = np.log(LATERAL_MEDIAN) + _LATERAL_LOG_STD * rng.standard_normal(count)
        if observed_limit > _MIN_CURVE_LATERAL:
            observed = np.log(observed_limit) + _OBSERVED_LOG_STD * rng.standard_normal(count)
            log_limit = np.maximum(observed, np.where(rng.random(count) < 0.5, observed, log_limit))
        return DriverParameters(np.maximum(cruise_speed, 0.0), np.exp(log_limit))
