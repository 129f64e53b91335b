"""Targets that turn at once: a ball that bounces, a wand that is waved, a drone that is hit.

The filter's white acceleration bends a path slowly. Besides it the velocity may have changed once, at some moment since
the target was last seen: a second hypothesis with its own covariance, weighed against the first by what a frame shows.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from hub.tracking.filter import kalman
from hub.tracking.filter.kalman import POSITION, VELOCITY
from hub.tracking.filter.target_models import BODIES
from hub.tracking.filter.target_states import Targets
from protocols.core.clocks import NANOSECONDS
from protocols.geometry.types import Bools, Floats

_LONGEST_S = 0.3
"""What was not seen for longer could be anywhere: two cameras must find it again, so that no other is taken for it."""
_JUMP = np.array([body.jump_m_s for body in BODIES])
_RATE = np.array([body.jumps_per_s for body in BODIES])


@dataclass(frozen=True, slots=True, eq=False)
class Turned:
    """The second hypothesis of n targets. covariance: (n, 7, 7); the mean is that of the first. odds: (n,)."""

    covariance: Floats
    odds: Floats


def jumpy(targets: Targets) -> Bools:
    """Which targets (n,) are of a kind whose velocity may change at once."""
    return np.asarray(_JUMP[targets.kind] > 0.0)


def jumped(targets: Targets, time_ns: int, metre: float) -> Turned:
    """What holds if the velocity has changed once since a target was seen, and how likely that is.

    targets: as predicted for ``time_ns``. metre: world units in a metre. The moment of the change is uniform in the
    time unseen t, so that the place has variance v t² / 3 and covariance v t / 2 with the velocity, v that of the jump.
    """
    unseen = np.maximum((time_ns - targets.seen_ns) / NANOSECONDS, 0.0)
    jump = (_JUMP[targets.kind] * metre) ** 2
    covariance = targets.covariance.copy()
    for axis in range(3):
        here, there = POSITION.start + axis, VELOCITY.start + axis
        covariance[:, here, here] += jump * unseen**2 / 3.0
        covariance[:, here, there] += jump * unseen / 2.0
        covariance[:, there, here] += jump * unseen / 2.0
        covariance[:, there, there] += jump
    odds = np.expm1(_RATE[targets.kind] * np.minimum(unseen, _LONGEST_S))
    return Turned(covariance, np.where(unseen <= _LONGEST_S, odds, 0.0))


def weighed(
    mean: Floats,
    covariance: Floats,
    loose: Floats,
    odds: Floats,
    innovation: Floats,
    slope: Floats,
    noise: Floats,
    used: Bools,
) -> tuple[Floats, Floats]:
    """States after one measurement each, both hypotheses weighed by how well they foretold it.

    mean, covariance: of the first; loose, odds: of the second, (n, 7, 7) and (n,). The rest as in `kalman.update`. The
    two become one Gaussian again: Bar-Shalom, Li, Kirubarajan (2001), section 11.6.4, the first-order pseudo-Bayesian.
    """
    measurement = innovation, slope, noise, used
    better = kalman.misfit(covariance, *measurement) - kalman.misfit(loose, *measurement)
    share = odds / (odds + np.exp(np.clip(-0.5 * better, -700.0, 700.0)))
    return kalman.merged(kalman.update(mean, covariance, *measurement), kalman.update(mean, loose, *measurement), share)
