"""Prediction of targets in time: white acceleration, white velocity for steps and sway, and the manoeuvre model.

A manoeuvre is an abrupt change of velocity, a second hypothesis beside the white-acceleration model.

Examples are a bouncing ball, a waved wand, a drone that is hit, somebody who stops, sets off or sits down. The
manoeuvre hypothesis is that the velocity, or a standing person's height, changed once, at an unknown time since the
target was last observed. It has its own covariance, and each frame weighs the two hypotheses by their likelihoods.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from hub.tracking.filter import kalman
from hub.tracking.filter.detection_model import CORRELATION_S
from hub.tracking.filter.floor import Floor
from hub.tracking.filter.kalman import LOG_SIZE, POSITION, VELOCITY
from hub.tracking.filter.target_models import TARGET_MODELS, UPRIGHT
from hub.tracking.filter.target_states import Targets
from hub.tracking.parameters import TrackerParameters
from protocols.geometry.types import Bools, Floats

_MAX_SPREAD_M = 0.7
"""Std of the position after a change: beyond, the target could be anywhere, and track initiation must find it again."""
_MAX_LOG_ODDS = 50.0  # of a manoeuvre: after a pause of hours the odds exceed any float; these are certain already
_STEP_S = 0.5  # of one step: 120 a minute
_POSTURE_STD = 0.2  # of the log of a person's height: who sits is a quarter lower than who stands
_STANDING_M_S = 0.25  # a slow turn's speed; nobody sits down or stands up while walking
_RUNNER_STD_M_S = 5.0  # of one component of the velocity of somebody who runs or cycles: a sprint is 10 m/s
_RUNNERS_PER_S = 0.5  # rate, as of a manoeuvre: one in twenty at 10 frames a second
_UNMEASURED = 0.5  # share of its prior variance above which a velocity is not known yet
_SPEED_STD = np.array([model.speed_std_m_s for model in TARGET_MODELS])
_MANOEUVRE_STD = np.array([model.manoeuvre_std_m_s for model in TARGET_MODELS])
_MANOEUVRE_RATE = np.array([model.manoeuvres_per_s for model in TARGET_MODELS])
_LOG_SIZE_PSD = 1e-4  # 1/s: the size may drift by 1 % in a second, 8 % in a minute
_WALKING_M_S, _STANDING_SHARE = 0.4, 0.05
"""Turning and swaying grow with speed: somebody who stands has this share of a walker's acceleration (variance)."""
_RUNNING_M_S, _SPRINT_M_S = 2.0, 7.0  # from walking becoming running (Hreljac 1993: 2.07 m/s) to sprints they grow on
_ACCELERATION_PSD, _VELOCITY_PSD = np.array([(model.acceleration_psd, model.velocity_psd) for model in TARGET_MODELS]).T


@dataclass(frozen=True, slots=True, eq=False)
class ManoeuvreHypothesis:
    """The manoeuvre hypothesis of n targets. covariance: (n, 7, 7); the mean is unchanged. prior_odds: (n,)."""

    covariance: Floats
    prior_odds: Floats


def can_manoeuvre(targets: Targets) -> Bools:
    """Which targets (n,) are of a kind whose velocity may change abruptly."""
    return np.asarray(_MANOEUVRE_STD[targets.kind] > 0.0)


