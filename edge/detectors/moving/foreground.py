"""Background subtraction for a fixed camera: changes of light, ghosts, and moves of the camera.

The model is OpenCV's mixture of Gaussians (MOG2) or its k nearest neighbours (KNN). It is evaluated at every frame and
updated every few frames, with an image in which tracked objects are replaced by the background: a person who stands
still is not absorbed into the background.
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

from edge.detectors.moving.bootstrap import BackgroundBootstrap, background_mode
from edge.detectors.moving.shadows import GHOST_STEP, Box, ShadowDetector, remove_ghosts, slices, uncovered_background
from protocols.geometry.types import Bools, Floats, Image

SubtractorName = Literal["mog2", "knn"]

_UPDATE_S = 0.4  # time between updates of the model
_MEMORY_S = 30.0  # time constant of its updates
_INITIAL_S = 0.7  # time in which a new model learns fast, until the first bootstrap
_BOOTSTRAP_S = (_INITIAL_S, 1.0, 1.5, 2.0, 2.5, 3.0, 4.0, 5.0, 6.0, 8.0, 12.0, 16.0, 24.0)
"""Times at which the background is bootstrapped, each time from more images."""
_PAUSE_S = 2.0  # a longer time between two images is a pause and does not count for the frame period
_PERIOD_GAIN = 0.05  # gain of the estimate of the frame period
_BOOTSTRAP_UPDATES = 8  # images of a bootstrap that the model is updated with
_BOOTSTRAP_WEIGHT, _BOOTSTRAP_RATES = 0.8, (0.03, 0.2)  # total weight of these images; limits of the rate of one
_SWAY, _SWAY_STEP = 0.004, 8
"""Over the image width: displacement of swaying leaves; 8-bit steps of noise about the colours beside a pixel."""
_PASSING_STEP = 40  # 8-bit steps
_SCENE_CHANGE_SHARE = 0.4  # share of foreground pixels at which the camera has moved or the light has changed
_SUBSAMPLE = 8  # px: a gain of the exposure is the same everywhere
_GAIN = (0.3, 3.3)  # of the exposure between two images; beyond, it is another scene
_UNIFORM_GAIN = 0.08  # deviation of a gain from 1 above which it varies over the image
_NOISE_STEP = 11  # 8-bit steps, times the gain, which amplifies the noise of a dim image
# time after the start in which ghosts of the first objects are searched; time without change
_INITIAL_GHOSTS_S, _STILL_S = 16.0, 0.4


@dataclass(frozen=True, slots=True, eq=False)
class ForegroundMasks:
    """Segmentation of one frame. foreground: 255 where an object is before the background, 0 elsewhere, (H, W).

    shadow: the same where only light is missing. background: (H, W, 3), under the current light. initialising: the
    model has been reset at this frame or is still learning: the masks are not valid.
    """

    foreground: Image
    shadow: Image
    background: Image
    initialising: bool


class BackgroundSubtractor:
    """Background model of one fixed camera.

    model: mog2 or knn. fps: nominal frame rate. ``resets`` counts how often the model was reset.
    """

    def __init__(self, model: SubtractorName = "mog2", fps: float = 25.0) -> None:
        self._name = model
        self._period = 1.0 / fps if fps > 0 and math.isfinite(fps) else 0.04
        self._steps = 0  # number of frame periods measured
        self._time: float | None = None
        self.resets = 0
        self._reset()

    def _reset(self) -> None:
        if self._name == "mog2":
            mixture = cv2.createBackgroundSubtractorMOG2(500, 16.0, False)
            mixture.setBackgroundRatio(0.75)
            mixture.setVarInit(60.0)
            mixture.setVarMin(6.0)
            self._model: cv2.BackgroundSubtractor = mixture
        else:
            self._model = cv2.createBackgroundSubtractorKNN(500, 300.0, False)
        self._shadows = ShadowDetector()
        self._frames = 0
        self._age = 0.0  # s since the first image
        self._frames_since_update = 0
        self._changed_frames = 0
        self._gain = 1.0
        self._ghost_image: Image | None = None
        self._ghost_mask: Image | None = None  # 255 where there is a ghost
        self._background: Image | None = None
        self._background_range: tuple[Image, Image] | None = None  # of the colours around each pixel
        self._background_mean: npt.NDArray[np.float32] | None = None  # the background with fractions of 8-bit steps
        self._bootstrap = BackgroundBootstrap()
        self._pending_bootstraps = list(_BOOTSTRAP_S)
        self._recent: deque[tuple[float, Image]] = deque()  # recent images and their times
        self._ghosts_checked_at = 0.0

    @property
    def bootstrapping(self) -> bool:
        """Whether the background may still contain objects of the first images."""
        return bool(self._pending_bootstraps)

    def initialise(self, images: Sequence[Image]) -> None:
        """Learn from images spread over a longer time, so that passing objects are not in the background."""
        self._reset()
        if images:
            self._train(images, background_mode(images))
            self._frames, self._age = 10**6, math.inf
            self._pending_bootstraps = []

    def _train(self, images: Sequence[Image], middle: Image) -> None:
        """Train a new model with images of which ``middle`` is the background."""
        self._model.apply(middle, learningRate=1.0)
        rate = float(np.clip(_BOOTSTRAP_WEIGHT / len(images), *_BOOTSTRAP_RATES))
        for image in images:
            # Large differences from the background are passing objects.
            background_pixels = cv2.inRange(cv2.absdiff(image, middle), (0, 0, 0), (_PASSING_STEP,) * 3)
            self._model.apply(cv2.copyTo(image, background_pixels, middle.copy()), learningRate=rate)
        self._set_background(middle)

    def _set_background(self, image: Image) -> None:
        self._background, self._background_range = image, None
        self._background_mean = image.astype(np.float32)

    def _bootstrap_step(self, compensated: Image) -> None:
        """Store some images, and at fixed times train a new model from them: the first one contains objects of the
        first image.
        """
        self._bootstrap.add(compensated, self._period)
        if self._age < self._pending_bootstraps[0]:
            return
        bootstrap, left, seen, age = self._bootstrap, self._pending_bootstraps[1:], self._frames, self._age
        recent, ghosts_checked_at, shadows = self._recent, self._ghosts_checked_at, self._shadows
        self._reset()
        self._shadows = shadows
        self._train(bootstrap.sample(_BOOTSTRAP_UPDATES), bootstrap.background())
        self._frames, self._age, self._pending_bootstraps = seen, age, left
        self._recent, self._ghosts_checked_at = recent, ghosts_checked_at
        self._bootstrap = bootstrap if left else BackgroundBootstrap()

    def segment(self, image: Image, protected: Sequence[Box] = (), time_s: float | None = None) -> ForegroundMasks:
        """Segment an image (H, W, 3) BGR. protected: x, y, w, h [px] of objects that must not be learnt.

        time_s: time of the image [s]; None = one frame period after the last one.
        """
        self._advance_time(time_s)
        return self._segment(image, protected)

    def _advance_time(self, time_s: float | None) -> None:
        step = self._period
        if time_s is not None:
            if self._time is not None and 0.0 < time_s - self._time < _PAUSE_S:
                step = time_s - self._time
                self._steps += 1
                self._period += max(1.0 / self._steps, _PERIOD_GAIN) * (step - self._period)
            self._time = time_s
        self._age += step

    def _segment(self, image: Image, protected: Sequence[Box]) -> ForegroundMasks:
        if self._background is not None and self._background.shape != image.shape:
            self._reset()
        if self._background is None:
            self._model.apply(image, learningRate=1.0)
            self._set_background(image.copy())
            assert self._background is not None
            self._frames, self._age = 1, 0.0
            nothing = np.zeros(image.shape[:2], np.uint8)
            return ForegroundMasks(nothing, nothing, self._background, True)
        compensated = self._compensate_gain(image)
        foreground = np.asarray(self._model.apply(compensated, learningRate=0.0), dtype=np.uint8)
        if self._gain > 1.0 + _UNIFORM_GAIN:
            step = _NOISE_STEP * self._gain
            quiet = cv2.inRange(cv2.absdiff(compensated, self._background), (0, 0, 0), (step, step, step))
            foreground = np.asarray(cv2.subtract(foreground, quiet), dtype=np.uint8)
        self._frames += 1
        learning = self._age < _INITIAL_S
        if self._scene_changed(foreground):
            self._reset()
            self.resets += 1
            return self._segment(image, ())
        foreground = self._without_ghosts(compensated, self._without_moved_edges(compensated, foreground))
        if self._pending_bootstraps and self._age < _INITIAL_GHOSTS_S:
            foreground = self._without_initial_ghosts(compensated, foreground)
        else:
            self._recent.clear()
        shadow = (
            np.zeros_like(foreground) if learning else self._shadows.detect(compensated, self._background, foreground)
        )
        self._update_model(compensated, foreground, protected, learning)
        bootstrapping = len(self._pending_bootstraps) == len(_BOOTSTRAP_S)
        if self._pending_bootstraps:
            self._bootstrap_step(compensated)
        return ForegroundMasks(
            np.asarray(cv2.subtract(foreground, shadow), dtype=np.uint8), shadow, self._background, bootstrapping
        )

    def _without_initial_ghosts(self, compensated: Image, foreground: Image) -> Image:
        """Remove ghosts of objects of the first images from the mask; from now on they are background.

        One silhouette may be both an object and its ghost: every part of it is classified by the rim near it, and is a
        ghost only where the image has not changed recently.
        """
        assert self._background is not None
        self._recent.append((self._age, compensated.copy()))
        while len(self._recent) > 2 and self._recent[1][0] <= self._age - _STILL_S:
            self._recent.popleft()
        if self._age - self._recent[0][0] < _STILL_S or self._age - self._ghosts_checked_at < 0.5 * _STILL_S:
            return foreground
        self._ghosts_checked_at = self._age
        still = cv2.inRange(cv2.absdiff(compensated, self._recent[0][1]), (0, 0, 0), (GHOST_STEP,) * 3)
        places = cv2.bitwise_and(uncovered_background(compensated, self._background, foreground), foreground)
        left = np.asarray(cv2.bitwise_and(places, still), dtype=np.uint8)
        if not cv2.countNonZero(left):
            return foreground
        if self._ghost_image is None or self._ghost_mask is None:
            self._ghost_image, self._ghost_mask = compensated.copy(), np.zeros(foreground.shape, np.uint8)
        self._ghost_image = np.asarray(cv2.copyTo(compensated, left, self._ghost_image), dtype=np.uint8)
        self._ghost_mask = np.asarray(cv2.bitwise_or(self._ghost_mask, left), dtype=np.uint8)
        # The next bootstrap must not bring them back.
        self._bootstrap.overwrite(compensated, left)
        return np.asarray(cv2.subtract(foreground, left), dtype=np.uint8)

    def absorb_ghost(self, image: Image, box: Box) -> None:
        """Treat the content of a box as background from now on: it is a ghost."""
        rows, columns = slices(box, image.shape)
        if self._ghost_image is None or self._ghost_mask is None:
            self._ghost_image, self._ghost_mask = image.copy(), np.zeros(image.shape[:2], np.uint8)
        self._ghost_image[rows, columns] = self._compensate_gain(image)[rows, columns]
        self._ghost_mask[rows, columns] = 255

    def _compensate_gain(self, image: Image) -> Image:
        """The image in the light of the background, from the robust gain between them.

        One gain per channel; where it is far from 1, also a smooth variation over the image: cameras that change their
        exposure do not treat bright and dark parts, or centre and corners, equally.
        """
        assert self._background is not None
        self._gain = 1.0
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
        compensated = np.asarray(cv2.LUT(image, table), dtype=np.uint8)
        self._gain = max(float(gain.max()), 1.0)
        if np.abs(gain - 1.0).max() < _UNIFORM_GAIN:
            return compensated
        left = np.log(ratio.mean(axis=1)) - math.log(float(gain.mean()))
        field = _gain_field(usable, left, (image.shape[1], image.shape[0]))
        return np.asarray(cv2.multiply(compensated, cv2.merge([field] * 3), dtype=cv2.CV_8U), dtype=np.uint8)

    def _scene_changed(self, foreground: Image) -> bool:
        if cv2.countNonZero(foreground[::4, ::4]) * 16 <= _SCENE_CHANGE_SHARE * foreground.size:
            self._changed_frames = 0
            return False
        self._changed_frames += 1
        return self._changed_frames >= 2  # one frame may be a flash

    def _without_moved_edges(self, compensated: Image, foreground: Image) -> Image:
        """Remove thin structures with colours of the background beside them: leaves in the wind, a camera that shakes.

        A displaced edge leaves strips as wide as its displacement; bodies are broader.
        """
        assert self._background is not None
        x, y, w, h = cv2.boundingRect(foreground)
        if w == 0:
            return foreground
        part, size = (slice(y, y + h), slice(x, x + w)), 2 * round(_SWAY * foreground.shape[1]) + 3
        mask, box = foreground[part], np.ones((size, size), np.uint8)
        alone = cv2.subtract(mask, cv2.dilate(cv2.erode(mask, box), np.ones((3 * size, 3 * size), np.uint8)))
        if not cv2.countNonZero(alone):
            return foreground
        if self._background_range is None:
            low, high = cv2.erode(self._background, box), cv2.dilate(self._background, box)
            noise = np.full_like(self._background, _SWAY_STEP)
            darkest, brightest = cv2.subtract(low, noise), cv2.add(high, noise)
            self._background_range = np.asarray(darkest, dtype=np.uint8), np.asarray(brightest, dtype=np.uint8)
        moved = cv2.inRange(compensated[part], *(one[part] for one in self._background_range))
        kept = foreground.copy()
        kept[part] = cv2.subtract(mask, cv2.bitwise_and(moved, alone))
        return kept

    def _without_ghosts(self, compensated: Image, foreground: Image) -> Image:
        if self._ghost_image is None or self._ghost_mask is None:
            return foreground
        return remove_ghosts(foreground, compensated, self._ghost_image, self._ghost_mask)

    def _update_model(self, compensated: Image, foreground: Image, protected: Sequence[Box], learning: bool) -> None:
        assert self._background is not None
        assert self._background_mean is not None
        self._frames_since_update += 1
        every = max(round(_UPDATE_S / self._period), 1)
        if not learning and self._frames_since_update < every:
            return
        update_image = compensated
        if protected and not learning:
            update_image = compensated.copy()
            for box in protected:
                rows, columns = slices(box, compensated.shape)
                update_image[rows, columns] = self._background[rows, columns]
        rate = max(1.0 / self._frames, 0.02) if learning else self._frames_since_update * self._period / _MEMORY_S
        self._model.apply(update_image, learningRate=min(rate, 0.5))
        # OpenCV's background image mixes all modes; this one is updated by background pixels only.
        kept = np.full(foreground.shape, 255, np.uint8) if self._age < _INITIAL_S else cv2.bitwise_not(foreground)
        cv2.accumulateWeighted(update_image, self._background_mean, min(max(rate, 0.02), 0.5), kept)
        self._background = np.asarray(cv2.convertScaleAbs(self._background_mean), dtype=np.uint8)
        self._background_range = None
        self._frames_since_update = 0


def _gain_field(usable: Bools, left: Floats, size: tuple[int, int]) -> npt.NDArray[np.float32]:
    """A gain for every pixel of an image (width, height), of second order in position.

    left: (n,) logarithms of the residual gains at the ``usable`` pixels of a coarse grid. Foreground pixels are
    outliers of the robust fit.
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
