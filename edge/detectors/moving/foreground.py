"""What is not background: a model of every pixel's values, light that changes, ghosts and jolts.

The model is OpenCV's mixture of Gaussians (MOG2) or its k nearest neighbours (KNN). It is asked with every frame and
taught with every few, from a picture in which what is being followed is replaced by what is behind it: so somebody who
stands still does not sink into the background.
"""

from __future__ import annotations

import math
from collections import deque
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Literal

import cv2
import numpy as np
import numpy.typing as npt

from edge.detectors.moving.bootstrap import Album, usual
from edge.detectors.moving.shadows import Shadows
from protocols.geometry.types import Bools, Floats

Image = npt.NDArray[np.uint8]
Box = tuple[float, float, float, float]
ModelName = Literal["mog2", "knn"]

_TEACH_S = 0.4  # the model learns this often
_MEMORY_S = 30.0  # and forgets over that time
_BEGIN_S = 0.7  # in which a new model learns fast, and after which it begins again from what stood still
_REVIEWS_S = (_BEGIN_S, 1.0, 1.5, 2.0, 2.5, 3.0, 4.0, 5.0, 6.0, 8.0, 12.0, 16.0, 24.0)
"""When that is done, each time better."""
_PAUSE_S = 2.0  # a longer time between two pictures is a pause, and tells nothing of their rate
_RENEWAL = 0.05  # share of the latest step in the period
_LESSONS = 8  # pictures of a review that the model is taught
_TAUGHT, _RATES = 0.8, (0.03, 0.2)  # as how much all pictures count together; limits of one
_PASSING = 40  # 8-bit steps
_JOLT = 0.4  # of the picture being foreground at once: the camera was pushed, or the light went on
_SUBSAMPLE = 8
_GAIN = (0.3, 3.3)
_EVEN_FIELD = 0.08  # a gain this far from 1 is not the same everywhere
_DIM_STEP = 11  # 8-bit steps, times the gain: a dim picture's noise is raised with it
_GHOST_STEP = 22  # 8-bit steps
_BESIDE, _LEAST_RIM = 0.04, 10  # of the height: how far beside a rim is looked; pixels of it
_FLUSHED_S, _CALM_S = 16.0, 0.4  # time in which those who were here at first are sought; in which nothing changed
_VOTES, _RIM_REACH, _LEFT = 0.12, 7, 1.6  # share of the picture's height in which rims tell; pixels; as _GHOSTLY
_GHOSTLY, _PLAIN = 1.4, 12.0  # times that it must stand out more in the background; 8-bit steps that it must there


@dataclass(frozen=True, slots=True, eq=False)
class Layers:
    """One frame's pixels. figure: 255 where something stands before the background, 0 elsewhere, (H, W).

    shadow: the same where only light is missing. background: what stands behind, (H, W, 3), under today's light.
    fresh: the model has begun anew with this frame, or is still learning: nothing can be told.
    """

    figure: Image
    shadow: Image
    background: Image
    fresh: bool