def manoeuvre_hypothesis(
    targets: Targets, elapsed: Floats | float, units_per_m: float, up: Floats | None = None, posture: bool = False
) -> ManoeuvreHypothesis:
    """The covariances under one velocity change within a time, and the prior odds of a change.

    targets: predicted by ``elapsed`` (n,) [s], negative backwards in time. units_per_m: world units per metre. up: (3,)
    along which upright targets do not change their velocity. The time of the change is uniform over the time t, so the
    position variance grows by v t² / 3 and its covariance with the velocity by v t / 2, where v is the variance of the
    velocity change. An upright target may also have taken a step and stand again: a change that lasted for a part of a
    step's duration, or of t where that is shorter, uniform as well, adds v / 3 times its square. Of somebody whose
    velocity is not measured yet the hypothesis is also that it is a runner's, ever since.

    posture: whether an upright target that stands may also have another height since, with its feet where they were.
    That is as large for short t: sitting down takes a second, and at many frames a second no two of them show it. Where
    past and future are compared both heights are known well; a filter that goes forward alone keeps up without it.
    """
    time = np.broadcast_to(np.asarray(elapsed, dtype=np.float64), (len(targets),))
    std = _MANOEUVRE_STD[targets.kind] * units_of(targets, units_per_m)
    axes = np.broadcast_to(np.eye(3), (len(targets), 3, 3))
    if up is not None:
        axes = axes - UPRIGHT[targets.kind][:, None, None] * np.outer(up, up)
    change = (std**2)[:, None, None] * axes
    covariance = targets.covariance.copy()
    step = np.where(UPRIGHT[targets.kind], np.minimum(np.abs(time), _STEP_S), 0.0)
    covariance[:, POSITION, POSITION] += change * ((time**2 + step**2) / 3.0)[:, None, None]
    covariance[:, POSITION, VELOCITY] += change * (time / 2.0)[:, None, None]
    covariance[:, VELOCITY, POSITION] += change * (time / 2.0)[:, None, None]
    covariance[:, VELOCITY, VELOCITY] += change
    rate = _MANOEUVRE_RATE[targets.kind]
    usual = _SPEED_STD[targets.kind] * units_of(targets, units_per_m)
    variance = np.trace(targets.covariance[:, VELOCITY, VELOCITY], axis1=1, axis2=2) / 3.0
    new = UPRIGHT[targets.kind] & (variance > _UNMEASURED * usual**2)
    # Beyond a quarter of a second a runner could be anywhere.
    new &= _RUNNER_STD_M_S * np.abs(time) <= np.sqrt(3.0) * _MAX_SPREAD_M
    if new.any():
        fast = np.where(new, _RUNNER_STD_M_S * units_of(targets, units_per_m), 0.0)[:, None, None] ** 2 * axes
        covariance[:, POSITION, POSITION] += fast * (time**2)[:, None, None]
        covariance[:, POSITION, VELOCITY] += fast * time[:, None, None]
        covariance[:, VELOCITY, POSITION] += fast * time[:, None, None]
        covariance[:, VELOCITY, VELOCITY] += fast
        rate = rate + np.where(new, _RUNNERS_PER_S, 0.0)
    if posture and up is not None:
        lower = np.zeros_like(targets.mean)
        lower[:, POSITION], lower[:, LOG_SIZE] = 0.5 * np.exp(targets.mean[:, LOG_SIZE, None]) * up, 1.0
        speed = np.linalg.norm(targets.mean[:, VELOCITY], axis=1) / units_of(targets, units_per_m)
        lower *= (UPRIGHT[targets.kind] * _POSTURE_STD / (1.0 + (speed / _STANDING_M_S) ** 2))[:, None]
        covariance += lower[:, :, None] * lower[:, None, :]
    expected = np.minimum(rate * np.abs(time), _MAX_LOG_ODDS)
    return ManoeuvreHypothesis(covariance, np.expm1(expected))


def log_mixture(odds: Floats, smooth: Floats, changed: Floats) -> Floats:
    """Log likelihoods (n,) of both hypotheses together. odds: (n,) prior odds of a change. smooth, changed: (n,)."""
    with np.errstate(divide="ignore"):
        return np.asarray(np.logaddexp(smooth, changed + np.log(odds)) - np.log1p(odds))


def within_reach(targets: Targets, elapsed: Floats, hypothesis: ManoeuvreHypothesis) -> ManoeuvreHypothesis:
    """The same without targets that could be anywhere by now. elapsed: (n,) since the last detection [s]."""
    near = _MANOEUVRE_STD[targets.kind] * elapsed <= np.sqrt(3.0) * _MAX_SPREAD_M
    return replace(hypothesis, prior_odds=np.where(near, hypothesis.prior_odds, 0.0))


def units_of(targets: Targets, units_per_m: float) -> Floats:
    """World units per metre (n,), of upright targets by their own size: the world's scale may be unknown."""
    typical = np.array([model.size_m for model in TARGET_MODELS])[targets.kind]
    return np.where(UPRIGHT[targets.kind], np.exp(targets.mean[:, LOG_SIZE]) / typical, units_per_m)


def widened_by_evidence(
    predicted: Targets, hypothesis: ManoeuvreHypothesis, information: Floats, vector: Floats
) -> Floats:
    """The covariances (n, 7, 7) of the mixture of both hypotheses, given measurements.

    information: (n, 7, 7) of the measurements, and its vector (n, 7).
    """
    covariances = np.concatenate([predicted.covariance, hypothesis.covariance])
    twice = np.tile(predicted.mean, (2, 1)), covariances, np.tile(information, (2, 1, 1)), np.tile(vector, (2, 1))
    return _mixed(predicted.covariance, hypothesis, *log_evidence(*twice).reshape(2, -1))


def fused_predictions(
    past: Targets, future: Targets, elapsed: tuple[float, float], units_per_m: float, up: Floats | None
) -> tuple[Floats, Floats]:
    """The states (n, 7), (n, 7, 7) of targets from their past and their future, which may differ by a manoeuvre.

    past, future: predicted by ``elapsed`` forward and backward in time to the same moment.
    """
    fit, covariances, odds = continuation_hypotheses(past, future, elapsed, units_per_m, up)
    before, after = (
        _mixed(smooth, ManoeuvreHypothesis(changed, odds), *fit) for smooth, changed in zip(*covariances, strict=True)
    )
    return kalman.fused(past.mean, before, future.mean, after)


