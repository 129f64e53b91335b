"""Image heights of people as a function of the foot point, fitted to isolated people."""

from __future__ import annotations

import math
from collections import deque

import numpy as np

from protocols.geometry.types import Floats

LEAST_HEIGHT = 12.0
"""Height [px] of the smallest people."""
_BANDS, _PER_BAND = 16, 60  # bands of image rows; observations kept in each
# observations for a first fit; from which predictions and tentative ones are not used
_MIN_SIGHTINGS, _FULL_SIGHTINGS = 8, 40
_REFIT_FIRST, _REFIT_LATER = 8, 60  # new observations after which it is fitted again, at first and later
# weight of a tentative observation, and of all of them at most
_TENTATIVE_WEIGHT, _MAX_TENTATIVE_WEIGHT = 0.5, 12.0
_PRIOR_MEAN = np.array([0.3, np.log(0.8), np.log(0.6), 0.0])
"""Tilt [rad], logarithm of the focal length over the image width, logarithm of a person's height over the camera's,
roll [rad].
"""
_PRIOR_STD = np.array([0.3, 0.3, 0.5, 0.06])
_TILTS, _FOCALS, _RATIOS = np.linspace(-0.15, 1.2, 28), np.log([0.5, 0.65, 0.85, 1.1, 1.5]), np.linspace(-3.2, 0.2, 69)
_SPREAD = 0.08  # log std of people's heights and of their measurement
_TALL_WEIGHT = 0.3  # of a silhouette that is taller than expected, against a shorter one
_STEP = 0.02  # of the histogram of log ratios: a quarter of _SPREAD, so that bins do not widen it
_FINE = np.arange(_RATIOS[0] - 5.0 * _SPREAD, _RATIOS[-1] + 5.0 * _SPREAD, _STEP)
_ERROR = (_FINE[:, None] - _RATIOS) / _SPREAD
_SUPPORT = np.exp(-0.5 * np.square(np.where(_ERROR > 0, 1.5, 1.0) * _ERROR))
"""How much an observation of one of the ratios _FINE (k,) supports each of _RATIOS (n,): (k, n)."""
_OWN_HEIGHT_PRIOR = 2.0  # observations of a person after which half of the deviation is attributed to this person
_MIN_DEPRESSION = 0.01  # sine of the smallest angle below the horizon of a foot point
_SCALE_RANGE = 0.75, 1.33  # range of the scale error of predictions; observations beyond it are outliers


_SightingBands = list[deque[tuple[float, float, float, str]]]


