"""A reticle, or what else a display draws over the target when it is marked.

It stays where it is in the picture, and is followed in the target's place, which moves on beneath it. It is found by
what does not change while the picture does, and filled by what lies around.
"""

from __future__ import annotations

import cv2
import numpy as np
import numpy.typing as npt

from edge.uav.base import Box
from edge.uav.image_motion.burnt_in import ALIKE, detail
from protocols.geometry.types import Bools, Floats, Image

_WORKING_WIDTH = 900  # px, about: a line of a display is not thinner than a pixel of 640
_CHANGES = 6  # of the picture at least: until then much of its background has not changed, either
_BLOCK_PX = 9  # side of what lies around a line [px]
_CONTRAST = 20.0  # grey levels of a line to what lies around: a fainter one is no more than texture
_CHANGE = 0.5  # of a line's brightness over that contrast: a translucent one lets half of what lies behind through
_UNCHANGED = 0.01  # of the target's box besides what is drawn over it, when the target has moved out of it
_LEAST_SHARE = 0.05
"""Of the target's box that a display covers: at that moment 0 to 3.2 % was found in 41 rendered and real flights
without one, 8.1 to 87 % in 52 with a reticle."""
_LESS, _MORE = 0.8, 2.0  # of what was drawn, and of the changes, when it is looked at anew: the target has moved on
_GIVE_UP_S = 20.0  # after which a target has left what it was marked beneath, or all stands still
_KEPT, _KEPT_BYTES = 24, 1e8  # images since the first, at most; 16 of full HD, 6 of ultra-HD


Pixels = npt.NDArray[np.intp]


class OnScreenDisplay:
    """What a display draws over the target's box in the first image (H, W, 3), at ``time`` [s]."""

    def __init__(self, image: Image, time: float, box: Box) -> None:
        self._step = max(1, round(image.shape[1] / _WORKING_WIDTH))
        self._low, self._last = self._seen(image)  # of each colour
        self._high = self._low.copy()
        self._changes, self._until = 1, time + _GIVE_UP_S
        self._share, self._changes_then = np.inf, 0  # when it was last found
        corners = np.array([[box.x, box.y], [box.x + box.width, box.y + box.height]]) / self._step
        (x, y), (right, bottom) = np.clip(corners, 0, np.array(self._low.shape[1::-1]) - 1).astype(int).tolist()
        self._box = slice(y, bottom + 1), slice(x, right + 1)
        self._stride, self._count, self._most = 1, 0, int(np.clip(_KEPT_BYTES // image.nbytes, 6, _KEPT))
        self._filled: tuple[Pixels, Pixels] | None = None  # pixels (2, n) drawn over, and those they are replaced by
        self.images = [(image, time)]
        """The first image, and some of those since, with their times; none once the search has ended."""

    def find(self, image: Image, time: float) -> bool:
        """Look at the next image; whether a display was found over the target's first box, or a smaller one."""
        if not self.images:
            return False
        if time > self._until:
            self._end()
            return False
        self._keep(image, time)
        small, seen = self._seen(image)
        if float((seen * self._last).sum()) >= ALIKE:
            return False
        self._last, self._changes = seen, self._changes + 1
        cv2.min(self._low, small, self._low)
        cv2.max(self._high, small, self._high)
        drawn, unchanged = self._shares()
        if self._changes < _CHANGES or unchanged > _UNCHANGED:
            return False
        if drawn < _LEAST_SHARE:
            self._end()
            return False
        if drawn > _LESS * self._share and self._changes < _MORE * self._changes_then:
            return False
        self._share, self._changes_then = drawn, self._changes
        self._fill(_drawn(self._low, self._high), image.shape[:2])
        return True

    def accept(self) -> None:
        """What was found is left out of all images from now on."""
        self.images = []

    def _end(self) -> None:
        self.images, self._filled = [], None

    def without(self, image: Image) -> Image:
        """The image (H, W, 3) without the display, if one was found."""
        if self._filled is None:
            return image
        out = image.copy()
        (rows, columns), (from_rows, from_columns) = self._filled
        out[rows, columns] = image[from_rows, from_columns]
        return out

    def _seen(self, image: Image) -> tuple[Image, Floats]:
        """The reduced image, and its detail."""
        small = image[:: self._step, :: self._step].copy()
        return small, detail(np.asarray(cv2.cvtColor(small, cv2.COLOR_BGR2GRAY), np.uint8))

    def _keep(self, image: Image, time: float) -> None:
        """Keep every so many images: twice as many where there are too many."""
        self._count += 1
        if self._count % self._stride:
            return
        if len(self.images) == self._most:
            self.images, self._stride = self.images[::2], 2 * self._stride
        self.images.append((image, time))

    def _shares(self) -> tuple[float, float]:
        """Of the target's box, what is drawn over, and what has not changed besides."""
        rows, columns = (slice(max(part.start - _BLOCK_PX, 0), part.stop + _BLOCK_PX) for part in self._box)
        low, high = self._low[rows, columns], self._high[rows, columns]
        drawn = _drawn(low, high)
        still = (cv2.subtract(high, low) < _CONTRAST).all(axis=2) & (_beside(drawn) == 0)
        inside = tuple(
            slice(part.start - around.start, part.stop - around.start)
            for part, around in zip(self._box, (rows, columns), strict=True)
        )
        return float(drawn[inside].mean()), float(still[inside].mean())

    def _fill(self, drawn: Bools, shape: tuple[int, int]) -> None:
        """Each pixel that is drawn over, and those beside it, are replaced by the nearest one that is not."""
        mask = cv2.resize(_beside(drawn), shape[::-1], interpolation=cv2.INTER_NEAREST)
        _, labels = cv2.distanceTransformWithLabels(mask, cv2.DIST_L2, 5, labelType=cv2.DIST_LABEL_PIXEL)
        free, covered = np.nonzero(mask == 0), np.nonzero(mask)
        nearest = np.zeros((2, int(labels.max()) + 1), np.intp)
        nearest[:, labels[free]] = free
        self._filled = np.array(covered, np.intp), nearest[:, labels[covered]]


def _drawn(low: Image, high: Image) -> Bools:
    """Pixels that have not changed between these levels, unlike what lies around them, (h, w)."""
    mean = 0.5 * (low.astype(np.float32) + high)
    contrast = np.abs(mean - cv2.blur(mean, (_BLOCK_PX, _BLOCK_PX)))
    return np.asarray(((high.astype(np.float32) - low < _CHANGE * contrast) & (contrast > _CONTRAST)).any(axis=2))


def _beside(drawn: Bools) -> npt.NDArray[np.uint8]:
    """These pixels and those beside them."""
    return np.asarray(cv2.dilate(drawn.astype(np.uint8), np.ones((3, 3), np.uint8)), np.uint8)
