"""Measurement likelihood of one frame for every particle: from the detected candidates, and from missed detections."""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np

from edge.uav.prediction.particle_set import ParticleSet
from edge.uav.target.appearance import Candidate
from edge.uav.target.tracklets import Tracklet
from protocols.geometry.types import Floats

_LLR_SLOPE, _LLR_CENTRE = 14.0, 0.62  # log-likelihood ratio of target to clutter over the score
_LLR_CENTRE_REACQUIRE = 0.72  # when re-acquiring: crowns of trees have many slightly similar regions
_MIN_LLR, _MAX_LLR = -6.0, 5.0  # odds of 400 and 150: no single frame decides
_CLUTTER_DENSITY = 0.01  # of candidates that are not the target [1/unit²]
_MIN_POSTERIOR = 0.7  # of a candidate that is accepted as the target
_MIN_POSTERIOR_REACQUIRE = 0.8  # the same when re-acquiring
_MIN_SCORE = 0.45  # of an accepted candidate
_MIN_SCORE_REACQUIRE, _MIN_SHAPE_REACQUIRE = 0.6, 0.45  # the same when re-acquiring, and of its shape alone
_BORDER_PENALTY = 0.4  # subtracted from the score, times the share of the candidate outside the image
_MAX_PEAK_REACQUIRE = 25.0  # of the likelihood of one frame when re-acquiring: a similar car soon drives elsewhere
_MAX_BAYES_FACTOR = 100.0  # of one tracklet over all its frames
_GATE = 3.0  # stds within which a particle is at a candidate
_MAX_PEAK_UNKNOWN_MOTION = 3.0  # of the likelihood before the tracklet's velocity is known
_SCORE_PREFERENCE = 4.0  # log-likelihood per unit of score below the best candidate
_VELOCITY_STD = 1.5  # of a particle's velocity, one coordinate [units/s]
_HEADING_STD = 0.2  # of a heading from the template [rad]
_MIN_VISIBLE_SHARE = 0.42  # of the footprint inside the image


@dataclass(frozen=True, slots=True, eq=False)
class MeasurementLikelihood:
    """best: the candidate accepted as the target, or None. posterior: its probability.

    likelihood: (n,) of the particles; None without a measurement. ambiguous: whether a similar candidate is close to
    it.
    """

    best: Candidate | None
    posterior: float
    likelihood: Floats | None
    ambiguous: bool

    @classmethod
    def empty(cls) -> MeasurementLikelihood:
        """The result of a frame without a search."""
        return cls(None, 0.0, None, False)


def raise_odds_limit(tracklet: Tracklet, weight: float) -> None:
    """Raise the odds limit of a tracklet at which particles of this total weight were injected."""
    tracklet.odds_limit = max(tracklet.odds_limit or 0.0, _MAX_BAYES_FACTOR * weight)


