"""How tall people appear at each place of the picture: learnt from those who stand alone."""

from __future__ import annotations

from collections import deque

import numpy as np

from protocols.geometry.types import Floats

_BANDS, _KEPT = 16, 60  # of the picture's rows; sightings in each
_LEAST, _ENOUGH = 8, 40  # sightings before it is believed; before nobody else is asked
_EVERY, _SELDOM = 8, 60  # new sightings after which it is fitted again, at first and later
_SLOPE = 0.55  # px of height a row of the foot, of cameras at usual heights
_SLOPES = 0.1, 1.4
_SLOPE_STD = 0.45  # of its logarithm
_NARROW = 0.5  # of half the picture's height: feet in so few rows tell little of the others
_DRAWS = 150
_SPREAD = 0.06  # of people's heights
_TALLER = 0.3
_ASTRAY = 0.75, 1.33  # what is told may be off by so much; what was seen beyond is something else


class Stature:
    """The height [px] of a person whose foot is at a pixel of a picture of width, height px.

    On flat ground it is linear in the foot's place for a level camera; a squared term serves wide and steep ones.
    """

    def __init__(self, width: int, height: int) -> None:
        self.size = width, height
        self._scale = np.array([0.5 * width, 0.5 * height])
        # By rows, so that somebody who stays where he is does not push out all others.
        self._seen: list[deque[tuple[float, float, float]]] = [deque(maxlen=_KEPT) for _ in range(_BANDS)]
        self._told: list[deque[tuple[float, float, float]]] = [deque(maxlen=_KEPT) for _ in range(_BANDS)]
        self._new, self._wait = 0, _EVERY
        self._weights: Floats | None = None
        self._range = (0.0, 0.0)
        self.typical = 0.25 * height
        """Median height [px] of those who have been seen."""

    @property
    def known(self) -> bool:
        """Whether enough has been seen to tell."""
        return self._weights is not None

    def learn(self, u: float, v: float, height: float) -> None:
        """One person who seems to stand alone: foot point and height [px]."""
        self._keep(self._seen, u, v, height)

    def told(self, u: float, v: float, height: float) -> None:
        """What the tracking expects of somebody: it counts until enough have been seen here."""
        self._keep(self._told, u, v, height)

    def _keep(self, where: list[deque[tuple[float, float, float]]], u: float, v: float, height: float) -> None:
        band = int(np.clip(v / self.size[1] * _BANDS, 0, _BANDS - 1))
        where[band].append((u, v, height))
        self._new += 1
        if self._new >= self._wait:
            self._new = 0
            self._wait = int(np.clip(sum(map(len, where)) // 4, _EVERY, _SELDOM))
            self.settle()

    def settle(self) -> None:
        """Fit once more to all that has been seen."""
        seen, told = sum(map(len, self._seen)), sum(map(len, self._told))
        if told >= _LEAST and seen < _ENOUGH:
            self._fit(self._told)
        elif seen >= _LEAST:
            self._fit(self._seen)

    def at(self, u: Floats, v: Floats) -> Floats:
        """Heights [px] at foot points; call it only once it is ``known``."""
        assert self._weights is not None
        return np.clip(self._terms(u, v) @ self._weights, *self._range)

    def _terms(self, u: Floats, v: Floats) -> Floats:
        x, y = u / self._scale[0] - 1.0, v / self._scale[1] - 1.0
        return np.stack([np.ones_like(y), y, x, y * y, x * y], axis=-1)

    def _fit(self, sightings: list[deque[tuple[float, float, float]]]) -> None:
        seen = np.array([one for band in sightings for one in band])
        terms = self._terms(seen[:, 0], seen[:, 1])
        found = _consensus(terms[:, 1], seen[:, 2], self._scale[1])
        offset = np.array([found[0], found[1], 0.0, 0.0, 0.0])
        # Toward the line that most agree on where little has been seen; the higher terms more so.
        ridge = np.diag([0.02, 0.02, 0.3, 1.0, 1.0])
        weights = offset
        for _ in range(6):
            error = (seen[:, 2] - terms @ weights) / (_SPREAD * np.maximum(terms @ weights, 8.0))
            # Two behind each other and what is left of a shadow make silhouettes taller; the short are not taken.
            weight = np.where(error > 0, _TALLER, 1.0) / (1.0 + error**2) ** 2
            normal = terms.T @ (terms * weight[:, None]) + ridge
            weights = offset + np.linalg.solve(normal, terms.T @ (weight * (seen[:, 2] - terms @ offset)))
        agree = np.abs(seen[:, 2] - terms @ weights) < 2.5 * _SPREAD * np.maximum(terms @ weights, 8.0)
        if agree.sum() < 0.5 * _LEAST:
            return
        if sightings is self._told:
            weights = weights * self._scale_by_sight(weights)
        self._weights = weights
        low, high = np.percentile(seen[agree, 2], [5, 95])
        wide = np.ptp(terms[agree, 1]) > _NARROW
        self._range = (0.75 * float(low), 1.6 * float(high)) if wide else (0.5 * float(low), 2.2 * float(high))
        self.typical = float(np.median(seen[agree, 2]))

    def _scale_by_sight(self, weights: Floats) -> float:
        """How much taller people are seen than told: what is told was measured with templates of what was told before.

        Nothing else would hold heights that follow from each other.
        """
        seen = np.array([one for band in self._seen for one in band]).reshape(-1, 3)
        line = self._terms(seen[:, 0], seen[:, 1]) @ weights
        ratio = seen[:, 2] / np.maximum(line, 1.0)
        ratio = ratio[(ratio > _ASTRAY[0]) & (ratio < _ASTRAY[1])]
        if len(ratio) < _LEAST:
            return 1.0
        # Where most are: those who hide another and their shadows are taller, who lacks his legs is shorter.
        tried = np.linspace(_ASTRAY[0], _ASTRAY[1], 59)
        agreed = np.exp(-0.5 * ((ratio[:, None] - tried) / _SPREAD) ** 2).sum(axis=0)
        return float(tried[np.argmax(agreed)])


def _consensus(y: Floats, height: Floats, half: float) -> Floats:
    """The line (2,) height = a + b y that most sightings (n,), (n,) lie on, the taller counting more.

    half: rows [px] of a unit of y. Where the feet are in few rows, the slope that cameras usually have.
    """
    rng = np.random.default_rng(len(y))
    first, second = rng.integers(0, len(y), (2, _DRAWS))
    run = y[second] - y[first]
    usable = np.abs(run) > 0.04
    slope = np.where(usable, (height[second] - height[first]) / np.where(usable, run, 1.0), 0.0) / half
    usual = _SLOPE * np.exp(_SLOPE_STD * np.linspace(-1.5, 1.5, _DRAWS))
    slope = np.where((slope > _SLOPES[0]) & (slope < _SLOPES[1]), slope, usual)
    unlikely = (np.log(slope / _SLOPE) / _SLOPE_STD) ** 2
    slope = slope * half
    start = height[first] - slope * y[first]
    line = start[:, None] + slope[:, None] * y
    error = (height - line) / (_SPREAD * np.maximum(line, 8.0))
    # What is left of somebody where the background has his colours is short.
    agreed = np.exp(-0.5 * (error * np.where(error > 0, 1.5, 1.0)) ** 2) * np.sqrt(height / height.max())
    best = int(np.argmax(agreed.sum(axis=1) - 0.5 * unlikely))
    return np.array([start[best], slope[best]])
