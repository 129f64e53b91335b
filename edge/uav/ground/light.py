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

    def undone(self, picture: Picture) -> Picture:
        """The picture (h, w, 3) in the light of the start."""
        if np.abs(self.gain - 1.0).max() < 0.02:
            return picture
        if self._tables is None:
            levels = np.arange(256)[:, None] / self.gain
            self._tables = np.clip(np.rint(levels), 0, 255).astype(np.uint8)[None]
        return np.asarray(cv2.LUT(np.ascontiguousarray(picture), self._tables), np.uint8)


def _sampled(picture: Picture, points: Floats) -> Floats:
    """Colours (n, 3) at image points (n, 2), linearly between pixels."""
    at = points.astype(np.float32)
    found = cv2.remap(
        picture.astype(np.float32), at[:, :1], at[:, 1:], cv2.INTER_LINEAR, borderMode=cv2.BORDER_REPLICATE
    )
    return np.asarray(found, dtype=np.float64).reshape(-1, 3)
