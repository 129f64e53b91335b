"""What a frame says about every particle: the candidates that were found, and that elsewhere none was."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np

from edge.uav.prediction.particle_set import Cloud
from edge.uav.target.appearance import Candidate
from edge.uav.target.tracklets import Tracklet
from protocols.geometry.types import Floats

_SLOPE, _MIDDLE = 14.0, 0.62  # of the log-likelihood ratio of target against clutter over the score
_MIDDLE_AGAIN = 0.72  # the same after a while unseen: crowns of trees have many spots that are a little alike
_LEAST, _MOST = -6.0, 5.0
_CLUTTER = 0.01  # candidates that are not the target [1/unit²]
_BELIEVE = 0.7  # posterior of a candidate from which it is taken for the target
_BELIEVE_AGAIN = 0.8  # the same after a while unseen
_SCORE = 0.45  # and its least score; after a while unseen:
_SCORE_AGAIN = 0.6
_SHAPE_AGAIN = 0.45
_CUT_LESS = 0.4  # by which a score counts less for each unit of the candidate that the picture's border cuts off
_PATIENT = 25.0  # most that one frame says for a place where it is found again: a look-alike soon drives elsewhere
_SAYS_AT_MOST = 100.0  # factor on the odds by one look-alike in all its frames
_THERE = 3.0  # stds within which a particle is where a candidate is
_UNKNOWN_MOTION = 3.0  # the same before its motion is known
_BETTER = 4.0
_MOTION_STD = 1.5  # of a particle's velocity, one coordinate [units/s]
_TURN_STD = 0.2  # of a heading by the shape [rad]
_CUT = 0.42  # least share of it in the picture


@dataclass(frozen=True, slots=True, eq=False)
class Verdict:
    """best: the candidate that is the target, or None. sureness: its posterior. likelihood: (n,) of the particles.

    crowded: whether something similar stands beside it.
    """

    best: Candidate | None
    sureness: float
    likelihood: Floats | None
    crowded: bool

    @classmethod
    def nothing(cls) -> Verdict:
        """Nothing was looked at."""
        return cls(None, 0.0, None, False)


def allow(tracklet: Tracklet, weight: float) -> None:
    """A look-alike was given particles of a weight: it may be the target at least so far as these say."""
    tracklet.odds_limit = max(tracklet.odds_limit or 0.0, _SAYS_AT_MOST * weight)


def judge(
    cloud: Cloud,
    candidates: Sequence[Candidate],
    tracklets: Sequence[Tracklet],
    chance: Floats,
    noise: Callable[[Candidate], tuple[float, float]],
    length: float,
    again: bool,
    is_shaped: Callable[[Candidate], bool],
) -> Verdict:
    """Weigh particles by candidates: p = 1 - c + c sum_j r_j N(z_j; x, R) / clutter.

    chance: (n,) c, the chance that the target would have been found if it were at the particle. noise: std of a
    candidate's place, one coordinate [ground units], if it is seen as usual, and if something hides what it lacks.
    length: the target's. again: the target has been out of sight for a while: one frame then says less, its shape must
    fit too, and it must be seen to move as the particles do. is_shaped: whether a candidate's shape fits so well that
    its angle is the target's heading.
    """
    gain = np.zeros((len(candidates), len(cloud)))
    there = np.zeros((len(candidates), len(cloud)), np.bool_)
    most_alike = max((candidate.score for candidate in candidates), default=0.0)
    velocity = cloud.speed[:, None] * np.column_stack([np.cos(cloud.heading), np.sin(cloud.heading)])
    for j, candidate in enumerate(candidates):
        usual, std = ((1.5 * value + 0.1 if again else value) for value in noise(candidate))
        squared = np.square(cloud.place - candidate.ground).sum(axis=1)
        there[j] = squared < (_THERE * usual) ** 2
        squared = squared / std**2
        middle = _MIDDLE_AGAIN if again else _MIDDLE
        score = _sure_score(candidate) if again else candidate.score
        ratio = np.exp(np.clip(_SLOPE * (score - middle), _LEAST, _MOST))
        peak = 0.9 * ratio / (2 * np.pi * std**2) / _CLUTTER
        if again:
            motion = tracklets[j].velocity()
            if motion is None:
                peak = min(peak, _UNKNOWN_MOTION)
            else:
                # Of two that both may be it, the more alike wins in time.
                peak = min(peak, _PATIENT) * float(np.exp(_BETTER * (candidate.score - most_alike)))
                off = np.square(velocity - motion[0]).sum(axis=1) / (motion[1] ** 2 + _MOTION_STD**2)
                # Where an oncoming car passes is not where the target is.
                there[j] &= off < _THERE**2
                squared = squared + off
                if is_shaped(candidate):
                    off_angle = (cloud.heading - candidate.angle + np.pi) % (2 * np.pi) - np.pi
                    squared = squared + np.square(off_angle / _TURN_STD)
        gain[j] = peak * np.exp(-0.5 * np.minimum(squared, 50.0))
    none = 1.0 - chance
    likelihood = none + gain.sum(axis=0)
    if again:
        for candidate, tracklet, own in zip(candidates, tracklets, gain, strict=True):
            # Where another car is the target is not; but a leaf that is a little alike leaves room for it.
            car = candidate.score > _SCORE_AGAIN and candidate.shape > _SHAPE_AGAIN
            least = np.zeros(len(cloud)) if car else likelihood - own
            likelihood = _limited(cloud, likelihood, least, candidate, tracklet, length)
    if not len(candidates):
        return Verdict(None, 0.0, likelihood, False)
    mass = gain @ cloud.weights
    total = mass.sum() + float(cloud.weights @ none)
    posterior = mass / total
    if again:
        # What was said of a candidate before is in the weights of the particles that are where it is.
        weighted = cloud.weights * likelihood
        posterior = there @ weighted / weighted.sum()
    k = int(np.argmax(posterior))
    best = candidates[k]
    crowded = any(
        other is not best and other.score > 0.6 and np.linalg.norm(other.ground - best.ground) < 1.3 * length
        for other in candidates
    )
    good = (
        posterior[k] > (_BELIEVE_AGAIN if again else _BELIEVE)
        and (_sure_score(best) > _SCORE_AGAIN if again else best.score > _SCORE)
        and best.seen > _CUT
    )
    if again:
        good &= best.shape > _SHAPE_AGAIN and tracklets[k].age >= 3
    return Verdict(best if good else None, float(posterior[k]), likelihood, crowded)


def _sure_score(candidate: Candidate) -> float:
    """The score of what is found again, less where the picture's border cuts it off.

    Half of anything is easily alike, and where the picture moves after the target its border drives as the target does.
    """
    return candidate.score - _CUT_LESS * (1.0 - min(candidate.seen, 1.0))


def _limited(
    cloud: Cloud, likelihood: Floats, least: Floats, candidate: Candidate, tracklet: Tracklet, length: float
) -> Floats:
    """The likelihood with what one look-alike says in all bounded: some other car looks the same, frame after frame.

    The odds of the particles about it may grow by _SAYS_AT_MOST over what they were when it was first seen, and by what
    the others lose for not being seen where they should be. least: (n,) what is left to them at least: a cloud that
    comes to where something hardly alike stands is not driven off.
    """
    about = np.square(cloud.place - candidate.ground).sum(axis=1) < length**2
    before = float(cloud.weights[about].sum())
    if tracklet.odds_limit is None:
        tracklet.odds_limit = _SAYS_AT_MOST * before / max(1.0 - before, 1e-6)
    rest = float(cloud.weights[~about] @ likelihood[~about])
    if rest <= 1e-12:
        return likelihood
    tracklet.odds_limit *= max((1.0 - before) / rest, 1.0)
    odds = float(cloud.weights[about] @ likelihood[about]) / rest
    if odds <= tracklet.odds_limit:
        return likelihood
    return np.where(about, np.maximum(likelihood * (tracklet.odds_limit / odds), least), likelihood)