class Foreground:
    """The background of one fixed camera.

    model: mog2 or knn. fps: of the pictures that come, as far as known.
    ``jolts`` counts how often everything had to be learnt anew.
    """

    def __init__(self, model: ModelName = "mog2", fps: float = 25.0) -> None:
        self._name = model
        self._period = 1.0 / fps if fps > 0 and math.isfinite(fps) else 0.04
        self._steps = 0  # between pictures of known times
        self._time: float | None = None
        self.jolts = 0
        self._begin()

    def _begin(self) -> None:
        if self._name == "mog2":
            mixture = cv2.createBackgroundSubtractorMOG2(500, 16.0, False)
            mixture.setBackgroundRatio(0.75)
            mixture.setVarInit(60.0)
            mixture.setVarMin(6.0)
            self._model: cv2.BackgroundSubtractor = mixture
        else:
            self._model = cv2.createBackgroundSubtractorKNN(500, 300.0, False)
        self._shadows = Shadows()
        self._seen = 0
        self._age = 0.0  # s since the first picture
        self._since = 0
        self._high = 0
        self._dimming = 1.0
        self._ghosts: Image | None = None
        self._ghostly: Image | None = None  # 255 where a ghost stands
        self._background: Image | None = None
        self._slow: npt.NDArray[np.float32] | None = None  # the background, in parts of a step
        self._album = Album()
        self._reviews = list(_REVIEWS_S)
        self._lately: deque[tuple[float, Image]] = deque()  # the pictures of the last moment, and when they were
        self._flushed_at = 0.0

    @property
    def young(self) -> bool:
        """Whether the background may still show who was here at first."""
        return bool(self._reviews)

    def prime(self, pictures: Sequence[Image]) -> None:
        """Learn from pictures spread over a longer time, so that what was here and there for a moment is not in it."""
        self._begin()
        if pictures:
            self._learn(pictures, usual(pictures))
            self._seen, self._age = 10**6, math.inf
            self._reviews = []

    def _learn(self, pictures: Sequence[Image], middle: Image) -> None:
        """Teach a new model with pictures of which ``middle`` is the background."""
        self._model.apply(middle, learningRate=1.0)
        rate = float(np.clip(_TAUGHT / len(pictures), *_RATES))
        for picture in pictures:
            # Whatever differs much from what is usual is passing.
            alike = cv2.inRange(cv2.absdiff(picture, middle), (0, 0, 0), (_PASSING,) * 3)
            self._model.apply(cv2.copyTo(picture, alike, middle.copy()), learningRate=rate)
        self._set_background(middle)

    def _set_background(self, picture: Image) -> None:
        self._background = picture
        self._slow = picture.astype(np.float32)

    def _review(self, even: Image) -> None:
        """A young model's picture has everybody in it who was there at first: keep some pictures, and start over."""
        self._album.add(even, self._period)
        if self._age < self._reviews[0]:
            return
        album, left, seen, age = self._album, self._reviews[1:], self._seen, self._age
        lately, flushed_at, shadows = self._lately, self._flushed_at, self._shadows
        self._begin()
        self._shadows = shadows
        self._learn(album.some(_LESSONS), album.background())
        self._seen, self._age, self._reviews = seen, age, left
        self._lately, self._flushed_at = lately, flushed_at
        self._album = album if left else Album()

    def look(self, image: Image, protected: Sequence[Box] = (), time_s: float | None = None) -> Layers:
        """Split a picture (H, W, 3) BGR. protected: x, y, w, h [px] of what must not be learnt.

        time_s: of the picture; None = one period after the last.
        """
        self._pass_time(time_s)
        return self._look(image, protected)

    def _pass_time(self, time_s: float | None) -> None:
        step = self._period
        if time_s is not None:
            if self._time is not None and 0.0 < time_s - self._time < _PAUSE_S:
                step = time_s - self._time
                self._steps += 1
                self._period += max(1.0 / self._steps, _RENEWAL) * (step - self._period)
            self._time = time_s
        self._age += step

    def _look(self, image: Image, protected: Sequence[Box]) -> Layers:
        if self._background is not None and self._background.shape != image.shape:
            self._begin()
        if self._background is None:
            self._model.apply(image, learningRate=1.0)
            self._set_background(image.copy())
            assert self._background is not None
            self._seen, self._age = 1, 0.0
            nothing = np.zeros(image.shape[:2], np.uint8)
            return Layers(nothing, nothing, self._background, True)
        even = self._even(image)
        figure = np.asarray(self._model.apply(even, learningRate=0.0), dtype=np.uint8)
        if self._dimming > 1.0 + _EVEN_FIELD:
            step = _DIM_STEP * self._dimming
            quiet = cv2.inRange(cv2.absdiff(even, self._background), (0, 0, 0), (step, step, step))
            figure = np.asarray(cv2.subtract(figure, quiet), dtype=np.uint8)
        self._seen += 1
        learning = self._age < _BEGIN_S
        if self._jolted(figure):
            self._begin()
            self.jolts += 1
            return self._look(image, ())
        figure = self._without_ghosts(even, figure)
        if self._reviews and self._age < _FLUSHED_S:
            figure = self._flushed(even, figure)
        else:
            self._lately.clear()
        shadow = np.zeros_like(figure) if learning else self._shadows.find(even, self._background, figure)
        self._teach(even, figure, protected, learning)
        young = len(self._reviews) == len(_REVIEWS_S)
        if self._reviews:
            self._review(even)
        return Layers(np.asarray(cv2.subtract(figure, shadow), dtype=np.uint8), shadow, self._background, young)

    def _flushed(self, even: Image, figure: Image) -> Image:
        """The silhouettes without the places that those who were here at first have left; they are background now.

        A silhouette may be both, somebody and the place that he came from: every part of it is judged by the rim near
        it, and is a place that was left where nothing has changed lately.
        """
        assert self._background is not None
        self._lately.append((self._age, even.copy()))
        while len(self._lately) > 2 and self._lately[1][0] <= self._age - _CALM_S:
            self._lately.popleft()
        if self._age - self._lately[0][0] < _CALM_S or self._age - self._flushed_at < 0.5 * _CALM_S:
            return figure
        self._flushed_at = self._age
        calm = cv2.inRange(cv2.absdiff(even, self._lately[0][1]), (0, 0, 0), (_GHOST_STEP,) * 3)
        places = cv2.bitwise_and(places_left(even, self._background, figure), figure)
        left = np.asarray(cv2.bitwise_and(places, calm), dtype=np.uint8)
        if not cv2.countNonZero(left):
            return figure
        if self._ghosts is None or self._ghostly is None:
            self._ghosts, self._ghostly = even.copy(), np.zeros(figure.shape, np.uint8)
        self._ghosts = np.asarray(cv2.copyTo(even, left, self._ghosts), dtype=np.uint8)
        self._ghostly = np.asarray(cv2.bitwise_or(self._ghostly, left), dtype=np.uint8)
        # The next review must not bring them back.
        self._album.paint(even, left)
        return np.asarray(cv2.subtract(figure, left), dtype=np.uint8)

    def haunt(self, image: Image, box: Box) -> None:
        """Take what stands in a box for background from now on: it is a place from which something has gone."""
        rows, columns = _slices(box, image.shape)
        if self._ghosts is None or self._ghostly is None:
            self._ghosts, self._ghostly = image.copy(), np.zeros(image.shape[:2], np.uint8)
        self._ghosts[rows, columns] = self._even(image)[rows, columns]
        self._ghostly[rows, columns] = 255

    def _even(self, image: Image) -> Image:
        """The picture in the background's light, from what most of the picture says.

        One gain a channel; where it is far from 1, also its slow change over the picture: cameras that change their
        exposure do not treat bright and dark parts, or middle and corners, alike.
        """
        assert self._background is not None
        self._dimming = 1.0
        now = image[::_SUBSAMPLE, ::_SUBSAMPLE].astype(np.float32)
        then = self._background[::_SUBSAMPLE, ::_SUBSAMPLE].astype(np.float32)
        usable = np.asarray(((now > 8) & (now < 245) & (then > 8) & (then < 245)).all(axis=2), dtype=np.bool_)
        if usable.sum() < 50:
            return image
        ratio = then[usable] / now[usable]
        gain = np.clip(np.median(ratio, axis=0), *_GAIN)
        if np.abs(gain - 1.0).max() < 0.012:
            return image
        table = np.clip(np.rint(np.arange(256)[:, None] * gain), 0, 255).astype(np.uint8)[None]
        even = np.asarray(cv2.LUT(image, table), dtype=np.uint8)
        self._dimming = max(float(gain.max()), 1.0)
        if np.abs(gain - 1.0).max() < _EVEN_FIELD:
            return even
        left = np.log(ratio.mean(axis=1)) - math.log(float(gain.mean()))
        field = _slow_field(usable, left, (image.shape[1], image.shape[0]))
        return np.asarray(cv2.multiply(even, cv2.merge([field] * 3), dtype=cv2.CV_8U), dtype=np.uint8)

    def _jolted(self, figure: Image) -> bool:
        if cv2.countNonZero(figure[::4, ::4]) * 16 <= _JOLT * figure.size:
            self._high = 0
            return False
        self._high += 1
        return self._high >= 2  # one frame may be a flash

    def _without_ghosts(self, even: Image, figure: Image) -> Image:
        if self._ghosts is None or self._ghostly is None:
            return figure
        return without_like(figure, even, self._ghosts, self._ghostly)

    def _teach(self, even: Image, figure: Image, protected: Sequence[Box], learning: bool) -> None:
        assert self._background is not None
        assert self._slow is not None
        self._since += 1
        every = max(round(_TEACH_S / self._period), 1)
        if not learning and self._since < every:
            return
        lesson = even
        if protected and not learning:
            lesson = even.copy()
            for box in protected:
                rows, columns = _slices(box, even.shape)
                lesson[rows, columns] = self._background[rows, columns]
        rate = max(1.0 / self._seen, 0.02) if learning else self._since * self._period / _MEMORY_S
        self._model.apply(lesson, learningRate=min(rate, 0.5))
        # The model's own picture mixes what it has seen; this one only takes what the model calls background.
        kept = np.full(figure.shape, 255, np.uint8) if self._age < _BEGIN_S else cv2.bitwise_not(figure)
        cv2.accumulateWeighted(lesson, self._slow, min(max(rate, 0.02), 0.5), kept)
        self._background = np.asarray(cv2.convertScaleAbs(self._slow), dtype=np.uint8)
        self._since = 0


