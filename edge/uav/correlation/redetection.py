"""Re-detection of a target that was away: where it is searched for, and how what is found is tested."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace

import numpy as np

from edge.uav.correlation.candidate import KEEPS, Candidate, Kinematics
from edge.uav.correlation.colour import ColourModel
from edge.uav.correlation.filter import Response
from edge.uav.correlation.memory import TemplateMemory
from edge.uav.correlation.oriented_box import OrientedBox
from edge.uav.correlation.search import search, tile
from edge.uav.image_motion.residual import UNKNOWN, Residual
from edge.uav.image_motion.scene_motion import Motion
from protocols.geometry.types import Floats, Image

_MARGIN = 1.0  # log odds by which a place must exceed the next best one, and the one under test
_MANOEUVRE = 3.0  # acceleration of what brakes, turns or sets off, in lengths a second squared; a car that starts
_ANYWHERE_RATE = 0.01  # at which a target is not near its prediction any more [1/s]
_PROPOSED, _MOST_PROPOSED = 2.5, 1.0  # log likelihood ratio of another tracker's place; its first log prior, at most
_PROMISING = 0.0  # log odds of a place under test above which others are searched about the prediction only
_LONG_TEST = 8  # frames under test after which all of the image is searched beside: it may be a look-alike
_WORTH_A_TEST = -8.0  # log odds on the search's coarse grid, off which the similarity is higher by far
_MOST_TESTED, _RIVAL_MARGIN = 2, 2.0  # places that are tested at once; log odds within which one is a rival
_UNSEARCHED = 4.0  # log odds that a place must exceed, with the margin, while the target is surely out of reach
_MOST_MOVING = 2  # places at which something moves that are looked at, a search
_DETECTION = 0.25  # probability that one search finds a target in view
_HIDDEN = 0.1  # probability that it is in view, but behind something, for as long as it is away
_CHANGE = 0.1  # std of the similarity of a target that has been away
_MIN_INSIDE = 0.6  # share of a place in the image
_SIZE_STD, _LOOK_ALIKE_SIZE_STD = 0.25, 0.35
"""Of ln (size over the predicted one): of a target that comes back, 0.18 in real videos and 0.25 in rendered ones; and
of look-alikes under test, 0.2 to 0.3 (rms), most of them too small."""
_SIZE_PRECISION = 0.5 * (_SIZE_STD**-2 - _LOOK_ALIKE_SIZE_STD**-2)  # half the difference of both, of their squares
TRIAL_SIZES = (0.9, 1.1)  # factors on the sides: they move the box's border by a third of a template's cell
_FIRST_SIZES = (0.7, 0.84, 1.2, 1.4)  # of a place that is tested for the first time
_TRIAL_TURNS, _FIRST_TURNS = (-0.1, 0.1), (-0.36, -0.18, 0.18, 0.36)  # [rad]
_SIZES = (1.0, 0.87, 1.0, 1.15, 1.0, 0.75, 1.0, 1.33)  # factors on the sides, one a search: it comes back nearer or not
_UPRIGHT = float("nan")  # as in the first image, however it had turned: most targets only seem to turn
_ANGLES = (0.0, _UPRIGHT, 0.35, 0.0, -0.35, _UPRIGHT, 0.7, 0.0, -0.7, _UPRIGHT, 1.1, 0.0, -1.1, _UPRIGHT, 1.57)

Localise = Callable[[Image, OrientedBox], tuple[OrientedBox, Response]]


@dataclass(frozen=True, slots=True)
class Prediction:
    """Where the target is predicted: box; std of its centre, one coordinate [px]; how it moves; how long it is away."""

    box: OrientedBox
    std: float
    motion: Kinematics
    frames: int
    seconds: float

    @property
    def wide(self) -> float:
        """Std of its centre if it turns, brakes or sets off, one coordinate [px]."""
        return float(np.hypot(self.std, 0.5 * _MANOEUVRE * self.motion.length * self.seconds**2))


class Redetection:
    """One absence. size: of the images [px]; localise: the box and the answer of the target's filter about a box.

    scanned: the memory that proposes places; memory: a whitened one, by whose similarities they are compared.
    """

    def __init__(
        self,
        size: tuple[int, int],
        scanned: TemplateMemory,
        memory: TemplateMemory,
        localise: Localise,
        colour: ColourModel,
    ) -> None:
        self._size, self._scanned, self._memory, self._localise = size, scanned, memory, localise
        # Probabilities that it is near the prediction, that it is in the image, and that it was not seen there.
        self._near, self._inside, self._unnoticed = 1.0, 0.0, 1.0
        self._left = 1.0  # share of where it was expected that no search has ruled out
        self._colour = colour
        self._tested: list[Candidate] = []
        self._moving = UNKNOWN

    def move(self, motion: Motion, reach: float, dt: float) -> None:
        """Predict the places under test into the next frame."""
        for candidate in self._tested:
            candidate.move(motion, reach, dt)

    def propose(self, box: OrientedBox, expected: Prediction) -> None:
        """Test a place that another tracker has found."""
        prior = min(self._log_prior(box.centre, expected) + _PROPOSED, _MOST_PROPOSED)
        same = [c for c in self._tested if c.covers(box)]
        for candidate in same:
            candidate.prior = max(candidate.prior, prior)
        if not same:
            self._tested.append(Candidate(box, prior, expected.motion))

    def look(self, image: Image, expected: Prediction, dt: float, moving: Residual = UNKNOWN) -> Candidate | None:
        """Search one image; the place that is taken for the target, if any: by its odds, and a margin over the next."""
        self._moving = moving
        self._tested = [c for c in self._tested if self._test(image, c, expected, dt)]
        hopeful = self._tested and self._tested[0].log_odds >= _PROMISING and self._tested[0].hits <= _LONG_TEST
        if not hopeful or expected.frames % 2 == 0:
            self._search(image, expected, dt)
        kept: list[Candidate] = []
        for candidate in sorted(self._tested, key=lambda c: -c.log_odds):
            if not any(c.covers(candidate.box) for c in kept):  # two that came to one place are no rivals
                kept.append(candidate)
        self._tested = kept[:_MOST_TESTED]
        if not self._tested:
            return None
        best = self._tested[0]
        others = [c.log_odds for c in self._tested[1:]]
        least = max(0.0, _UNSEARCHED * self._unsearched(best, expected), *others)
        return best if best.accepted and best.log_odds > least + _MARGIN else None

    def _unsearched(self, found: Candidate, expected: Prediction) -> float:
        """Probability that the target is where it could not be found yet: each search is a chance for look-alikes.

        It is beyond the border; or it is nearer the prediction than the place, and was in view for too short a time.
        """
        beyond = 1.0 - expected.box.probability_inside(expected.std, self._size)
        squared = float(np.square(found.box.centre - expected.box.centre).sum())
        nearer = 1.0 - 1.0 / (1.0 + 0.5 * squared / expected.std**2)  # of the distribution of `_log_density`
        return max(beyond, self._near * nearer)

    def _search(self, image: Image, expected: Prediction, dt: float) -> None:
        """Take up the likeliest new place: in turn about the prediction, and in one tile after the other."""
        box, number = expected.box, expected.frames
        if number % 2:
            views = [tile(_view(box, number // 2), self._size, number // 2)]
        else:
            self._find_nothing(expected)
            reach = max(3.0 * expected.std, 2.0 * expected.wide)
            # Who drives through a bend may have turned by any angle.
            turned = [_view(box, number + k) for k in range(2)]
            views = [(view, reach + 0.3 * view.sides) for view in turned]
        places = [f.box for view in views for f in search(image, self._scanned, *view)]
        places += [box.at(place) for place in self._moving.peaks(box.extent, _MOST_MOVING)]
        for k, candidate in enumerate(self._tested):
            seen = [place for place in places if candidate.covers(place)] if candidate.hits > _LONG_TEST // 2 else []
            if seen:  # undecided, it may be seen at the wrong angle
                best = seen[int(self._memory.scores(image, seen).argmax())]
                other = replace(candidate, box=best, hits=0, evidence=0.0)
                if self._test(image, other, expected, dt) and other.last > candidate.last + _RIVAL_MARGIN:
                    self._tested[k] = other
        new = [place for place in places if not any(c.covers(place) for c in self._tested)]
        if not new:
            return
        priors = [self._log_prior(place.centre, expected) for place in new]
        odds = [
            self._memory.log_ratio(score, _CHANGE, self._moving.log_ratio(place.centre))
            + prior
            + self._colour.log_ratio(image, place)
            for place, score, prior in zip(new, self._memory.scores(image, new).tolist(), priors, strict=True)
        ]
        order = np.argsort(odds)[::-1]
        for k in order[:_MOST_TESTED]:
            # A rival that is about as likely is tested beside the likeliest one.
            if odds[k] > max(_WORTH_A_TEST, odds[order[0]] - _RIVAL_MARGIN):
                candidate = Candidate(new[k], priors[k], expected.motion)
                if self._test(image, candidate, expected, dt):
                    self._tested.append(candidate)

    def _find_nothing(self, expected: Prediction) -> None:
        """Where it was expected and is not seen, it is less and less likely to be; beyond the border it can be."""
        before, self._inside = self._inside, expected.box.probability_inside(expected.std, self._size)
        entered = max(self._inside - before, 0.0)
        unnoticed = (min(self._inside, before) * self._unnoticed + entered) / max(self._inside, 1e-6)
        self._unnoticed = max((1.0 - _DETECTION) * unnoticed, _HIDDEN)
        self._near = 1.0 - self._inside * (1.0 - self._unnoticed)
        left = min(self._left, self._near)
        for candidate in self._tested:  # likelier, as a search about the prediction finds nothing else
            candidate.prior += float(np.log(self._left / left))
        self._left = left

    def _log_prior(self, place: Floats, expected: Prediction) -> float:
        """Log probability that the target is in the box about ``place`` (2,): near the prediction, or anywhere."""
        area = expected.box.width * expected.box.height
        share = self._near / (self._near + 1.0 - np.exp(-_ANYWHERE_RATE * expected.seconds))
        squared = float(np.square(place - expected.box.centre).sum())
        near = np.log(share + 1e-12) + float(
            np.logaddexp(
                np.log(KEEPS) + _log_density(squared, expected.std, area),
                np.log(1.0 - KEEPS) + _log_density(squared, expected.wide, area),
            )
        )
        return float(np.logaddexp(near, np.log((1.0 - share) * area / (self._size[0] * self._size[1]))))

    def _test(self, image: Image, candidate: Candidate, expected: Prediction, dt: float) -> bool:
        """Add a frame's evidence to a place; whether it may still be the target."""
        box, answer = self._localise(image, candidate.box)
        sizes, turns = (TRIAL_SIZES, _TRIAL_TURNS) if candidate.hits else (_FIRST_SIZES, _FIRST_TURNS)
        if candidate.hits == 0:
            # Before another size or angle is believed: the last one, localised about the same place.
            same, same_answer = self._localise(image, expected.box.at(candidate.box.centre))
            if self._memory.score(image, same) > self._memory.score(image, box):
                box, answer = same, same_answer
        trials = [box, *(box.sized(f * box.sides) for f in sizes), *(box.turned(angle) for angle in turns)]
        scores = self._memory.scores(image, trials)
        score, box = float(scores.max()), trials[int(scores.argmax())]
        cues = answer.log_ratio + self._moving.log_ratio(box.centre)
        size = 0.5 * float(np.log(np.prod(box.sides / expected.box.sides)))
        evidence = self._memory.log_ratio(score, _CHANGE, cues) + self._colour.log_ratio(image, box)
        evidence += float(np.log(_LOOK_ALIKE_SIZE_STD / _SIZE_STD)) - _SIZE_PRECISION * size**2
        candidate.add(box, evidence, dt)
        return candidate.promising and box.share_inside(self._size) > _MIN_INSIDE


def _view(box: OrientedBox, number: int) -> OrientedBox:
    """The box at one of the sizes and angles that are tried in turn."""
    angle = _ANGLES[number % len(_ANGLES)]
    return box.sized(box.sides * _SIZES[number % len(_SIZES)]).turned(-box.angle if np.isnan(angle) else angle)


def _log_density(squared: float, std: float, area: float) -> float:
    """Log probability of a place in the box: Student's t with two degrees of freedom, for the std itself is a guess.

    squared: squared distance from the prediction [px^2]; std: of the prediction, one coordinate [px]; area: of the box.
    """
    return float(-2.0 * np.log1p(0.5 * squared / std**2) + np.log(min(area / (2.0 * np.pi * std**2), 1.0)))
