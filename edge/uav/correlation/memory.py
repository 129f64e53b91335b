"""Templates of the target and the likelihood ratio of "target" against "its own background".

A template is the box resampled to 6x6 cells of features. The score of a place is its normalised correlation with the
most similar template. What scores the target and what its surroundings reach is learnt from the images themselves, so
that the ratio means something from the first frame on.
"""

from __future__ import annotations

from dataclasses import dataclass

import cv2
import numpy as np
import numpy.typing as npt
import scipy.fft

from edge.uav.correlation.features import Features
from edge.uav.correlation.oriented_box import OrientedBox
from edge.uav.correlation.template import CELLS, CENTRED, Whitening, vectors, weighted
from protocols.geometry.types import Floats, Image

_MAX_TEMPLATES = 8  # the first view and the last used: each costs a product at every place that is scored
_NEW_BELOW = 0.9  # similarity to the most similar template below which a view becomes a template
_TAIL_BINS = 20  # of the histogram of what places beside the target score, from 0 to 1
_LOOK_ALIKES = 0.5  # places as similar as the target that are taken to have been seen before the first image
_PLACES = 300.0  # number of places that this start is worth
_MIN_STD = 0.07  # of a score of the same thing, from one image to another
_MAX_SCANNED = 4  # templates with which a region is searched
CHANGED = 0.2  # share of the frames in which the target does not look as before


@dataclass(slots=True)
class RunningNormal:
    """A running normal distribution. weight: number of observations that the start is worth."""

    mean: float
    std: float
    weight: float
    limit: float

    def add(self, value: float, count: float = 1.0) -> None:
        """Add an observation, or the share ``count`` of one."""
        self.weight = min(self.weight + count, self.limit)
        gain = count / self.weight
        step = value - self.mean
        self.mean += gain * step
        self.std = float(np.sqrt(max((1.0 - gain) * (self.std**2 + gain * step * step), 1e-6)))


