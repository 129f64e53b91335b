"""Background image of a static camera without the marker, learnt from its own images, a few rows per frame.

To measure which part of a pixel a ball covers, the background behind it must be known. Beside the ball it is visible,
but an edge behind the rim is not; here it was seen before the ball came. Each pixel follows its median: a running mean
of its first samples, then one 8-bit step at a time, so that passing objects have little effect. Whether the background
still holds (the camera was turned, the light went out) is tested by the user of this class where it is visible.
"""

from __future__ import annotations

import numpy as np
import numpy.typing as npt

from protocols.geometry.types import Bools, Image

_STRIPES = 24  # frames until every row has been sampled once: few rows per frame take little time
_MEAN_COUNT = 8  # samples of which the mean is taken
_MIN_COUNT = 3  # samples from which a pixel is known


class StaticBackground:
    """Background image of one camera.

    image: (H, W, 3) BGR. counts: (H, W) number of samples of each pixel, up to 255. Before the first ``update``, and
    where images change their size, all is unknown.
    """

    def __init__(self) -> None:
        self.image: Image = np.zeros((0, 0, 3), np.uint8)
        self.counts: Image = np.zeros((0, 0), np.uint8)
        self._next = 0

    def lookup(self, image: Image) -> tuple[Image, Image] | None:
        """Background and counts for an image (H, W, 3); None where none of that size is known."""
        return (self.image, self.counts) if self.image.shape == image.shape else None

    def next_rows(self, image: Image) -> tuple[int, int]:
        """The rows (first, end) of this image that ``update`` will sample; they advance with each update."""
        height = image.shape[0]
        return height * self._next // _STRIPES, height * (self._next + 1) // _STRIPES

    def update(self, image: Image, free: Bools) -> None:
        """Sample some rows of an image (H, W, 3). free: (rows, W) pixels without a marker, of ``next_rows(image)``."""
        if self.image.shape != image.shape:
            self.image, self.counts = np.zeros_like(image), np.zeros(image.shape[:2], np.uint8)
        first, end = self.next_rows(image)
        self._next = (self._next + 1) % _STRIPES
        counts, known = self.counts[first:end], self.image[first:end]
        step = image[first:end].astype(np.int16) - known
        if int(counts.min(initial=255)) < _MEAN_COUNT:
            early = np.rint(step / (counts[..., None] + 1.0)).astype(np.int16)
            step = np.where((counts < _MEAN_COUNT)[..., None], early, np.sign(step))
        else:
            step = np.sign(step)
        np.copyto(known, (known + step).astype(np.uint8), where=free[..., None])
        counts += free & (counts < 255)


def is_known(counts: npt.NDArray[np.uint8]) -> Bools:
    """Where the background has enough samples, from its ``counts``."""
    return np.asarray(counts >= _MIN_COUNT)
