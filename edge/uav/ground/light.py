"""How much lighter or darker the picture is than it was at the start, each channel, from the ground that stays."""

from __future__ import annotations

import cv2
import numpy as np
import numpy.typing as npt

from protocols.geometry.types import Floats

Picture = npt.NDArray[np.uint8]

_MOST_A_FRAME = 1.35
_RANGE = (0.3, 3.0)


class Light:
    """Gain (3,) of the channels over those of the first frame."""

    def __init__(self) -> None:
        self.gain = np.ones(3)
        self._before: Picture | None = None
        self._tables: Picture | None = None

    def update(self, small: Picture, old: Floats, new: Floats) -> None:
        """Compare the same ground points in the last working picture (``old``, (n, 2)) and in this one (``new``)."""
        soft = np.asarray(cv2.blur(small, (5, 5)), np.uint8)
        if self._before is not None and len(old) >= 12:
            height, width = small.shape[:2]
            top = np.array([width - 1, height - 1])
            a = np.clip(np.rint(old), 0, top).astype(int)
            b = np.clip(np.rint(new), 0, top).astype(int)
            before = self._before[a[:, 1], a[:, 0]].astype(np.float64)
            after = soft[b[:, 1], b[:, 0]].astype(np.float64)
            usable = ((before > 8) & (after > 8) & (before < 247) & (after < 247)).all(axis=1)
            if int(usable.sum()) >= 12:
                ratio = np.median(after[usable] / before[usable], axis=0)
                # Less than a grey level is rounding, which would add up.
                ratio = np.where(np.abs(ratio - 1.0) < 0.006, 1.0, ratio)
                self.gain = np.clip(self.gain * np.clip(ratio, 1 / _MOST_A_FRAME, _MOST_A_FRAME), *_RANGE)
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
