"""Manoeuvre model: an abrupt change of velocity as a second hypothesis beside the white-acceleration model.

Examples are a bouncing ball, a waved wand, a drone that is hit. The manoeuvre hypothesis is that the velocity changed
once, at an unknown time since the target was last observed. It has its own covariance, and each frame weighs the two
hypotheses by their likelihoods.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from hub.tracking.filter import kalman
from hub.tracking.filter.kalman import POSITION, VELOCITY
from hub.tracking.filter.target_models import TARGET_MODELS
from hub.tracking.filter.target_states import Targets
from protocols.core.clocks import NANOSECONDS
from protocols.geometry.types import Bools, Floats

_MAX_UNSEEN_S = 0.3
"""After a longer gap the target could be anywhere: track initiation must find it again, to avoid wrong associations."""
_MANOEUVRE_STD = np.array([model.manoeuvre_std_m_s for model in TARGET_MODELS])
_MANOEUVRE_RATE = np.array([model.manoeuvres_per_s for model in TARGET_MODELS])


@dataclass(frozen=True, slots=True, eq=False)
class ManoeuvreHypothesis:
    """The manoeuvre hypothesis of n targets. covariance: (n, 7, 7); the mean is unchanged. prior_odds: (n,)."""

    covariance: Floats
    prior_odds: Floats


def can_manoeuvre(targets: Targets) -> Bools:
    """Which targets (n,) are of a kind whose velocity may change abruptly."""
    return np.asarray(_MANOEUVRE_STD[targets.kind] > 0.0)


def manoeuvre_hypothesis(targets: Targets, time_ns: int, units_per_m: float) -> ManoeuvreHypothesis:
    """The covariances under one velocity change since each target was last observed, and the prior odds of a change.

    targets: predicted to ``time_ns``. units_per_m: world units per metre. The time of the change is uniform over the
    unobserved time t, so the position variance grows by v t² / 3 and its covariance with the velocity by v t / 2, where
    v is the variance of the velocity change.
    """
    unseen = np.maximum((time_ns - targets.seen_ns) / NANOSECONDS, 0.0)
    velocity_variance = (_MANOEUVRE_STD[targets.kind] * units_per_m) ** 2
    covariance = targets.covariance.copy()
    for axis in range(3):
        i, j = POSITION.start + axis, VELOCITY.start + axis
        covariance[:, i, i] += velocity_variance * unseen**2 / 3.0
        covariance[:, i, j] += velocity_variance * unseen / 2.0
        covariance[:, j, i] += velocity_variance * unseen / 2.0
        covariance[:, j, j] += velocity_variance
    prior_odds = np.expm1(_MANOEUVRE_RATE[targets.kind] * np.minimum(unseen, _MAX_UNSEEN_S))
    return ManoeuvreHypothesis(covariance, np.where(unseen <= _MAX_UNSEEN_S, prior_odds, 0.0))


def gpb1_update(
    mean: Floats,
    covariance: Floats,
    manoeuvre_covariance: Floats,
    prior_odds: Floats,
    innovation: Floats,
    jacobian: Floats,
    noise: Floats,
    used: Bools,
) -> tuple[Floats, Floats]:
    """Update with one measurement each under both hypotheses, and merge the results by posterior weight.

    mean, covariance: of the first hypothesis. manoeuvre_covariance (n, 7, 7) and prior_odds (n,): of the second. The
    rest as in `kalman.update`. The mixture is merged into one Gaussian: first-order generalised pseudo-Bayesian (GPB1)
    estimator, Bar-Shalom, Li, Kirubarajan (2001), section 11.6.4.
    """
    measurement = innovation, jacobian, noise, used
    log_ratio = kalman.minus_two_log_likelihood(covariance, *measurement) - kalman.minus_two_log_likelihood(
        manoeuvre_covariance, *measurement
    )
    weight = prior_odds / (prior_odds + np.exp(np.clip(-0.5 * log_ratio, -700.0, 700.0)))
    return kalman.moment_match(
        kalman.update(mean, covariance, *measurement), kalman.update(mean, manoeuvre_covariance, *measurement), weight
    )
