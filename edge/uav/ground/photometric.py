"""How much lighter or darker the picture is than it was at the start, each channel, from the ground that stays."""

from __future__ import annotations

import cv2
import numpy as np
import numpy.typing as npt

from protocols.geometry.types import Floats

Picture = npt.NDArray[np.uint8]

_MOST_A_FRAME = 0.3  # of the logarithm
_KEPT = 0.99  # of the gain, a frame
_RANGE = (0.3, 3.0)
_FEWEST = 12  # points that tell anything
_SHADE_RATE = 0.8  # of a look
_MOST_SHADE_A_LOOK = 0.25  # of the logarithm
_DARKEST = 0.7
_SHADE_S = 1.5
_NO_SHADE = 0.02


class Light:
    """Gain (3,) of the channels over those of the first frame."""

    def __init__(self) -> None:
        self.gain = np.ones(3)
        self._before: Picture | None = None
        self._tables: Picture | None = None

    def update(self, small: Picture, old: Floats, new: Floats) -> None:
        """Compare the same ground points in the last working picture (``old``, (n, 2)) and in this one (``new``)."""
        soft = np.asarray(cv2.blur(small, (5, 5)), np.uint8)
        if self._before is not None and len(old) >= _FEWEST:
            before, after = _sampled(self._before, old), _sampled(soft, new)
            usable = ((before > 8) & (after > 8) & (before < 247) & (after < 247)).all(axis=1)
            if int(usable.sum()) >= _FEWEST:
                change = np.median(np.log(after[usable] / before[usable]), axis=0)
                change = np.clip(change, -_MOST_A_FRAME, _MOST_A_FRAME)
                # What the tables have learnt meanwhile need not be undone, and rounding must not add up.
                self.gain = np.clip(np.exp(_KEPT * np.log(self.gain) + change), *_RANGE)
                self._tables = None
        self._before = soft

    def undone(self, picture: Picture, shade: float = 0.0) -> Picture:
        """The picture (h, w, 3) in the light of the start. shade: logarithm of what it has there besides the gain."""
        if abs(shade) >= _NO_SHADE:
            return _relit(picture, self.gain * np.exp(shade))
        if np.abs(self.gain - 1.0).max() < 0.02:
            return picture
        if self._tables is None:
            self._tables = _tables(self.gain)
        return np.asarray(cv2.LUT(np.ascontiguousarray(picture), self._tables), np.uint8)


class Shade:
    """A cloud's shadow on the target, which the median over the picture knows nothing of: the car drives through it.

    ``value`` is the logarithm of the light at the target over the picture's. Shadows are grey: a car of another colour
    stays one.
    """

    def __init__(self) -> None:
        self.value = 0.0
        self._usual: float | None = None

    def teach(self, brightness: float) -> None:
        """From now on the target is this bright (mean logarithm) in the light that is known to fall on it."""
        self._usual = brightness

    def update(self, brightness: float) -> None:
        """Take the target's brightness as it was seen with ``value`` undone."""
        if self._usual is None:
            return
        change = float(np.clip(brightness - self._usual, -_MOST_SHADE_A_LOOK, _MOST_SHADE_A_LOOK))
        self.value = float(np.clip(self.value + _SHADE_RATE * change, -_DARKEST, _DARKEST))

    def fade(self, dt: float) -> None:
        """The target is out of sight: where it is now the light may be another."""
        self.value *= float(np.exp(-dt / _SHADE_S))


def _tables(gain: Floats) -> Picture:
    levels = np.arange(256)[:, None] / gain
    return np.asarray(np.clip(np.rint(levels), 0, 255), np.uint8)[None]


def _relit(picture: Picture, gain: Floats) -> Picture:
    return np.asarray(cv2.LUT(np.ascontiguousarray(picture), _tables(gain)), np.uint8)


def _sampled(picture: Picture, points: Floats) -> Floats:
    """Colours (n, 3) at image points (n, 2), linearly between pixels."""
    at = points.astype(np.float32)
    found = cv2.remap(
        picture.astype(np.float32), at[:, :1], at[:, 1:], cv2.INTER_LINEAR, borderMode=cv2.BORDER_REPLICATE
    )
    return np.asarray(found, dtype=np.float64).reshape(-1, 3)
