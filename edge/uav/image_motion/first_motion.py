"""How the target moves at first, also where its first box shows more than it: ground, or a tree that stands before it.

A tracker that learns all of that box may stay with what stands. What moves comes apart from it: cells of the first view
are found again where the target has gone, and not where the scene has them. Of the velocities at which that can be, the
evidence of a few images is added up, as in track-before-detect.
"""

from __future__ import annotations

import cv2
import numpy as np

from edge.uav.correlation.features import Features, cell_features
from edge.uav.correlation.oriented_box import OrientedBox, crop
from edge.uav.correlation.template import CELL_PX, CELLS
from protocols.geometry.types import Floats, Image

_LOOKS_S, _LAST_S = 0.2, 1.2  # between two looks; the last one: later, the target has turned or is covered
_FASTEST, _STEPS = 2.5, 41  # of the velocities that are tried, in box sides a second
_NOISE = 0.02  # difference of a cell's features that noise makes
_APART = 0.45  # between two places that are not the same one, in box sides
# Evidence of a velocity, in cells that fit it alone, and over that of any other. Places that pass in 100 rendered
# flights, half of them with a tree in the first box, within 0.3 sides: 274 of 279; those with less evidence, 25 of 29.
_LEAST, _MARGIN = 0.5, 1.3


class FirstMotion:
    """Of the target that the first ``image`` shows in ``box``."""

    def __init__(self, image: Image, box: OrientedBox) -> None:
        self._first = _cells(image, box, CELLS)
        self._ended = False
        self._looks = 0
        self._velocities = np.meshgrid(*[np.linspace(-_FASTEST, _FASTEST, _STEPS)] * 2)
        self._evidence: Floats = np.zeros((_STEPS, _STEPS))

    def look(self, image: Image, seconds: float, scene: OrientedBox) -> tuple[OrientedBox, Floats] | None:
        """Where the target is, ``seconds`` after the first image, and its velocity (2,) over the scene [px/s].

        scene: where the scene is now that the first box showed. None where no velocity explains what was seen, or more
        than one does.
        """
        if self._ended or not _LOOKS_S * (self._looks + 1) <= seconds + 1e-6 <= _LAST_S + 2e-6:
            return None
        self._looks += 1
        now, own = _cells(image, scene, 3 * CELLS), slice(CELLS, 2 * CELLS)
        stays = np.abs(now[:, own, own] - self._first).mean(axis=0)
        places = np.lib.stride_tricks.sliding_window_view(now, (CELLS, CELLS), axis=(1, 2))
        moves = np.abs(places - self._first[:, None, None]).mean(axis=0)
        fits = np.maximum(stays - moves - _NOISE, 0.0).sum(axis=(2, 3))
        x, y = (np.asarray(CELLS * (v * seconds + 1.0), np.float32) for v in self._velocities)
        unknown = float(np.median(fits))  # beyond the region
        self._evidence += cv2.remap(fits, x, y, cv2.INTER_LINEAR, None, cv2.BORDER_CONSTANT, unknown)
        best = int(self._evidence.argmax())
        velocity = np.array([v.flat[best] for v in self._velocities])
        if np.abs(velocity).max() * seconds > 1.0 - 1.0 / CELLS:
            self._ended = True  # it leaves the region, in which something slower would fit better from now on
            return None
        apart = np.hypot(*(v - v.flat[best] for v in self._velocities)) * seconds > _APART
        least = max(_LEAST * self._looks, _MARGIN * float(self._evidence[apart].max(initial=0.0)))
        if self._evidence.flat[best] < least:
            return None
        step = scene.axes @ (scene.sides * velocity)
        return scene.at(scene.centre + seconds * step), step


def _cells(image: Image, box: OrientedBox, count: int) -> Features:
    """Features (12, count, count) about a box that is 6 cells wide and high."""
    side = (count + 2) * CELL_PX
    return cell_features(crop(image, box.sized(box.sides * (count + 2) / CELLS), (side, side)), CELL_PX)[:, 1:-1, 1:-1]