def without_like(figure: Image, now: Image, then: Image, where: Image) -> Image:
    """A silhouette picture (H, W) 0/255 with 0 wherever ``where`` is 255 and two pictures (H, W, 3) are alike."""
    step = _GHOST_STEP - 1
    like = cv2.inRange(cv2.absdiff(now, then), (0, 0, 0), (step, step, step))
    return np.asarray(cv2.bitwise_and(figure, cv2.bitwise_not(cv2.bitwise_and(like, where))), dtype=np.uint8)


def _slow_field(usable: Bools, left: Floats, size: tuple[int, int]) -> npt.NDArray[np.float32]:
    """A gain for every pixel of a picture (width, height), of second order in the place.

    left: (n,) logarithms of the gains that are left at the pixels of a coarse grid which are ``usable``. What stands
    before the background is outvoted.
    """
    y, x = np.nonzero(usable)
    across, down = 2.0 * x / usable.shape[1] - 1.0, 2.0 * y / usable.shape[0] - 1.0
    terms = np.stack([np.ones_like(across), across, down, across**2, across * down, down**2], axis=1)
    found = np.zeros(6)
    scale = 0.25
    for _ in range(8):
        weight = 1.0 / (1.0 + ((left - terms @ found) / scale) ** 2) ** 2
        found = np.linalg.solve((terms * weight[:, None]).T @ terms + 1e-3 * np.eye(6), terms.T @ (weight * left))
        scale = max(0.6 * scale, 0.04)
    u = 2.0 * np.arange(size[0]) / size[0] - 1.0
    v = (2.0 * np.arange(size[1]) / size[1] - 1.0)[:, None]
    log_gain = found[0] + found[1] * u + found[2] * v + found[3] * u * u + found[4] * u * v + found[5] * v * v
    return np.asarray(np.exp(log_gain), dtype=np.float32)


