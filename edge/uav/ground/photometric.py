"""Photometric gain: brightness change of each channel since the first frame, from static ground points."""

from __future__ import annotations

import cv2
import numpy as np

from protocols.geometry import kernels
from protocols.geometry.order_statistics import median
from protocols.geometry.types import Floats, Image

_MAX_LOG_CHANGE = 0.3  # of the gain, per frame
_LEAK = 0.99  # of the log gain, per frame
_GAIN_LIMITS = (0.3, 3.0)  # 1.6 stops: beyond, eight bits no longer hold the colours
_MIN_POINTS = 12  # for an update
_TARGET_RATE = 0.8  # share of the target's measured change that is applied
_MAX_TARGET_CHANGE = 0.25  # of the log gain, per measurement
_MAX_TARGET_LOG_GAIN = 0.7  # half or twice the light
_TARGET_DECAY_S = 1.5  # time constant: longer ones keep a shadow that it has left, shorter ones forget it behind a tree
_NEGLIGIBLE_LOG_GAIN = 0.02  # five of 255 levels at most: not worth a new table
_EXTREMES = (0.02, 0.98)  # quantiles of the levels of the darkest and the lightest places
_FADE_S, _FADES = 2.0, 1.15  # a fade from black is over; growth of this distance by which it is one, not the view's
_CUT = 2.0  # growth from one image to the next: of no fade, but of an image that is damaged or of another scene
_FLAT, _SPAN, _MAX_FACTOR = 96.0, 160.0, 8.0  # distance of these that is too small; that it gets; limit of the factor


class PhotometricGain:
    """Gain (channels,) relative to the first frame."""

    def __init__(self, channels: int = 3) -> None:
        self.gain = np.ones(channels)
        self._previous: Image | None = None
        self._lookup_table: Image | None = None

    def update(self, working: Image, old: Floats, new: Floats) -> None:
        """Compare the same ground points in the last working image (``old``, (n, 2)) and in this one (``new``)."""
        if self._previous is not None and len(old) >= _MIN_POINTS:
            before, after = _blurred_colours(self._previous, old), _blurred_colours(working, new)
            usable = ((before > 8) & (after > 8) & (before < 247) & (after < 247)).all(axis=1)
            if int(usable.sum()) >= _MIN_POINTS:
                change = np.array([median(channel) for channel in np.log(after[usable] / before[usable]).T])
                change = np.clip(change, -_MAX_LOG_CHANGE, _MAX_LOG_CHANGE)
                # The colour models adapt meanwhile, and rounding errors must not accumulate: hence the leak.
                self.gain = np.clip(np.exp(_LEAK * np.log(self.gain) + change), *_GAIN_LIMITS)
                self._lookup_table = None
        self._previous = working.copy()

    def corrected(self, image: Image, log_gain: float = 0.0) -> Image:
        """The image (h, w, 3) with the gain removed. log_gain: additional gain to remove, natural logarithm."""
        if abs(log_gain) >= _NEGLIGIBLE_LOG_GAIN:
            table: Image | None = _lookup_table(self.gain * np.exp(log_gain))
        else:
            table = self.table
        return image if table is None else np.asarray(cv2.LUT(np.ascontiguousarray(image), table), np.uint8)

    @property
    def table(self) -> Image | None:
        """Lookup table (1, 256, channels) that removes the gain; None where there is none."""
        if np.abs(self.gain - 1.0).max() < 0.02:
            return None
        self._lookup_table = _lookup_table(self.gain) if self._lookup_table is None else self._lookup_table
        return self._lookup_table