def continuation_hypotheses(
    past: Targets, future: Targets, elapsed: tuple[float, float], units_per_m: float, up: Floats | None
) -> tuple[Floats, tuple[tuple[Floats, Floats], tuple[Floats, Floats]], Floats]:
    """Whether futures continue pasts, without and with a manoeuvre: log likelihoods (2, n), the covariances (n, 7, 7)
    of past and future in both cases, and the prior odds (n,) of a manoeuvre. Arguments as in `fused_predictions`."""
    one = manoeuvre_hypothesis(past, elapsed[0], units_per_m, up, posture=True)
    two = manoeuvre_hypothesis(future, -elapsed[1], units_per_m, up, posture=True)
    covariances = (past.covariance, future.covariance), (one.covariance, two.covariance)
    fit = np.array([kalman.log_density(past.mean - future.mean, a + b) for a, b in covariances])
    return fit, covariances, one.prior_odds + two.prior_odds


def _mixed(covariance: Floats, hypothesis: ManoeuvreHypothesis, smooth: Floats, changed: Floats) -> Floats:
    """Moments (n, 7, 7) of the mixture, given the log likelihoods (n,) of both hypotheses."""
    weight = hypothesis.prior_odds / (hypothesis.prior_odds + np.exp(np.clip(smooth - changed, -700.0, 700.0)))
    return np.asarray(covariance + weight[:, None, None] * (hypothesis.covariance - covariance))


def log_evidence(mean: Floats, covariance: Floats, information: Floats, vector: Floats) -> Floats:
    """Log likelihood (n,) of measurements in information form, but for what does not depend on the prior."""
    return kalman.with_information(mean, covariance, information, vector)[2]


def gpb1_update(
    mean: Floats,
    covariance: Floats,
    manoeuvre_covariance: Floats,
    prior_odds: Floats,
    innovation: Floats,
    jacobian: Floats,
    noise: Floats,
    used: Bools,
) -> tuple[Floats, Floats, Floats]:
    """Update with one measurement each under both hypotheses, and merge the results by posterior weight.

    mean, covariance: of the first hypothesis. manoeuvre_covariance (n, 7, 7) and prior_odds (n,): of the second. The
    rest as in `kalman.update`. The mixture is merged into one Gaussian: first-order generalised pseudo-Bayesian
    (GPB1) estimator, Bar-Shalom, Li, Kirubarajan (2001), section 11.6.4. Also returns the normalised innovations
    squared (n,) under the first hypothesis.
    """
    n, covariances = len(mean), np.concatenate([covariance, manoeuvre_covariance])
    twice = (np.concatenate([one, one]) for one in (innovation, jacobian, noise, used))
    means, covariances, squared, log_determinant = kalman.update(np.concatenate([mean, mean]), covariances, *twice)
    fit = squared + log_determinant
    weight = prior_odds / (prior_odds + np.exp(np.clip(0.5 * (fit[n:] - fit[:n]), -700.0, 700.0)))
    merged = kalman.moment_match((means[:n], covariances[:n]), (means[n:], covariances[n:]), weight)
    return *merged, squared[:n]


def predict_targets(targets: Targets, elapsed: Floats | float, parameters: TrackerParameters) -> Targets:
    """The targets predicted by ``elapsed`` seconds, each (n,) or all."""
    if not len(targets) or not np.any(elapsed):
        return targets
    units_per_m = units_of(targets, parameters.scale.units_per_m)
    speed = np.linalg.norm(targets.mean[:, VELOCITY], axis=1) / units_per_m
    most = np.clip(speed / _RUNNING_M_S, 1.0, _SPRINT_M_S / _RUNNING_M_S) ** 2
    share = np.clip((speed / _WALKING_M_S) ** 2, _STANDING_SHARE, most)
    share = np.where(UPRIGHT[targets.kind], share, 1.0)
    acceleration_psd, velocity_psd = (
        psd[targets.kind] * units_per_m**2 * share for psd in (_ACCELERATION_PSD, _VELOCITY_PSD)
    )
    mean, covariance = kalman.predict(
        targets.mean, targets.covariance, elapsed, acceleration_psd, _LOG_SIZE_PSD, velocity_psd
    )
    existence = targets.existence * np.exp(-np.maximum(elapsed, 0.0) / parameters.lifetime_s)
    return replace(targets, mean=mean, covariance=covariance, existence=existence)


def on_floor(targets: Targets, floor: Floor | None, elapsed: Floats | float) -> Targets:
    """Upright targets with their feet on the floor, where it is known; ``elapsed`` (n,) or all, since the last time."""
    elapsed = np.broadcast_to(elapsed, (len(targets),))
    standing = np.flatnonzero(UPRIGHT[targets.kind] & (elapsed > 0.0))
    if floor is None or not floor.known or not len(standing):
        return targets
    mean, covariance = targets.mean.copy(), targets.covariance.copy()
    innovation, jacobian, variance = floor.constraint(mean[standing])
    # What is uneven under somebody's foot now is so a moment later: half a second is one observation.
    noise = variance * np.maximum(CORRELATION_S / elapsed[standing], 1.0)
    cross = (covariance[standing] @ jacobian[:, :, None])[:, :, 0]
    gain = cross / ((jacobian * cross).sum(axis=1) + noise)[:, None]
    mean[standing] += gain * innovation[:, None]
    covariance[standing] -= gain[:, :, None] * cross[:, None]
    return replace(targets, mean=mean, covariance=covariance)