def _slices(box: Box, shape: tuple[int, ...]) -> tuple[slice, slice]:
    x, y, w, h = box
    left, top = max(math.floor(x), 0), max(math.floor(y), 0)
    return slice(top, min(math.ceil(y + h), shape[0])), slice(left, min(math.ceil(x + w), shape[1]))


def is_ghost(image: Image, background: Image, box: Box, figure: Image) -> bool:
    """Whether a silhouette is the place of something that has gone: it stands out from what is beside it in the
    background's picture, and less in this one."""
    x, y, w, h = box
    reach = 2 * int(np.clip(round(_BESIDE * h), 2, 15)) + 1
    rows, columns = _slices((x - reach, y - reach, w + 2 * reach, h + 2 * reach), image.shape)
    mask = figure[rows, columns]
    if mask.size == 0:
        return False
    rim = cv2.morphologyEx(mask, cv2.MORPH_GRADIENT, np.ones((3, 3), np.uint8)) > 0
    # Other silhouettes near have rims of their own.
    inner = np.zeros(mask.shape, dtype=np.bool_)
    top, left = max(math.floor(y), 0) - rows.start, max(math.floor(x), 0) - columns.start
    inner[top : top + math.ceil(h) + 1, left : left + math.ceil(w) + 1] = True
    rim &= inner
    if rim.sum() < _LEAST_RIM:
        return False
    before, now = (_stands_out(one[rows, columns], mask, reach)[rim] for one in (background, image))
    return bool(np.median(before) > _GHOSTLY * np.median(now) and np.median(before) > _PLAIN)


