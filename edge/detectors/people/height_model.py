"""How tall people appear at each place of the picture: learnt from those who stand alone."""

from __future__ import annotations

import math
from collections import deque

import numpy as np

from protocols.geometry.types import Floats

_BANDS, _KEPT = 16, 60  # of the picture's rows; sightings in each
_LEAST, _ENOUGH = 8, 40  # sightings before it is believed; before nobody else is asked
_EVERY, _SELDOM = 8, 60  # new sightings after which it is fitted again, at first and later
_GUESS, _GUESSES = 0.5, 12.0  # as how many sightings a guess counts, and all of them at the most
_USUAL = np.array([0.3, np.log(0.8), np.log(0.6), 0.0])
"""Tilt [rad], logarithms of focal length over the picture's width and of a person's height over the camera's, roll."""
_STD = np.array([0.3, 0.3, 0.5, 0.06])
_TILTS, _FOCALS, _RATIOS = np.linspace(-0.15, 1.2, 28), np.log([0.5, 0.65, 0.85, 1.1, 1.5]), np.linspace(-3.2, 0.2, 69)
_SPREAD = 0.08  # of people's heights, and of how they are seen
_TALLER = 0.3
_STEP = 0.02
_FINE = np.arange(_RATIOS[0] - 5.0 * _SPREAD, _RATIOS[-1] + 5.0 * _SPREAD, _STEP)
_ERROR = (_FINE[:, None] - _RATIOS) / _SPREAD
_AGREED = np.exp(-0.5 * np.square(np.where(_ERROR > 0, 1.5, 1.0) * _ERROR))
"""How much a sighting that tells one of the ratios _FINE (k,) agrees with each of _RATIOS (n,): (k, n)."""
_OWN = 2.0  # sightings of somebody after which half of what he differs by is his own height
_NEAREST = 0.01  # sine of the least angle below the horizon at which somebody may stand
_ASTRAY = 0.75, 1.33  # what is told may be off by so much; what was seen beyond is something else


_Sightings = list[deque[tuple[float, float, float, str]]]