class TargetGain:
    """Gain at the target relative to the image's, for example in a cloud's shadow that the car drives through.

    ``log_gain`` is the natural logarithm of the ratio, common to all channels since shadows are grey: a car of another
    colour remains distinguishable.
    """

    def __init__(self) -> None:
        self.log_gain = 0.0
        self._reference: float | None = None

    def set_reference(self, brightness: float) -> None:
        """Set the target's mean log brightness under the present gain."""
        self._reference = brightness

    def update(self, brightness: float) -> None:
        """Add the target's mean log brightness, measured with ``log_gain`` removed."""
        if self._reference is None:
            return
        change = float(np.clip(brightness - self._reference, -_MAX_TARGET_CHANGE, _MAX_TARGET_CHANGE))
        self.log_gain = float(
            np.clip(self.log_gain + _TARGET_RATE * change, -_MAX_TARGET_LOG_GAIN, _MAX_TARGET_LOG_GAIN)
        )

    def decay(self, dt: float) -> None:
        """Decay towards 0 while the target is not visible: its illumination may have changed."""
        self.log_gain *= float(np.exp(-dt / _TARGET_DECAY_S))


class Contrast:
    """Stretches faint images, so that noise and compression are small: at dusk and in haze a few tens of levels lie
    between the darkest and the lightest.

    image: the first one, (h, w, 3), at ``time`` [s], with the target in ``box`` (x, y, width, height) [px]. Images of
    one with contrast stay as they are, and those of a target that has it: cars on grey asphalt would lose their light
    parts. While a video fades in, what it lacks becomes less.
    """

    def __init__(self, image: Image, time: float, box: tuple[float, float, float, float] | None = None) -> None:
        self._fades_until = time + _FADE_S
        self.table: Image | None = None
        """Lookup table (1, 256); None where the first image has contrast."""
        darkest, lightest = of_all = _extremes(image[::4, ::4])
        if box is not None:
            x, y = max(int(box[0]), 0), max(int(box[1]), 0)
            ends = _extremes(image[y : int(box[1] + box[3]) + 1, x : int(box[0] + box[2]) + 1])
            darkest, lightest = min(darkest, ends[0]), max(lightest, ends[1])
        if lightest - darkest < _FLAT:
            self._stretch(darkest, lightest)
            self._span = max(of_all[1] - of_all[0], 1.0)  # where the target is in the next images is not known

    def stretched(self, image: Image, time: float) -> Image:
        """An image (h, w, 3) at ``time`` [s] with contrast."""
        if self.table is None:
            return image
        if time < self._fades_until:
            darkest, lightest = _extremes(image[::4, ::4])
            if _FADES < (lightest - darkest) / self._span < _CUT:
                self._stretch(darkest, lightest)
        return np.asarray(cv2.LUT(image, self.table), np.uint8)

    def _stretch(self, darkest: float, lightest: float) -> None:
        self._span = max(lightest - darkest, 1.0)
        factor = min(max(_SPAN / self._span, 1.0), _MAX_FACTOR)
        levels = (np.arange(256) - darkest) * factor + min(darkest, 255.0 - _SPAN)
        self.table = np.asarray(np.clip(np.rint(levels), 0, 255), np.uint8)[None]


def _extremes(image: Image) -> tuple[float, float]:
    darkest, lightest = np.quantile(image, _EXTREMES)
    return float(darkest), float(lightest)


def _lookup_table(gain: Floats) -> Image:
    levels = np.arange(256)[:, None] / gain
    return np.asarray(np.clip(np.rint(levels), 0, 255), np.uint8)[None]


def _blurred_colours(image: Image, points: Floats) -> Floats:
    """Colours (n, channels) at points (n, 2) of an image blurred over 5 x 5 px, bilinearly interpolated."""
    at, channels = points.astype(np.float32), image.size // (image.shape[0] * image.shape[1])
    if kernels.AVAILABLE:
        out = np.empty((len(points), channels))
        kernels.call("blurred_colours", len(points), at, *image.shape[:2], channels, np.ascontiguousarray(image), out)
        return out
    blurred = cv2.blur(image, (5, 5)).astype(np.float32)
    found = cv2.remap(blurred, at[:, :1], at[:, 1:], cv2.INTER_LINEAR, borderMode=cv2.BORDER_REPLICATE)
    return np.asarray(found, dtype=np.float64).reshape(len(points), -1)