class HeightModel:
    """Height [px] of a person as a function of the foot point, in an image of width, height px.

    A pinhole camera above flat ground. Its tilt, focal length, roll and the ratio of a person's height to the camera's
    are estimated; where there are few observations the prior prevails. After Hoiem et al. (2008), with tilt and roll.
    Each named person has an own height, so that the estimate does not depend on who was seen where.
    """

    def __init__(self, width: int, height: int) -> None:
        self.size = width, height
        # By rows, so that a person who stays in one place does not displace all other observations.
        self._observed: _SightingBands = [deque(maxlen=_PER_BAND) for _ in range(_BANDS)]
        self._predicted: _SightingBands = [deque(maxlen=_PER_BAND) for _ in range(_BANDS)]
        self._tentative: _SightingBands = [deque(maxlen=_PER_BAND) for _ in range(_BANDS)]
        self._new, self._wait = 0, _REFIT_FIRST
        self._parameters: Floats | None = None  # as _PRIOR_MEAN
        self._range = (0.0, 0.0)
        self.median_height = 0.25 * height
        """Median height [px] of the observed people."""

    @property
    def is_fitted(self) -> bool:
        """Whether there are enough observations to evaluate the model."""
        return self._parameters is not None

    def add(self, u: float, v: float, height: float, who: str = "") -> None:
        """Add an observation of one isolated person: foot point and height [px]. who: name of the person, "" = not
        known.
        """
        self._store(self._observed, u, v, height, who)

    def add_tentative(self, u: float, v: float, height: float) -> None:
        """Add an observation that may be one person or a ghost: it has a small weight until there are enough
        observations.
        """
        if sum(map(len, self._observed)) < _FULL_SIGHTINGS:
            self._store(self._tentative, u, v, height, "")

    def add_predicted(self, u: float, v: float, height: float, who: str = "") -> None:
        """Add a height predicted by the tracker: used until there are enough own observations."""
        self._store(self._predicted, u, v, height, who)

    def _store(self, where: _SightingBands, u: float, v: float, height: float, who: str) -> None:
        band = int(np.clip(v / self.size[1] * _BANDS, 0, _BANDS - 1))
        where[band].append((u, v, height, who))
        self._new += 1
        if self._new >= self._wait:
            self._new = 0
            self._wait = int(np.clip(sum(map(len, where)) // 4, _REFIT_FIRST, _REFIT_LATER))
            self.refit()

    def refit(self) -> None:
        """Fit the model to all observations so far."""
        observed, predicted = sum(map(len, self._observed)), sum(map(len, self._predicted))
        if predicted >= _MIN_SIGHTINGS and observed < _FULL_SIGHTINGS:
            self._fit(self._predicted)
        elif observed >= _FULL_SIGHTINGS:
            self._fit(self._observed)
        elif observed + _TENTATIVE_WEIGHT * sum(map(len, self._tentative)) >= _MIN_SIGHTINGS:
            self._fit(self._observed, self._tentative)

    def heights_at(self, u: Floats, v: Floats) -> Floats:
        """Heights [px] at foot points u, v [px]; call it only once the model ``is_fitted``."""
        assert self._parameters is not None
        heights = self._heights(self._parameters, np.asarray(u), np.asarray(v))
        return np.asarray(np.minimum(np.maximum(heights, self._range[0]), self._range[1]), dtype=np.float64)

    def _heights(self, parameters: Floats, u: Floats, v: Floats) -> Floats:
        """Heights [px]. With the foot's ray d, the up vector (both in camera axes) and q = -up d, the head is at d +
        ratio q up.
        """
        tilt, log_focal, log_ratio, roll = parameters.tolist()  # arrays are short: scalar arithmetic is faster
        focal = math.exp(log_focal) * self.size[0]
        x, y = (u - 0.5 * self.size[0]) / focal, (v - 0.5 * self.size[1]) / focal
        up = _up(tilt, roll)
        below = np.maximum(-(up[0] * x + up[1] * y + up[2]), _MIN_DEPRESSION) * math.exp(log_ratio)
        head = (y + below * up[1]) / np.maximum(1.0 + below * up[2], 0.1)
        return np.asarray(np.maximum(focal * (y - head), 1.0), dtype=np.float64)

    def _fit(self, sightings: _SightingBands, tentative: _SightingBands | None = None) -> None:
        observations = [one for band in sightings for one in band]
        tentative_observations = [one for band in tentative or () for one in band]
        counts = np.ones(len(observations) + len(tentative_observations))
        counts[len(observations) :] = min(
            _TENTATIVE_WEIGHT, _MAX_TENTATIVE_WEIGHT / max(len(tentative_observations), 1)
        )
        observations += tentative_observations
        u, v, height = np.array([one[:3] for one in observations]).T
        # Each person deviates from the mean by an own height; owners (people, n): whose each observation is.
        who = np.array([one[3] for one in observations])
        owners = (who == np.unique(who[who != ""])[:, None]).astype(np.float64)
        own_height = np.zeros(len(observations))
        counts = counts * np.sqrt(height / height.max())  # fragments of people are short
        parameters = self._consensus(v, height, counts)
        steps = 1e-4 * np.eye(4)
        for _ in range(8):
            expected = self._heights(parameters, u, v)
            error = (np.log(height / expected) - own_height) / _SPREAD
            # People behind each other and remains of shadows make silhouettes taller; short ones are whole people.
            weight = counts * np.where(error > 0, _TALL_WEIGHT, 1.0) / (1.0 + error**2) ** 2
            slope = np.stack(
                [np.log(self._heights(parameters + step, u, v) / expected) / (1e-4 * _SPREAD) for step in steps], axis=1
            )
            normal = slope.T @ (slope * weight[:, None]) + np.diag(1.0 / _PRIOR_STD**2)
            right = slope.T @ (weight * error) - (parameters - _PRIOR_MEAN) / _PRIOR_STD**2
            parameters = parameters + np.clip(np.linalg.solve(normal, right), -0.3, 0.3)
            share = owners @ (weight * (error * _SPREAD + own_height)) / (owners @ weight + _OWN_HEIGHT_PRIOR)
            own_height = share @ owners
        expected = self._heights(parameters, u, v)
        agree = np.abs(np.log(height / expected) - own_height) < 2.0 * _SPREAD
        if counts[agree].sum() < 0.5 * _MIN_SIGHTINGS:
            return
        if sightings is self._predicted:
            parameters = parameters + np.array([0.0, 0.0, np.log(self._observed_scale(parameters)), 0.0])
        self._parameters = parameters
        # Weighted by the height: a swaying tree has dozens of small silhouettes that agree with the model far away.
        ordered = np.sort(height[agree])
        share = np.cumsum(ordered) / ordered.sum()
        low, middle, high = ordered[np.searchsorted(share, [0.05, 0.5, 0.95])]
        self._range = (max(0.4 * float(low), LEAST_HEIGHT), 2.5 * float(high))
        self.median_height = float(middle)

    def _consensus(self, v: Floats, height: Floats, counts: Floats) -> Floats:
        """The parameters (4,) with zero roll that most observations (n,) support, with the prior as penalty.

        counts: (n,) weights of the observations.
        """
        best, found = -np.inf, _PRIOR_MEAN
        rows = len(_FINE) * np.arange(len(_TILTS))[:, None]
        for log_focal in _FOCALS:
            focal = np.exp(log_focal) * self.size[0]
            y = (v - 0.5 * self.size[1]) / focal
            head = y - height / focal
            up = _up(_TILTS, 0.0)
            # For each tilt, the height ratio that each observation implies.
            below = -(up[1][:, None] * y + up[2][:, None])
            ratio = (head - y) / np.where(
                below > _MIN_DEPRESSION, below * (up[1][:, None] - head * up[2][:, None]), np.inf
            )
            log_ratio = np.log(np.maximum(ratio, 1e-6))
            # As a histogram, because there may be a thousand observations.
            at = np.rint((log_ratio - _FINE[0]) / _STEP).clip(0, len(_FINE) - 1).astype(np.intp)
            histogram = np.bincount(
                (at + rows).ravel(), np.broadcast_to(counts, at.shape).ravel(), rows.size * len(_FINE)
            )
            agreed = histogram.reshape(rows.size, -1) @ _SUPPORT
            unlikely = np.square((_TILTS - _PRIOR_MEAN[0]) / _PRIOR_STD[0])[:, None] + np.square(
                (_RATIOS - _PRIOR_MEAN[2]) / _PRIOR_STD[2]
            )
            score = agreed - 0.5 * (unlikely + ((log_focal - _PRIOR_MEAN[1]) / _PRIOR_STD[1]) ** 2)
            tilt, at = np.unravel_index(int(np.argmax(score)), score.shape)
            if score[tilt, at] > best:
                best = float(score[tilt, at])
                found = np.array([_TILTS[tilt], log_focal, _RATIOS[at], 0.0])
        return found

    def _observed_scale(self, parameters: Floats) -> float:
        """Ratio of observed to predicted heights: predictions were measured with templates of earlier predictions.

        Nothing else would anchor a scale that is derived from itself.
        """
        seen = np.array([one[:3] for band in self._observed for one in band]).reshape(-1, 3)
        ratio = seen[:, 2] / np.maximum(self._heights(parameters, seen[:, 0], seen[:, 1]), 1.0)
        ratio = ratio[(ratio > _SCALE_RANGE[0]) & (ratio < _SCALE_RANGE[1])]
        if len(ratio) < _MIN_SIGHTINGS:
            return 1.0
        # The mode: occluding people and shadows are taller, people whose legs are hidden are shorter.
        tried = np.linspace(_SCALE_RANGE[0], _SCALE_RANGE[1], 59)
        agreed = np.exp(-0.5 * ((ratio[:, None] - tried) / _SPREAD) ** 2).sum(axis=0)
        return float(tried[np.argmax(agreed)])


def _up(tilt: Floats | float, roll: Floats | float) -> tuple[Floats, Floats, Floats]:
    """The world's up vector in the axes (right, down, forward) of a camera that looks down by ``tilt`` and is rolled by
    ``roll``.
    """
    cosine = np.cos(tilt)
    return cosine * np.sin(roll), -cosine * np.cos(roll), -np.sin(tilt)