class Stature:
    """The height [px] of a person whose foot is at a pixel of a picture of width, height px.

    Of a pinhole camera above flat ground: its tilt, focal length, roll and height over people's are what is learnt,
    and where little has been seen they are what is usual. After Hoiem et al. (2008), with tilt and roll. Whoever is
    named has a height of his own, so that it does not matter who was seen where.
    """

    def __init__(self, width: int, height: int) -> None:
        self.size = width, height
        # By rows, so that somebody who stays where he is does not push out all others.
        self._seen: _Sightings = [deque(maxlen=_KEPT) for _ in range(_BANDS)]
        self._told: _Sightings = [deque(maxlen=_KEPT) for _ in range(_BANDS)]
        self._guessed: _Sightings = [deque(maxlen=_KEPT) for _ in range(_BANDS)]
        self._new, self._wait = 0, _EVERY
        self._view: Floats | None = None  # as _USUAL
        self._range = (0.0, 0.0)
        self.typical = 0.25 * height
        """Median height [px] of those who have been seen."""

    @property
    def known(self) -> bool:
        """Whether enough has been seen to tell."""
        return self._view is not None

    def learn(self, u: float, v: float, height: float, who: str = "") -> None:
        """One person who seems to stand alone: foot point and height [px]. who: a name; "" = not known."""
        self._keep(self._seen, u, v, height, who)

    def guess(self, u: float, v: float, height: float) -> None:
        """What may be one person, or the place that one has left: it counts a little until enough have been seen."""
        if sum(map(len, self._seen)) < _ENOUGH:
            self._keep(self._guessed, u, v, height, "")

    def told(self, u: float, v: float, height: float, who: str = "") -> None:
        """What the tracking expects of somebody: it counts until enough have been seen here."""
        self._keep(self._told, u, v, height, who)

    def _keep(self, where: _Sightings, u: float, v: float, height: float, who: str) -> None:
        band = int(np.clip(v / self.size[1] * _BANDS, 0, _BANDS - 1))
        where[band].append((u, v, height, who))
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
        elif seen >= _ENOUGH:
            self._fit(self._seen)
        elif seen + _GUESS * sum(map(len, self._guessed)) >= _LEAST:
            self._fit(self._seen, self._guessed)

    def at(self, u: Floats, v: Floats) -> Floats:
        """Heights [px] at foot points; call it only once it is ``known``."""
        assert self._view is not None
        heights = self._heights(self._view, np.asarray(u), np.asarray(v))
        return np.asarray(np.minimum(np.maximum(heights, self._range[0]), self._range[1]), dtype=np.float64)

    def _heights(self, view: Floats, u: Floats, v: Floats) -> Floats:
        """Of the foot's ray d, up (both in the camera's axes) and q = -up d: the head is at d + ratio q up."""
        tilt, log_focal, log_ratio, roll = view.tolist()  # few people are asked for at once
        focal = math.exp(log_focal) * self.size[0]
        x, y = (u - 0.5 * self.size[0]) / focal, (v - 0.5 * self.size[1]) / focal
        up = _up(tilt, roll)
        below = np.maximum(-(up[0] * x + up[1] * y + up[2]), _NEAREST) * math.exp(log_ratio)
        head = (y + below * up[1]) / np.maximum(1.0 + below * up[2], 0.1)
        return np.asarray(np.maximum(focal * (y - head), 1.0), dtype=np.float64)

    def _fit(self, sightings: _Sightings, guesses: _Sightings | None = None) -> None:
        every = [one for band in sightings for one in band]
        guessed = [one for band in guesses or () for one in band]
        counts = np.ones(len(every) + len(guessed))
        counts[len(every) :] = min(_GUESS, _GUESSES / max(len(guessed), 1))
        every += guessed
        u, v, height = np.array([one[:3] for one in every]).T
        # Of each person one is taller or shorter than usual by something of his own: (people, n) who each sighting is.
        who = np.array([one[3] for one in every])
        owners = (who == np.unique(who[who != ""])[:, None]).astype(np.float64)
        taller = np.zeros(len(every))
        counts = counts * np.sqrt(height / height.max())  # pieces of people are short
        view = self._consensus(v, height, counts)
        steps = 1e-4 * np.eye(4)
        for _ in range(8):
            expected = self._heights(view, u, v)
            error = (np.log(height / expected) - taller) / _SPREAD
            # Two behind each other and what is left of a shadow make silhouettes taller; the short are not taken.
            weight = counts * np.where(error > 0, _TALLER, 1.0) / (1.0 + error**2) ** 2
            slope = np.stack(
                [np.log(self._heights(view + step, u, v) / expected) / (1e-4 * _SPREAD) for step in steps], axis=1
            )
            normal = slope.T @ (slope * weight[:, None]) + np.diag(1.0 / _STD**2)
            right = slope.T @ (weight * error) - (view - _USUAL) / _STD**2
            view = view + np.clip(np.linalg.solve(normal, right), -0.3, 0.3)
            share = owners @ (weight * (error * _SPREAD + taller)) / (owners @ weight + _OWN)
            taller = share @ owners
        expected = self._heights(view, u, v)
        agree = np.abs(np.log(height / expected) - taller) < 2.0 * _SPREAD
        if counts[agree].sum() < 0.5 * _LEAST:
            return
        if sightings is self._told:
            view = view + np.array([0.0, 0.0, np.log(self._scale_by_sight(view)), 0.0])
        self._view = view
        low, high = np.percentile(height[agree], [5, 95])
        self._range = (0.4 * float(low), 2.5 * float(high))
        self.typical = float(np.median(height[agree]))

    def _consensus(self, v: Floats, height: Floats, counts: Floats) -> Floats:
        """The view (4,) without roll that most sightings (n,) agree with, what is unusual agreeing less.

        counts: (n,) as how many each counts.
        """
        best, found = -np.inf, _USUAL
        rows = len(_FINE) * np.arange(len(_TILTS))[:, None]
        for log_focal in _FOCALS:
            focal = np.exp(log_focal) * self.size[0]
            y = (v - 0.5 * self.size[1]) / focal
            head = y - height / focal
            up = _up(_TILTS, 0.0)
            # For each tilt, the ratio that each sighting tells.
            below = -(up[1][:, None] * y + up[2][:, None])
            ratio = (head - y) / np.where(below > _NEAREST, below * (up[1][:, None] - head * up[2][:, None]), np.inf)
            log_ratio = np.log(np.maximum(ratio, 1e-6))
            # Counted by what they tell, as there may be a thousand.
            at = np.rint((log_ratio - _FINE[0]) / _STEP).clip(0, len(_FINE) - 1).astype(np.intp)
            told = np.bincount((at + rows).ravel(), np.broadcast_to(counts, at.shape).ravel(), rows.size * len(_FINE))
            agreed = told.reshape(rows.size, -1) @ _AGREED
            unlikely = np.square((_TILTS - _USUAL[0]) / _STD[0])[:, None] + np.square((_RATIOS - _USUAL[2]) / _STD[2])
            score = agreed - 0.5 * (unlikely + ((log_focal - _USUAL[1]) / _STD[1]) ** 2)
            tilt, at = np.unravel_index(int(np.argmax(score)), score.shape)
            if score[tilt, at] > best:
                best = float(score[tilt, at])
                found = np.array([_TILTS[tilt], log_focal, _RATIOS[at], 0.0])
        return found

    def _scale_by_sight(self, view: Floats) -> float:
        """How much taller people are seen than told: what is told was measured with templates of what was told before.

        Nothing else would hold heights that follow from each other.
        """
        seen = np.array([one[:3] for band in self._seen for one in band]).reshape(-1, 3)
        ratio = seen[:, 2] / np.maximum(self._heights(view, seen[:, 0], seen[:, 1]), 1.0)
        ratio = ratio[(ratio > _ASTRAY[0]) & (ratio < _ASTRAY[1])]
        if len(ratio) < _LEAST:
            return 1.0
        # Where most are: those who hide another and their shadows are taller, who lacks his legs is shorter.
        tried = np.linspace(_ASTRAY[0], _ASTRAY[1], 59)
        agreed = np.exp(-0.5 * ((ratio[:, None] - tried) / _SPREAD) ** 2).sum(axis=0)
        return float(tried[np.argmax(agreed)])


def _up(tilt: Floats | float, roll: Floats | float) -> tuple[Floats, Floats, Floats]:
    """The world's up in the axes (right, down, forward) of a camera that looks down by ``tilt`` and leans."""
    cosine = np.cos(tilt)
    return cosine * np.sin(roll), -cosine * np.cos(roll), -np.sin(tilt)
