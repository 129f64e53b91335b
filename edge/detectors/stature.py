"""How tall people appear at each place of the picture: learnt from those who stand alone."""

from __future__ import annotations

from collections import deque

import numpy as np

from protocols.geometry.types import Floats

_BANDS, _KEPT = 16, 60  # of the picture's rows; sightings in each
_LEAST = 25  # sightings before it is believed
_EVERY, _SELDOM = 20, 60  # new sightings after which it is fitted again, at first and later
_DRAWS = 150
_SPREAD = 0.06  # of people's heights
_TALLER = 0.3


class Stature:
    """The height [px] of a person whose foot is at a pixel of a picture of width, height px.

    On flat ground it is linear in the foot's place for a level camera; a squared term serves wide and steep ones.
    """

    def __init__(self, width: int, height: int) -> None:
        self.size = width, height
        self._scale = np.array([0.5 * width, 0.5 * height])
        # By rows, so that somebody who stays where he is does not push out all others.
        self._seen: list[deque[tuple[float, float, float]]] = [deque(maxlen=_KEPT) for _ in range(_BANDS)]
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
        band = int(np.clip(v / self.size[1] * _BANDS, 0, _BANDS - 1))
        self._seen[band].append((u, v, height))
        self._new += 1
        if self._new >= self._wait and sum(map(len, self._seen)) >= _LEAST:
            self._new = 0
            self._wait = min(2 * self._wait, _SELDOM)
            self._fit()

    def settle(self) -> None:
        """Fit once more to all that has been seen."""
        if sum(map(len, self._seen)) >= _LEAST:
            self._fit()

    def at(self, u: Floats, v: Floats) -> Floats:
        """Heights [px] at foot points; call it only once it is ``known``."""
        assert self._weights is not None
        return np.clip(self._terms(u, v) @ self._weights, *self._range)

    def _terms(self, u: Floats, v: Floats) -> Floats:
        x, y = u / self._scale[0] - 1.0, v / self._scale[1] - 1.0
        return np.stack([np.ones_like(y), y, x, y * y, x * y], axis=-1)

    def _fit(self) -> None:
        seen = np.array([one for band in self._seen for one in band])
        terms = self._terms(seen[:, 0], seen[:, 1])
        middle = float(np.median(seen[:, 2]))
        found = _consensus(terms[:, 1], seen[:, 2], middle)
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
        self._weights = weights
        low, high = np.percentile(seen[agree, 2], [5, 95])
        self._range = (0.75 * float(low), 1.6 * float(high))
        self.typical = float(np.median(seen[agree, 2]))


def _consensus(y: Floats, height: Floats, middle: float) -> Floats:
    """The line (2,) height = a + b y that most sightings (n,), (n,) lie on; nobody grows with the distance."""
    rng = np.random.default_rng(len(y))
    first, second = rng.integers(0, len(y), (2, _DRAWS))
    run = y[second] - y[first]
    usable = np.abs(run) > 0.04
    slope = np.where(usable, (height[second] - height[first]) / np.where(usable, run, 1.0), 0.0)
    slope = np.append(np.maximum(slope, 0.0), 0.0)
    start = np.append(height[first], middle) - slope * np.append(y[first], 0.0)
    line = start[:, None] + slope[:, None] * y
    error = (height - line) / (_SPREAD * np.maximum(line, 8.0))
    agreed = np.exp(-0.5 * (error * np.where(error > 0, 1.5, 1.0)) ** 2)
    best = int(np.argmax(agreed.sum(axis=1)))
    return np.array([start[best], slope[best]])
