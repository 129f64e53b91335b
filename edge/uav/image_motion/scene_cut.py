"""Cuts of an edited video: from one image to the next the scene is another one.

What was tracked before has no place there; motion, appearance and ground go on as if the camera had jumped.
"""

from __future__ import annotations

from functools import cached_property

import cv2
import numpy as np

from protocols.geometry.types import Floats, Image

_CELLS = 32, 24  # across and down: a flight moves by less than one from image to image
_SMOOTH = 4.0  # cells: scenes share light sky over dark ground, so what varies slower is left out
_ALIKE = 0.6  # correlation of what is left: 0.7 or more from image to image, at most 0.5 of unrelated ones
_WIDTH = 640  # px: of the image whose features are compared
_FEATURES, _TEXTURED = 500, 100  # of an image: at most, and least that can tell scenes apart
_COMMON = 15
"""Features that agree on one similarity: of unrelated images of roads, coast and rooms 4 to 11 of 500 do by chance, of
a flight's 20 frames apart 24 or more."""
_ZOOM = 4.0  # ORB's pyramid reaches as far
_REACH = 4.0  # px of the compared image
_LOOK_EVERY = 5  # frames: after a cut, whether the scene of before is back


class SceneCut:
    """Tells frame by frame whether the scene is another one than in the first image."""

    def __init__(self, image: Image) -> None:
        self._scene, self._other = _View(image), _View(image)
        self._frames_since = -1  # of the other scene; -1 while there is none

    def update(self, image: Image) -> bool:
        """Whether the image (H, W, 3) shows another scene; known from the second image after a cut on.

        A scene counts as another one when its images have features in common with each other, and none with the last
        image of before: blur, darkness and noise hide features, and are no cut.
        """
        view = _View(image)
        if self._frames_since >= 0:
            self._frames_since += 1
            if self._frames_since % _LOOK_EVERY == 0 and _in_common(self._scene, view):
                self._scene, self._frames_since = view, -1
            return self._frames_since >= 0
        common = True if _correlation(self._scene, view) > _ALIKE else _in_common(self._scene, view)
        if common is None and self._scene.textured:
            return False  # a dark or blurred image between two that show something
        if common is False and _in_common(self._other, view):
            self._frames_since = 0
            return True
        if common is not False or _correlation(self._other, view) > _ALIKE:
            self._scene = view
        self._other = view
        return False


class _View:
    """An image with what is compared of it."""

    def __init__(self, image: Image) -> None:
        self._image = image
        step = max(image.shape[1] // (4 * _CELLS[0]), 1)
        cells = cv2.resize(image[::step, ::step], _CELLS, interpolation=cv2.INTER_AREA).astype(np.float64)
        means = cells.mean(axis=2)
        self.cells: Floats = means - np.asarray(cv2.GaussianBlur(means, (0, 0), _SMOOTH))

    @property
    def textured(self) -> bool:
        return len(self.features[0]) >= _TEXTURED

    @cached_property
    def features(self) -> tuple[Floats, Image]:
        """ORB's places (n, 2) [px] and descriptors (n, 32)."""
        gray = cv2.cvtColor(self._image, cv2.COLOR_BGR2GRAY)
        scale = _WIDTH / gray.shape[1]
        if scale < 1.0:
            gray = cv2.resize(gray, None, fx=scale, fy=scale, interpolation=cv2.INTER_AREA)
        points, descriptors = cv2.ORB.create(_FEATURES).detectAndCompute(gray, None)
        places = np.array([point.pt for point in points], np.float64).reshape(-1, 2)
        return places, np.zeros((0, 32), np.uint8) if descriptors is None else np.asarray(descriptors, np.uint8)


def _correlation(first: _View, second: _View) -> float:
    norm = float(np.linalg.norm(first.cells) * np.linalg.norm(second.cells))
    return float((first.cells * second.cells).sum()) / norm if norm > 0.0 else 0.0


def _in_common(first: _View, second: _View) -> bool | None:
    """Whether two images show one scene, moved in any way; None where one of them shows too little."""
    if not (first.textured and second.textured):
        return None
    (old, described), (new, other) = first.features, second.features
    pairs = cv2.BFMatcher(cv2.NORM_HAMMING, crossCheck=True).match(described, other)
    if len(pairs) < _COMMON:
        return False
    begin, end = old[[pair.queryIdx for pair in pairs]], new[[pair.trainIdx for pair in pairs]]
    similarity, agree = cv2.estimateAffinePartial2D(begin, end, ransacReprojThreshold=_REACH)
    if similarity is None or int(agree.sum()) < _COMMON:
        return False
    return 1.0 / _ZOOM < float(np.hypot(*similarity[:, 0])) < _ZOOM  # else all of one image is a spot in the other