def evaluate_candidates(
    particles: ParticleSet,
    candidates: Sequence[Candidate],
    tracklets: Sequence[Tracklet],
    detection_probability: Floats,
    position_stds: Callable[[Candidate], tuple[float, float]],
    length: float,
    reacquiring: bool,
    shape_matches: Callable[[Candidate], bool],
    crab_angle: float = 0.0,
) -> MeasurementLikelihood:
    """Likelihood of the particles: p = 1 - c + c sum_j r_j N(z_j; x, R) / clutter.

    detection_probability: (n,) c, of detecting the target if it were at the particle. position_stds: std of a
    candidate's position, one coordinate [ground units], unoccluded, and if its missing score is due to occlusion.
    length: the target's. reacquiring: the target has been out of view for a while: the likelihood of one frame is then
    limited, the shape must match too, and the tracklet's velocity must match the particles'. shape_matches: whether a
    candidate's shape matches so well that its angle, less the ``crab_angle``, is the target's heading.
    """
    gain = np.zeros((len(candidates), len(particles)))
    in_gate = np.zeros((len(candidates), len(particles)), np.bool_)
    best_score = max((candidate.score for candidate in candidates), default=0.0)
    velocity = particles.speed[:, None] * np.column_stack([np.cos(particles.heading), np.sin(particles.heading)])
    for j, candidate in enumerate(candidates):
        unoccluded_std, std = ((1.5 * value + 0.1 if reacquiring else value) for value in position_stds(candidate))
        squared = np.square(particles.position - candidate.ground).sum(axis=1)
        in_gate[j] = squared < (_GATE * unoccluded_std) ** 2
        squared = squared / std**2
        llr_centre = _LLR_CENTRE_REACQUIRE if reacquiring else _LLR_CENTRE
        score = _border_discounted_score(candidate) if reacquiring else candidate.score
        ratio = math.exp(min(max(_LLR_SLOPE * (score - llr_centre), _MIN_LLR), _MAX_LLR))
        peak = 0.9 * ratio / (2 * np.pi * std**2) / _CLUTTER_DENSITY
        if reacquiring:
            motion = tracklets[j].velocity()
            if motion is None:
                peak = min(peak, _MAX_PEAK_UNKNOWN_MOTION)
            else:
                # Between two plausible candidates the one with the higher score prevails over time.
                peak = min(peak, _MAX_PEAK_REACQUIRE) * float(
                    np.exp(_SCORE_PREFERENCE * (candidate.score - best_score))
                )
                velocity_distance = np.square(velocity - motion[0]).sum(axis=1) / (motion[1] ** 2 + _VELOCITY_STD**2)
                # An oncoming car at the position of the particles is not the target.
                in_gate[j] &= velocity_distance < _GATE**2
                squared = squared + velocity_distance
                if shape_matches(candidate):
                    heading_error = (particles.heading + crab_angle - candidate.angle + np.pi) % (2 * np.pi) - np.pi
                    squared = squared + np.square(heading_error / _HEADING_STD)
        gain[j] = peak * np.exp(-0.5 * np.minimum(squared, 50.0))
    miss_likelihood = 1.0 - detection_probability
    likelihood = miss_likelihood + gain.sum(axis=0)
    if reacquiring:
        for candidate, tracklet, own in zip(candidates, tracklets, gain, strict=True):
            # A vehicle excludes the target at its position; a weakly similar background region does not.
            is_vehicle = candidate.score > _MIN_SCORE_REACQUIRE and candidate.shape > _MIN_SHAPE_REACQUIRE
            floor = np.zeros(len(particles)) if is_vehicle else likelihood - own
            likelihood = _limit_odds(particles, likelihood, floor, candidate, tracklet, length)
    if not len(candidates):
        return MeasurementLikelihood(None, 0.0, likelihood, False)
    mass = gain @ particles.weights
    total = mass.sum() + float(particles.weights @ miss_likelihood)
    posterior = mass / total
    if reacquiring:
        # Earlier frames of a candidate are already in the weights of the particles in its gate.
        weighted = particles.weights * likelihood
        posterior = in_gate @ weighted / weighted.sum()
    k = int(np.argmax(posterior))
    best = candidates[k]
    ambiguous = any(
        other is not best and other.score > 0.6 and np.linalg.norm(other.ground - best.ground) < 1.3 * length
        for other in candidates
    )
    accepted = (
        posterior[k] > (_MIN_POSTERIOR_REACQUIRE if reacquiring else _MIN_POSTERIOR)
        and (_border_discounted_score(best) > _MIN_SCORE_REACQUIRE if reacquiring else best.score > _MIN_SCORE)
        and best.visible_share > _MIN_VISIBLE_SHARE
    )
    if reacquiring:
        accepted &= best.shape > _MIN_SHAPE_REACQUIRE and tracklets[k].age >= 3
    return MeasurementLikelihood(best if accepted else None, float(posterior[k]), likelihood, ambiguous)


def _border_discounted_score(candidate: Candidate) -> float:
    """The score for re-acquisition, reduced where the image border cuts the candidate off.

    A partial view matches more easily, and when the image follows the target its border moves like the target.
    """
    return candidate.score - _BORDER_PENALTY * (1.0 - min(candidate.visible_share, 1.0))


def _limit_odds(
    particles: ParticleSet, likelihood: Floats, floor: Floats, candidate: Candidate, tracklet: Tracklet, length: float
) -> Floats:
    """The likelihood with the total evidence of one tracklet bounded: a similar car matches in frame after frame.

    The odds of the particles near it may grow to _MAX_BAYES_FACTOR times their value at its first detection, and by the
    weight that the other particles lose through missed detections. floor: (n,) lower bound of the likelihood: particles
    that reach a weakly similar background region keep theirs.
    """
    nearby = np.square(particles.position - candidate.ground).sum(axis=1) < length**2
    prior_weight = float(particles.weights[nearby].sum())
    if tracklet.odds_limit is None:
        tracklet.odds_limit = _MAX_BAYES_FACTOR * prior_weight / max(1.0 - prior_weight, 1e-6)
    remaining = float(particles.weights[~nearby] @ likelihood[~nearby])
    if remaining <= 1e-12:
        return likelihood
    tracklet.odds_limit *= max((1.0 - prior_weight) / remaining, 1.0)
    odds = float(particles.weights[nearby] @ likelihood[nearby]) / remaining
    if odds <= tracklet.odds_limit:
        return likelihood
    return np.where(nearby, np.maximum(likelihood * (tracklet.odds_limit / odds), floor), likelihood)