def places_left(image: Image, background: Image, figure: Image) -> Image:
    """Where (H, W) 0/255 a silhouette picture shows what was in the background's picture, not what is in this one.

    As ``is_ghost``, of every part by the rims near it. At half the resolution.
    """
    found = np.zeros_like(figure)
    x, y, w, h = cv2.boundingRect(figure)
    if w < _RIM_REACH or h < _RIM_REACH:
        return found
    wide = (2 * max(round(_VOTES * figure.shape[0] / 4), 2) + 1,) * 2
    rows, columns = _slices((x - _RIM_REACH, y - _RIM_REACH, w + 2 * _RIM_REACH, h + 2 * _RIM_REACH), figure.shape)
    figure, image, background = figure[rows, columns], image[rows, columns], background[rows, columns]
    height, width = figure.shape
    size = (width + 1) // 2, (height + 1) // 2
    mask = np.asarray(cv2.medianBlur(cv2.resize(figure, size, interpolation=cv2.INTER_NEAREST), 5), dtype=np.uint8)
    rim = cv2.morphologyEx(mask, cv2.MORPH_GRADIENT, np.ones((3, 3), np.uint8)).astype(np.float32) / 255.0
    smaller = (
        np.asarray(cv2.resize(one, size, interpolation=cv2.INTER_AREA), dtype=np.uint8) for one in (background, image)
    )
    before, now = (cv2.boxFilter(rim * _stands_out(one, mask, _RIM_REACH), -1, wide) for one in smaller)
    plain = _PLAIN * cv2.boxFilter(rim, -1, wide)
    left = np.where((before > _LEFT * now) & (before > plain), mask, 0).astype(np.uint8)
    found[rows, columns] = cv2.resize(left, (width, height), interpolation=cv2.INTER_NEAREST)
    return found


def _stands_out(part: Image, mask: Image, reach: int) -> npt.NDArray[np.float32]:
    """By how much (h, w) colours (h, w, 3) near each pixel differ inside and outside a mask (h, w) 0/255."""
    size = (reach, reach)

    def mean(where: Image) -> npt.NDArray[np.float32]:
        total = cv2.boxFilter(cv2.bitwise_and(part, part, mask=where), cv2.CV_32F, size, normalize=False)
        count = cv2.boxFilter(where, cv2.CV_32F, size, normalize=False) / np.float32(255.0)
        return np.asarray(cv2.divide(total, cv2.merge([np.maximum(count, np.float32(1.0))] * 3)), dtype=np.float32)

    blue, green, red = cv2.split(cv2.absdiff(mean(mask), mean(np.asarray(cv2.bitwise_not(mask), dtype=np.uint8))))
    return np.asarray(cv2.max(cv2.max(blue, green), red), dtype=np.float32)
