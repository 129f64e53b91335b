"""Colour of the target against that of its surroundings: it tells look-alikes apart, from whatever side they are seen.

The mean over the inner part of a box in CIE L*a*b*: gradients of things of one kind are alike, their paint is not.
"""

from __future__ import annotations

import cv2
import numpy as np

from edge.uav.correlation.oriented_box import OrientedBox, crop
from protocols.geometry.types import Floats, Image

_INNER, _SIDE = 0.5, 8  # of a box's sides, for its corners show background; side of the resampled part [px]
# Std of the same thing's colour from view to view [8-bit levels of L*, a*, b*]; rendered targets of less than 8 px, of
# 8 to 12 and of 12 to 20 px: (4.0, 3.1, 2.5), (7.6, 2.5, 2.4), (3.5, 1.5, 1.5).
_NOISE = np.array([6.0, 2.4, 2.4])
_BROAD = np.array([40.0, 16.0, 16.0])  # and of whatever else there may be
_LEARNING = 0.05  # share of a new observation
_GREY = np.array([0.0, 128.0, 128.0])  # a* and b* of no colour, in 8 bits
_MOST_STEP = 2.0  # stds of a new observation from the mean, at most: it takes a second to become what is another colour
_BOUNDS = (-4.0, 2.0)  # of the log likelihood ratio: many things have the same colour


class ColourModel:
    """Mean and variance (2, 3) of the colour of one target, first seen in ``box``, and of its surroundings."""

    def __init__(self, image: Image, box: OrientedBox) -> None:
        colour = _mean(image, box)
        self._target, self._others = np.array([colour, 0.0 * _NOISE]), np.array([colour, _BROAD**2])

    def learn(self, image: Image, box: OrientedBox) -> None:
        """Learn from the target's box."""
        mean, spread = self._target
        # One look at something else, before it is noticed, must not make its colour the target's.
        most = _MOST_STEP * np.sqrt(spread + _NOISE**2) * [np.inf, 1.0, 1.0]  # a shadow may change its lightness
        self._target = _updated(self._target, np.clip(_mean(image, box), mean - most, mean + most))

    def observe(self, image: Image, boxes: list[OrientedBox]) -> None:
        """Learn from places beside the target."""
        for box in boxes:
            self._others = _updated(self._others, _mean(image, box))

    def log_ratio(self, image: Image, box: OrientedBox, *, in_any_light: bool = False) -> float:
        """log p(colour | target) - log p(colour | anything else), natural, bounded.

        in_any_light: by a* and b* as they were at the target's mean lightness: a shadow is no other paint.
        """
        colour, first, gain = _mean(image, box), 0, 1.0
        if in_any_light:
            first, gain = 1, float(self._target[0, 0] / max(colour[0], 1.0))
            colour = _GREY + gain * (colour - _GREY)
        noise = max(gain, 1.0) * _NOISE
        target, near, wide = (
            float(-0.5 * ((colour - mean) ** 2 / variance + np.log(variance))[first:].sum())
            for (mean, spread), floor in ((self._target, noise), (self._others, noise), (self._others, _BROAD))
            for variance in [spread + floor**2]
        )
        return float(np.clip(target - np.logaddexp(near, wide) + np.log(2.0), *_BOUNDS))


def _updated(moments: Floats, colour: Floats) -> Floats:
    step = colour - moments[0]
    return np.array([moments[0] + _LEARNING * step, (1.0 - _LEARNING) * (moments[1] + _LEARNING * step**2)])


def _mean(image: Image, box: OrientedBox) -> Floats:
    patch = crop(image, box.sized(_INNER * box.sides), (_SIDE, _SIDE))
    return np.asarray(cv2.cvtColor(patch, cv2.COLOR_BGR2LAB).mean(axis=(0, 1)), np.float64)