class TemplateMemory:
    """Templates of one target, the first of which is never forgotten."""

    def __init__(self, whitening: Whitening | None = None) -> None:
        """whitening: for similarities between whitened vectors; ``scan``, which has none, is of the others."""
        self._whitening = whitening
        self._templates: list[Features] = []
        self._used: list[int] = []
        self._count = 0
        # Before anything was seen: a target changes by about a tenth from frame to frame.
        self._target = RunningNormal(0.8, 0.15, 4.0, 60.0)
        self._background = RunningNormal(0.2, 0.2, 2.0, 200.0)
        self._rival = RunningNormal(0.4, 0.1, 1.0, 6.0)
        self._spectra: dict[tuple[int, int, int], npt.NDArray[np.complex64]] = {}
        self._tail = np.zeros(_TAIL_BINS)
        self._places = _PLACES

    def add(self, image: Image, box: OrientedBox) -> None:
        """Consider the box as a new template."""
        new = self._vectors(image, [box])[0]
        if self._templates:
            similarity = np.array([float(t @ new) for t in self._templates])
            if similarity.max() > _NEW_BELOW or not self.agrees(float(similarity[0])):
                return
        self._templates.append(new)
        self._used.append(self._count)
        self._spectra.clear()
        if len(self._templates) > _MAX_TEMPLATES:
            oldest = 1 + int(np.argmin(self._used[1:]))
            del self._templates[oldest], self._used[oldest]

    def agrees(self, first_score: float) -> bool:
        """Whether a box is more like the first view, by its ``first_score``, than anything beside the target is."""
        return first_score > self._rival.mean + self._rival.std

    def score(self, image: Image, box: OrientedBox) -> float:
        """Similarity (-1 to 1) of the box to the most similar template."""
        return float(self.scores(image, [box])[0])

    def scores(self, image: Image, boxes: list[OrientedBox]) -> Floats:
        """Similarities (n,) of boxes to the most similar template; the best box's template counts as used."""
        self._count += 1
        similarity = np.array(self._templates) @ self._vectors(image, boxes).T
        self._used[int(similarity.max(axis=1).argmax())] = self._count
        return np.asarray(similarity.max(axis=0), np.float64)

    def first_scores(self, image: Image, boxes: list[OrientedBox]) -> Floats:
        """Similarities (n,) of boxes to the first template."""
        return np.asarray(self._vectors(image, boxes) @ self._templates[0], np.float64)

    def _vectors(self, image: Image, boxes: list[OrientedBox]) -> Features:
        found = vectors(image, boxes)
        return found if self._whitening is None else self._whitening.of(found)

    def scan(self, features: Features) -> Floats:
        """Scores (h - 5, w - 5) of all boxes of 6x6 cells of a feature map (12, h, w)."""
        planes = weighted(features)
        rows, columns = planes.shape[1:]
        shape = (scipy.fft.next_fast_len(rows, True), scipy.fft.next_fast_len(columns, True))
        valid = (slice(0, rows - CELLS + 1), slice(0, columns - CELLS + 1))
        anchor = (0, 0)
        mean = np.stack([cv2.boxFilter(plane, -1, (CELLS, CELLS), anchor=anchor) for plane in planes])[:, *valid]
        square = cv2.boxFilter(np.square(planes).sum(axis=0), -1, (CELLS, CELLS), anchor=anchor)[valid] * CELLS**2
        # A block without the share c of its mean m has the energy sum(b²) - (2 c - c²) n m².
        share = CENTRED * (2.0 - CENTRED)
        norm = np.sqrt(np.maximum(square - share * CELLS**2 * np.square(mean).sum(axis=0), 1e-6))
        spectrum = scipy.fft.rfft2(planes, s=shape)
        best = np.full(norm.shape, -1.0)
        for template in self._scanned():
            product = (spectrum * self._spectrum(template, shape)).sum(axis=0)
            raw = scipy.fft.irfft2(product, s=shape)[valid]
            sums = template.reshape(len(features), -1).sum(axis=1)
            raw = raw - CENTRED * np.tensordot(sums, mean, 1)
            np.maximum(best, raw / norm, out=best)
        return best

    def _spectrum(self, template: Features, shape: tuple[int, int]) -> npt.NDArray[np.complex64]:
        """Conjugate spectrum of a template's planes, padded to ``shape``; kept, for regions of few shapes recur."""
        key = (id(template), *shape)
        if key not in self._spectra:
            cells = template.reshape(-1, CELLS, CELLS)
            self._spectra[key] = np.asarray(np.conj(scipy.fft.rfft2(cells, s=shape)), np.complex64)
        return self._spectra[key]

    def _scanned(self) -> list[Features]:
        """The first template and those that matched last."""
        order = sorted(range(1, len(self._templates)), key=lambda k: -self._used[k])[: _MAX_SCANNED - 1]
        return [self._templates[0], *(self._templates[k] for k in order)]

    def log_ratio(self, score: float, change: float = 0.0, other: float = 0.0) -> float:
        """log p(score | target) - log p(score | background), natural.

        change: std of what the score of a target that has been away may have changed. other: log likelihood ratio of
        another cue; half of the look-alikes have it too.
        """
        t, b = self._target, self._background
        std = float(np.hypot(t.std, change))
        target = -0.5 * (min(score - t.mean, 0.0) / std) ** 2 - np.log(std)
        background = -0.5 * (max(score - b.mean, 0.0) / b.std) ** 2 - np.log(b.std)
        # Something that looks like the target may stand anywhere, however unlike it the rest of the background is.
        k = min(int(max(score, 0.0) * _TAIL_BINS), _TAIL_BINS - 1)
        tail = (self._tail[k] + _LOOK_ALIKES / _TAIL_BINS) / (self._places + 1.0) * _TAIL_BINS
        tail = np.sqrt(2.0 * np.pi) * tail * 0.5 * (1.0 + np.exp(other))
        return float(target + other - np.logaddexp(background, np.log(tail)))

    def tracking_ratio(self, score: float) -> float:
        """log p(score | on the target) - log p(score | slipped off it), natural.

        What it has slipped on to is the most similar place beside it, or any other. Both have a wide tail: a target
        that turns away, and a place that looks like it, come without notice.
        """
        t, r, b = self._target, self._rival, self._background
        on = (1.0 - CHANGED) * _density(min(score - t.mean, 0.0), max(t.std, _MIN_STD)) + CHANGED
        rival = _density(score - r.mean, max(r.std, _MIN_STD))
        other = _density(max(score - b.mean, 0.0), max(b.std, _MIN_STD))
        off = 0.95 * 0.5 * (rival + other) + 0.05
        return float(np.log(on / off))

    def observe_rival(self, score: float) -> None:
        """Learn what the most similar place beside the target scores."""
        self._rival.add(score)

    def confirm(self, score: float, probability: float) -> None:
        """Learn what the target scores; probability: that this is it."""
        self._target.add(score, probability)

    def observe_background(self, scores: Floats, places: float) -> None:
        """Learn what places beside the target score. scores: (n,) of the best; places: number of boxes searched."""
        if not scores.size:
            return
        b = self._background
        b.add(float(scores.mean()))
        b.std = 0.9 * b.std + 0.1 * max(float(scores.std()), 0.05)  # the spread over places, not that of their mean
        np.add.at(self._tail, np.clip((scores * _TAIL_BINS).astype(int), 0, _TAIL_BINS - 1), 1.0)
        self._places += places


def _density(deviation: float, std: float) -> float:
    return float(np.exp(-0.5 * (deviation / std) ** 2) / (std * np.sqrt(2.0 * np.pi)))
