"""What a camera that stands still sees where no marker is: learnt from its own pictures, a few rows at a time.

Whoever measures how much of a pixel a ball covers must know what is behind it. Beside the ball it can be seen, but an
edge that runs behind the rim cannot; here it was seen before the ball came. Each pixel follows its median: a running
mean of its first looks, then one 8-bit step at a time, so that somebody who passes leaves hardly a trace. Whether it
still holds (the camera was turned, the light went out) is for the user to ask where the scenery can be seen.
"""

from __future__ import annotations

import numpy as np
import numpy.typing as npt

from protocols.geometry.types import Bools

Image = npt.NDArray[np.uint8]
_STRIPES = 24  # frames until every row has been looked at once: few rows a frame cost little time
_MEAN_LOOKS = 8  # of which the mean is taken
_ENOUGH = 3  # looks from which a pixel is known


class Scenery:
    """The picture without markers.

    picture: (H, W, 3) BGR. looks: (H, W) how often each pixel was learnt, up to 255. Before the first ``learn``, and
    where pictures change their size, all is unknown.
    """

    def __init__(self) -> None:
        self.picture: Image = np.zeros((0, 0, 3), np.uint8)
        self.looks: Image = np.zeros((0, 0), np.uint8)
        self._next = 0

    def of(self, image: Image) -> tuple[Image, Image] | None:
        """Picture and looks for an image (H, W, 3); None where nothing is known of any of that size."""
        return (self.picture, self.looks) if self.picture.shape == image.shape else None

    def rows(self, image: Image) -> tuple[int, int]:
        """The rows (first, end) of this image that ``learn`` will look at, which are others each time."""
        height = image.shape[0]
        return height * self._next // _STRIPES, height * (self._next + 1) // _STRIPES

    def learn(self, image: Image, free: Bools) -> None:
        """Look at some rows of an image (H, W, 3). free: (rows, W) where no marker may be, of ``rows(image)``."""
        if self.picture.shape != image.shape:
            self.picture, self.looks = np.zeros_like(image), np.zeros(image.shape[:2], np.uint8)
        first, end = self.rows(image)
        self._next = (self._next + 1) % _STRIPES
        looks, known = self.looks[first:end], self.picture[first:end]
        step = image[first:end].astype(np.int16) - known
        if int(looks.min(initial=255)) < _MEAN_LOOKS:
            early = np.rint(step / (looks[..., None] + 1.0)).astype(np.int16)
            step = np.where((looks < _MEAN_LOOKS)[..., None], early, np.sign(step))
        else:
            step = np.sign(step)
        np.copyto(known, (known + step).astype(np.uint8), where=free[..., None])
        looks += free & (looks < 255)


def known_at(looks: npt.NDArray[np.uint8]) -> Bools:
    """Where scenery has been seen often enough, of its ``looks``."""
    return np.asarray(looks >= _ENOUGH)
